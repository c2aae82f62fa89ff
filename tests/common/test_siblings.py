"""All algorithms are used alike, and as PPO is."""

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, IdentityEnvBox, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch.nn.utils import parameters_to_vector

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.common.algorithm import FlowOnPolicyAlgorithm
from tests.helpers import SMALL, TINY, TWO_EPOCHS, train, weights

FPO_PLUS_PLUS: dict[str, Any] = {
    "mc_average": "objective",
    "loss_target": "velocity",
    "loss_reduction": "sum",
    "trust_region": "aspo",
    "loss_clamp": 20.0,
    "difference_clamp": 10.0,
}
FLOW_CHAIN: dict[str, Any] = {
    "process": "flow",
    "log_prob_clamp": None,
    "log_prob_reduction": "sum",
    "denoising_gamma": 1.0,
    "min_sampling_std": 0.05,
    "min_log_prob_std": 0.05,
}
TRIGFLOW: dict[str, Any] = {
    "brownian_coef": "lin_0.25_0.05",
    "interpolant": "trigflow",
    "n_flow_steps": 4,
    "solver": "rk4",
    "policy_kwargs": {"embedding_dim": 8, "log_std_bounds": (-5.0, 2.0), "latent_std": 0.5},
}
Algorithm = type[FlowOnPolicyAlgorithm]
VARIANTS = [
    pytest.param(PolicyFlow, {}, id="policyflow"),
    pytest.param(PolicyFlow, TRIGFLOW, id="policyflow-trigflow"),
    pytest.param(PolicyFlow, {"ent_coef": 0.01, "n_times": 3}, id="policyflow-entropy"),
    pytest.param(FPO, {}, id="fpo"),
    pytest.param(FPO, FPO_PLUS_PLUS, id="fpo++"),
    pytest.param(FPO, {"ent_coef": 0.01, "action_noise_std": 0.1}, id="fpo-entropy"),
    pytest.param(DPPO, {}, id="dppo"),
    pytest.param(DPPO, {"n_finetuned_steps": 4, "clip_range_base": 0.01}, id="dppo-last-steps"),
    pytest.param(DPPO, {"ent_coef": 0.01, "n_critic_warmup": 1}, id="dppo-entropy"),
    pytest.param(DPPO, FLOW_CHAIN, id="dppo-flow"),
]
every_variant = pytest.mark.parametrize(("algorithm", "options"), VARIANTS)


@every_variant
def test_trains_and_logs(algorithm: Algorithm, options: dict[str, Any]) -> None:
    model = algorithm("MlpFlowPolicy", "Pendulum-v1", clip_range_vf=0.2, **TWO_EPOCHS, **options)
    before = parameters_to_vector(model.policy.velocity.parameters()).detach().clone()
    train(model, 128)
    assert not th.equal(parameters_to_vector(model.policy.velocity.parameters()), before)
    logged = model.logger.name_to_value
    keys = ["policy_gradient_loss", "value_loss", "approx_kl", "clip_fraction", "clip_range"]
    keys += ["clip_range_vf", "explained_variance", "learning_rate", "loss", "n_updates"]
    for key in [*keys, "ratio_mean", "log_ratio_max"]:
        assert np.isfinite(logged[f"train/{key}"])
    assert "train/entropy_loss" in logged or "ent_coef" not in options


@every_variant
def test_saved_model_acts_and_goes_on_as_before(
    algorithm: Algorithm, options: dict[str, Any], tmp_path: Path
) -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", 2))
    model = algorithm("MlpPolicy", env, desired_kl=1e-6, **TWO_EPOCHS, **options).learn(256)
    assert model.adaptive_learning_rate != 3e-4
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env)
    assert loaded.adaptive_learning_rate == model.adaptive_learning_rate
    assert loaded.policy.optimizer.param_groups[0]["lr"] == model.adaptive_learning_rate
    model.policy.save(tmp_path / "policy.pt")
    policy = type(model.policy).load(tmp_path / "policy.pt")
    obs = np.asarray(env.reset())
    expected = model.predict(obs, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], expected)
    np.testing.assert_array_equal(policy.predict(obs, deterministic=True)[0], expected)
    train(loaded, 128, reset_num_timesteps=False)
    assert loaded.num_timesteps == 256 + 128


@every_variant
def test_predict(algorithm: Algorithm, options: dict[str, Any]) -> None:
    model = algorithm("MlpPolicy", "Pendulum-v1", **TWO_EPOCHS, **options).learn(64)
    obs = np.stack([model.observation_space.sample() for _ in range(5)])
    deterministic = model.predict(obs, deterministic=True)[0]
    assert deterministic.shape == (5, 1)
    np.testing.assert_array_equal(deterministic, model.predict(obs, deterministic=True)[0])
    sampled = model.predict(obs)[0]
    assert not np.array_equal(sampled, model.predict(obs)[0])
    assert model.action_space.contains(sampled[0])
    model.policy.deterministic_action = "drawn"
    latent_only = model.predict(obs, deterministic=True)[0]
    assert not np.array_equal(latent_only, deterministic)


