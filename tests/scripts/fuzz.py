"""Draws spaces, hyperparameters and habits: each draw trains, or is refused by a sentence.

python tests/scripts/fuzz.py [DRAWS] [SEED]

A draw is two iterations in wrappers, with attributes that are changed between them and, now and
then, with another thread that asks for actions: see ``habits.py``. Nothing that a callback has seen
may change later, and wrappers are called as often as steps were taken.

Prints how many draws were trained and how many refused; fails with the first draw that was neither.
"""

import sys
import warnings
from collections import Counter
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from habits import Watch, asked, habits, wrap
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_policyflow import DPPO, FPO, PolicyFlow

OUTCOMES: Counter[str] = Counter()


class Anything(gym.Env[Any, Any]):
    """Random observations from any space; rewards of any finite size."""

    def __init__(self, observation_space: Any, action_space: Any, reward_scale: float) -> None:
        self.observation_space, self.action_space = observation_space, action_space
        self.reward_scale = reward_scale

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        reward = self.reward_scale * float(self.np_random.normal())
        over, cut = self.np_random.random(2) < 0.2
        return self.observation_space.sample(), reward, bool(over), bool(cut), {}


shapes = st.lists(st.integers(1, 3), min_size=1, max_size=3).map(tuple)
dtypes: st.SearchStrategy[Any] = st.sampled_from([np.float32, np.float64])
boxes = st.builds(
    spaces.Box,
    st.sampled_from([-1e6, -1.0, 0.0]),
    st.sampled_from([1e6, 1.0, 1e-3]),
    shapes,
    dtypes,
)
unbounded_boxes = st.sampled_from([(-np.inf, np.inf), (0.0, np.inf), (-np.inf, 1.0)]).flatmap(
    lambda bounds: st.builds(spaces.Box, *map(st.just, bounds), shapes, dtypes)
)
images = st.sampled_from([(36, 36, 1), (3, 40, 36), (4, 36, 36)]).map(
    lambda shape: spaces.Box(0, 255, shape, np.uint8)
)
flat_observations = st.one_of(
    boxes,
    unbounded_boxes,
    st.integers(1, 5).map(spaces.Discrete),
    st.lists(st.integers(1, 4), min_size=1, max_size=3).map(spaces.MultiDiscrete),
    st.integers(1, 4).map(spaces.MultiBinary),
)
parts: st.SearchStrategy[spaces.Space[Any]] = st.one_of(flat_observations, images)
dict_observations = st.dictionaries(
    st.sampled_from(["a", "b", "camera"]), parts, min_size=1, max_size=3
).map(spaces.Dict)
observations = st.one_of(flat_observations, flat_observations, dict_observations, images)

