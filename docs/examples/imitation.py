"""From demonstrations to a better policy, in five minutes on one core.

Run it as it is, or cell by cell: each begins with "# %%". Smaller numbers make it shorter:
``python imitation.py EPISODES GRADIENT_STEPS STEPS``.
"""

# %% How much of everything
import sys

EPISODES, GRADIENT_STEPS, STEPS = [int(n) for n in sys.argv[1:]] or [8192, 4000, 1_500_000]

# %% The demonstrations: a slow demonstrator goes to one of six goals, which are equally good
import numpy as np

from sb3_policyflow.imitation import clone, load_demonstrations
from sb3_policyflow.imitation.demonstrators import demonstrate

shown = load_demonstrations(demonstrate("MultiGoal-v0", "slow", EPISODES))
print(f"{len(shown.actions)} transitions, mean return {shown.returns.mean():.2f}")

# %% The policy, and what training with reinforcement is to be like later on
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor
from torch import nn

from sb3_policyflow import PolicyFlow
from sb3_policyflow.envs.multigoal import MultiGoalVecEnv

N_ENVS, N_STEPS = 1024, min(24, max(STEPS // 1024, 2))
model = PolicyFlow(
    "MlpPolicy",
    VecMonitor(MultiGoalVecEnv(N_ENVS, seed=0)),
    n_steps=N_STEPS,
    batch_size=N_ENVS * N_STEPS // 16,
    n_epochs=5,
    learning_rate=3e-4,
    max_grad_norm=1.0,
    vf_coef=1.0,
    brownian_coef=0.05,  # keeps the goals
    n_critic_warmup=12,  # the critic knows nothing yet: at first it learns alone
    policy_kwargs=dict(net_arch=[256, 128, 64], activation_fn=nn.Mish),
    seed=0,
)

# %% Imitation: flow matching towards the demonstrated actions
clone(model, shown, GRADIENT_STEPS, progress_bar=True)

# %% What it does now: as good as the demonstrator, and all goals
from sb3_policyflow.benchmark.measure.goals import evaluate_goals


def report() -> None:
    returns, _ = evaluate_policy(
        model, VecMonitor(MultiGoalVecEnv(512, seed=1)), 512, deterministic=False
    )
    print(f"mean return {returns:.2f}; from the center: {evaluate_goals(model)}")


report()
model.save("cloned")

# %% Reinforcement: it becomes faster, and keeps the goals
model.learn(STEPS)
report()
assert np.isfinite(model.policy.velocity.output.weight.detach().numpy()).all()