def test_latents_that_are_always_drawn_survive_a_file(algorithm: type[Any], tmp_path: Path) -> None:
    kwargs = {**TINY, "deterministic_action": "drawn"}
    algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=kwargs, **SMALL).save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    loaded.policy.save(tmp_path / "policy")
    for policy in (loaded.policy, type(loaded.policy).load(tmp_path / "policy")):
        assert policy.deterministic_action == "drawn"


def test_dict_observations(algorithm: type[Any]) -> None:
    env = SimpleMultiObsEnv(discrete_actions=False)
    model = train(algorithm("MultiInputFlowPolicy", env, **TWO_EPOCHS), 64)
    assert model.predict(env.observation_space.sample())[0].shape == env.action_space.shape


@pytest.mark.parametrize("share", [True, False])
def test_images(algorithm: type[Any], share: bool) -> None:
    env = FakeImageEnv(screen_height=40, screen_width=40, n_channels=1, discrete=False)
    stacked = VecFrameStack(make_vec_env(lambda: env), 4)
    policy_kwargs = {"share_features_extractor": share}
    model = algorithm("CnnFlowPolicy", stacked, policy_kwargs=policy_kwargs, **TWO_EPOCHS).learn(64)
    assert np.isfinite(evaluate_policy(model, model.get_env(), 1)[0])
    # The flow's network sees the action and the embedding, not the picture.
    assert model.policy.velocity.hidden[0].in_features == 5 + 64


@pytest.mark.slow
def test_learns_to_copy_its_observation(algorithm: type[Any]) -> None:
    env = make_vec_env(lambda: IdentityEnvBox(eps=0.3), 8)
    assert isinstance(env, DummyVecEnv)
    for i, single in enumerate(env.envs):  # observations are samples of this space
        single.unwrapped.observation_space.seed(i)
    options = {"n_steps": 64, "batch_size": 128, "learning_rate": 2e-3, "gamma": 0.4, "seed": 0}
    model = algorithm("MlpFlowPolicy", env, **options)
    untrained, _ = evaluate_policy(model, env, 8)
    model.learn(8_192)
    trained, _ = evaluate_policy(model, env, 8)
    assert trained > max(untrained, 60)  # of at most 100


@pytest.mark.parametrize("n_envs", [1, 3])
def test_same_seed_same_run(algorithm: type[Any], n_envs: int) -> None:
    runs = []
    for _ in range(2):
        env = make_vec_env("Pendulum-v1", n_envs)
        model = algorithm("MlpPolicy", env, **TWO_EPOCHS, ent_coef=0.01)
        runs.append(weights(train(model, n_envs * 64)))
    assert th.equal(*runs)


def test_policies_of_another_algorithm_are_refused(algorithm: type[Any]) -> None:
    other = (FPO if algorithm is PolicyFlow else PolicyFlow).policy_aliases["MlpFlowPolicy"]
    with pytest.raises(ValueError, match=f"{algorithm.__name__} trains policies derived from"):
        algorithm(other, "Pendulum-v1")


DELIBERATE_DIFFERENCES = {
    # Only policies of flows fit, and the buffer keeps a record.
    "policy": {"annotation"},
    # None, or a number that is not positive, turns clipping off.
    "max_grad_norm": {"annotation"},
    # May be schedules, also in words.
    "ent_coef": {"annotation"},
    "learning_rate": {"annotation"},
    "clip_range_vf": {"annotation"},
    # FPO's ratios are those of an average over probes, and move less.
    "clip_range": {"annotation", "default"},
    # As their papers integrate: PolicyFlow with 12 midpoint steps, FPO with 10 Euler steps.
    "n_flow_steps": {"default"},
    "solver": {"default"},
    # PolicyFlow's grid has its end, FPO's has not.
    "time_sampler": {"default"},
}


@pytest.mark.parametrize("one", [PPO, PolicyFlow])
@pytest.mark.parametrize("other", [PolicyFlow, FPO, DPPO])
def test_shared_arguments_are_alike(one: type[Any], other: type[Any]) -> None:
    ours, theirs = (inspect.signature(a.__init__).parameters for a in (one, other))
    shared = [name for name in ours if name in theirs and name != "self"]
    assert len(shared) > 20
    for name in shared:
        allowed = DELIBERATE_DIFFERENCES.get(name, set())
        if "default" not in allowed:
            assert ours[name].default == theirs[name].default, name
        if "annotation" not in allowed:
            assert _plain(ours[name].annotation) == _plain(theirs[name].annotation), name
    if one is PPO:
        positional = [p for p in theirs.values() if p.kind is p.POSITIONAL_OR_KEYWORD]
        assert [p.name for p in positional] == list(ours)


def _plain(annotation: Any) -> str:
    """An annotation as text; SB3 writes some as strings, and optional ones in either form."""
    text = annotation if isinstance(annotation, str) else str(annotation)
    return " | ".join(sorted(text.replace("typing.", "").replace("Union", "").split(" | ")))