layers = st.lists(st.integers(1, 9), max_size=2)
networks = st.fixed_dictionaries(
    {"embedding_dim": st.integers(1, 9)},
    optional={
        "net_arch": layers | st.fixed_dictionaries({}, optional={"pi": layers, "vf": layers}),
        "activation_fn": st.sampled_from([th.nn.Mish, th.nn.ELU, th.nn.ReLU]),
        "share_features_extractor": st.booleans(),
        "initialization": st.sampled_from(["orthogonal", "glorot", "glorot_zero_output", "zero"]),
        "frequencies": st.integers(1, 3) | st.just([1.0, 2.0]),
    },
)
coefficients = st.one_of(
    st.floats(0.0, 1.0), st.sampled_from(["lin_0.25", "lin_0.1_0.2", lambda p: 0.1 * p])
)
common: dict[str, st.SearchStrategy[Any]] = {
    "learning_rate": st.sampled_from([0.0, 1e-4, 1e-2, 1.0]),
    "gamma": st.sampled_from([0.0, 0.9, 1.0]),
    "gae_lambda": st.sampled_from([0.0, 0.95, 1.0]),
    "clip_range": st.sampled_from([0.05, 0.2, lambda progress: 0.2 * progress]),
    "clip_range_vf": st.sampled_from([None, 0.2]),
    "normalize_advantage": st.booleans(),
    "ent_coef": coefficients,
    "max_grad_norm": st.sampled_from([None, 0.0, 0.5]),
    "target_kl": st.sampled_from([None, 1e-3]),
    "desired_kl": st.sampled_from([None, 0.01]),
    "lr_adaptation_kwargs": st.fixed_dictionaries(
        {},
        optional={
            "interval": st.sampled_from(["epoch", "minibatch"]),
            "window": st.sampled_from(["epoch", "update"]),
        },
    ),
    "advantage_scope": st.sampled_from(["minibatch", "rollout"]),
    "timeout_bootstrap": st.sampled_from(["terminal", "current", "none"]),
    "n_critic_warmup": st.integers(0, 2),
    "critic_learning_rate": st.none() | st.floats(0.0, 1e-2),
}
ode: dict[str, st.SearchStrategy[Any]] = {
    "solver": st.sampled_from(["euler", "midpoint", "heun", "rk4", "ab2"]),
    "n_flow_steps": st.integers(1, 3),
    "time_sampler": st.sampled_from(["grid", "grid_without_end", "uniform"]),
}
entropy: dict[str, st.SearchStrategy[Any]] = {
    "n_entropy_actions": st.integers(2, 3),
    "n_entropy_states": st.integers(1, 3),
}
own: dict[type[Any], dict[str, st.SearchStrategy[Any]]] = {
    PolicyFlow: {
        **ode,
        "brownian_coef": coefficients,
        "uniform_noise_coef": coefficients,
        "interpolant": st.sampled_from(["rectified", "stochastic", "stochastic_exact", "trigflow"]),
        "n_times": st.integers(1, 3),
        "time_average": st.sampled_from(["objective", "shift"]),
        "brownian_reduction": st.sampled_from(["sum", "mean"]),
        "gaussian": st.booleans(),
        "log_ratio_clamp": st.sampled_from([None, 1.0]),
    },
    FPO: {
        **ode,
        "n_mc_samples": st.integers(1, 3),
        "mc_average": st.sampled_from(["loss", "objective"]),
        "loss_target": st.sampled_from(["epsilon", "velocity"]),
        "loss_reduction": st.sampled_from(["mean", "sum"]),
        "trust_region": st.sampled_from(["ppo", "spo", "aspo"]),
        "loss_clamp": st.sampled_from([None, 1.0]),
        "difference_clamp": st.sampled_from([None, 1.0]),
        "action_noise_std": st.sampled_from([0.0, 0.1]),
        **entropy,
    },
    DPPO: {
        "process": st.sampled_from(["ddpm", "flow"]),
        "n_denoising_steps": st.integers(2, 4),
        "n_finetuned_steps": st.sampled_from([None, 1, 2]),
        "min_sampling_std": st.sampled_from([1e-3, 0.1, 1.0]),
        "min_log_prob_std": st.sampled_from([1e-2, 0.1]),
        "noise_clip": st.sampled_from([None, 1.0]),
        "denoised_clip": st.sampled_from([0.5, 1.0]),
        "identity_skip": st.booleans(),
        "log_prob_clamp": st.sampled_from([None, (-5.0, 2.0)]),
        "log_prob_reduction": st.sampled_from(["mean", "sum"]),
        "denoising_gamma": st.sampled_from([0.9, 1.0]),
        "clip_range_base": st.sampled_from([None, 0.01]),
        "clip_range_rate": st.sampled_from([0.5, 3.0]),
        **entropy,
    },
}
refused: dict[str, list[Any]] = {
    "learning_rate": [-1e-3, float("nan")],
    "gamma": [-0.5, 2.0],
    "n_steps": [0],
    "n_epochs": [0],
    "batch_size": [0, 1],
    "clip_range": [-0.2],
    "clip_range_vf": [0.0, -0.2],
    "ent_coef": [-0.1, "linear", float("inf")],
    "vf_coef": [float("nan")],
    "desired_kl": [0.0],
    "n_critic_warmup": [-1],
    "critic_learning_rate": [-1.0, "high"],
    "lr_adaptation_kwargs": [{"interval": "step"}, {"bounds": (1e-2, 1e-6)}, {"factor": 1.0}],
    "use_sde": [True],
}
"""Values that cannot work: one of them spoils a draw now and then."""
refused_of_ode = {"solver": ["dopri5"], "n_flow_steps": [0, -1], "time_sampler": ["beta"]}
refused_of: dict[type[Any], dict[str, list[Any]]] = {
    PolicyFlow: refused_of_ode,
    FPO: refused_of_ode,
    DPPO: {
        "process": ["vp"],
        "n_denoising_steps": [0],
        "n_finetuned_steps": [0, 9],
        "min_sampling_std": [0.0],
        "log_prob_clamp": [(2.0, -5.0)],
        "log_prob_reduction": ["max"],
        "denoising_gamma": [0.0, 1.5],
        "clip_range_base": [0.0],
    },
}


@st.composite
def cases(draw: st.DrawFn) -> tuple[type[Any], dict[str, Any], dict[str, Any]]:
    """An algorithm, its arguments, and those of its environment."""
    algorithm = draw(st.sampled_from([PolicyFlow, FPO, DPPO]))
    n_steps, n_envs = draw(st.integers(2, 5)), draw(st.integers(1, 3))
    options = draw(st.fixed_dictionaries({}, optional={**common, **own[algorithm]}))
    if "gaussian" in options or "stochastic" in options.get("interpolant", ""):
        for name in ("brownian_coef", "uniform_noise_coef"):
            options.pop(name, None)
    options["policy_kwargs"] = draw(networks)
    if algorithm is PolicyFlow and not ("gaussian" in options or "interpolant" in options):
        options["policy_kwargs"]["latent_std"] = draw(st.sampled_from([0.1, 1.0, 3.0]))
    options["n_steps"], options["n_epochs"] = n_steps, draw(st.integers(1, 2))
    options["batch_size"] = draw(st.integers(2, n_steps * n_envs))
    environment = {
        "n_envs": n_envs,
        "observation_space": draw(observations),
        "action_space": draw(boxes),
        "reward_scale": draw(st.sampled_from([0.0, 1.0, 1e6])),
        "habits": draw(habits),
        "changes": draw(changes_of(algorithm)),
    }
    spoiler = draw(st.sampled_from([None] * 6 + ["option", "actions"]))
    if spoiler == "option":
        wrong = {**refused, **refused_of[algorithm]}
        name = draw(st.sampled_from(sorted(wrong)))
        options[name] = draw(st.sampled_from(wrong[name]))
    if spoiler == "actions":
        environment["action_space"] = draw(unbounded_boxes | st.just(spaces.Discrete(3)))
    return algorithm, options, environment


def changes_of(algorithm: type[Any]) -> st.SearchStrategy[dict[str, Any]]:
    """At most two attributes, and what they are set to between the iterations."""
    known = {**common, **own[algorithm]}
    names = st.lists(st.sampled_from(sorted(known)), max_size=2, unique=True)
    return names.flatmap(lambda drawn: st.fixed_dictionaries({n: known[n] for n in drawn}))


def policy_name(space: spaces.Space[Any]) -> str:
    if isinstance(space, spaces.Dict):
        return "MultiInputPolicy"
    is_image = isinstance(space, spaces.Box) and space.dtype == np.uint8
    return "CnnPolicy" if is_image else "MlpPolicy"


def run(algorithm: type[Any], options: dict[str, Any], environment: dict[str, Any]) -> str:
    """Train two iterations. Returns "trained", or the sentence of the refusal."""
    n_envs = environment["n_envs"]
    drawn, watch = environment["habits"], Watch(environment["changes"])
    parts = {k: environment[k] for k in ("observation_space", "action_space", "reward_scale")}
    envs = wrap(DummyVecEnv([lambda: Anything(**parts) for _ in range(n_envs)]), drawn)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            model = algorithm(policy_name(parts["observation_space"]), envs, seed=0, **options)
            with asked(model, parts["observation_space"].sample(), drawn["asks"]):
                model.learn(2 * n_envs * max(options["n_steps"], 1), watch)
        except (ValueError, AssertionError, FloatingPointError) as refusal:
            return _sentence(refusal)
    watch.check()
    for refusal in watch.refusals:
        _sentence(refusal)
    for name, parameter in model.policy.named_parameters():
        assert th.isfinite(parameter).all(), f"{name} is not finite"
    try:
        action, _ = model.predict(parts["observation_space"].sample())
    except FloatingPointError as refusal:  # the last update has spoiled the policy
        return _sentence(refusal)
    assert parts["action_space"].contains(action.astype(parts["action_space"].dtype))
    return "trained"


def _sentence(refusal: Exception) -> str:
    """The message, if it is one that a user can act upon."""
    text = str(refusal)
    if len(text.split()) < 6:
        raise refusal
    return text


def make_check(n_draws: int, number: int) -> Any:
    """A test of so many draws."""

    @seed(number)
    @settings(
        max_examples=n_draws,
        deadline=None,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    @given(cases())
    def check(case: tuple[type[Any], dict[str, Any], dict[str, Any]]) -> None:
        outcome = run(*case)
        OUTCOMES["trained" if outcome == "trained" else outcome[:60]] += 1

    return check


if __name__ == "__main__":
    th.set_num_threads(1)
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    make_check(draws, int(sys.argv[2]) if len(sys.argv) > 2 else 0)()
    total, trained = sum(OUTCOMES.values()), OUTCOMES.pop("trained", 0)
    sys.stdout.write(f"{total} draws: {trained} trained, {total - trained} refused.\n")
    for message, count in OUTCOMES.most_common():
        sys.stdout.write(f"{count:6d}  {message}\n")
