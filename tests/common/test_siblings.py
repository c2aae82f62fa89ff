"""FPO and DPPO are used as PPO is, and as PolicyFlow is."""

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
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.common.on_policy_algorithm import FlowOnPolicyAlgorithm

SMALL: dict[str, Any] = {"n_steps": 64, "batch_size": 32, "n_epochs": 2, "seed": 0}
FPO_PLUS_PLUS: dict[str, Any] = {
    "probe_average": "objective",
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
Algorithm = type[FlowOnPolicyAlgorithm]
VARIANTS = [
    pytest.param(FPO, {}, id="fpo"),
    pytest.param(FPO, FPO_PLUS_PLUS, id="fpo++"),
    pytest.param(FPO, {"ent_coef": 0.01, "action_noise_std": 0.1}, id="fpo-entropy"),
    pytest.param(DPPO, {}, id="dppo"),
    pytest.param(DPPO, {"n_finetuned_steps": 4, "clip_range_base": 0.01}, id="dppo-last-steps"),
    pytest.param(DPPO, {"ent_coef": 0.01, "n_critic_warmup": 1}, id="dppo-entropy"),
    pytest.param(DPPO, FLOW_CHAIN, id="dppo-flow"),
]
every_variant = pytest.mark.parametrize(("algorithm", "options"), VARIANTS)
both = pytest.mark.parametrize("algorithm", [FPO, DPPO])


def parameters(model: FlowOnPolicyAlgorithm) -> list[th.Tensor]:
    return [parameter.detach().clone() for parameter in model.policy.parameters()]


@every_variant
def test_trains_and_logs(algorithm: Algorithm, options: dict[str, Any]) -> None:
    model = algorithm("MlpFlowPolicy", "Pendulum-v1", clip_range_vf=0.2, **SMALL, **options)
    before = [value.clone() for value in model.policy.velocity.state_dict().values()]
    model.learn(128)
    after = model.policy.velocity.state_dict().values()
    assert any(not th.equal(old, new) for old, new in zip(before, after, strict=True))
    logged = model.logger.name_to_value
    keys = ["policy_gradient_loss", "value_loss", "approx_kl", "clip_fraction", "clip_range"]
    keys += ["clip_range_vf", "explained_variance", "learning_rate", "loss", "n_updates"]
    for key in [*keys, "ratio_mean", "log_ratio_max"]:
        assert np.isfinite(logged[f"train/{key}"])
    assert ("train/entropy_loss" in logged) == ("ent_coef" in options)


@every_variant
def test_saved_model_acts_and_goes_on_as_before(
    algorithm: Algorithm, options: dict[str, Any], tmp_path: Path
) -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", 2))
    model = algorithm("MlpPolicy", env, desired_kl=0.01, **SMALL, **options).learn(128)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env)
    model.policy.save(tmp_path / "policy.pt")
    policy = type(model.policy).load(tmp_path / "policy.pt")
    obs = np.asarray(env.reset())
    expected = model.predict(obs, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], expected)
    np.testing.assert_array_equal(policy.predict(obs, deterministic=True)[0], expected)
    loaded.learn(128, reset_num_timesteps=False)
    assert loaded.num_timesteps == 256


@every_variant
def test_predict(algorithm: Algorithm, options: dict[str, Any]) -> None:
    model = algorithm("MlpPolicy", "Pendulum-v1", **SMALL, **options).learn(64)
    obs = np.stack([model.observation_space.sample() for _ in range(5)])
    deterministic = model.predict(obs, deterministic=True)[0]
    np.testing.assert_array_equal(deterministic, model.predict(obs, deterministic=True)[0])
    sampled = model.predict(obs)[0]
    assert not np.array_equal(sampled, model.predict(obs)[0])
    assert model.action_space.contains(sampled[0])
    model.policy.random_latents = True
    latent_only = model.predict(obs, deterministic=True)[0]
    assert not np.array_equal(latent_only, deterministic)


@both
def test_latents_that_are_always_drawn_survive_a_file(algorithm: Algorithm, tmp_path: Path) -> None:
    kwargs = {"random_latents": True}
    algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=kwargs, **SMALL).save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    loaded.policy.save(tmp_path / "policy")
    for policy in (loaded.policy, type(loaded.policy).load(tmp_path / "policy")):
        assert policy.random_latents


@both
def test_dict_observations(algorithm: Algorithm) -> None:
    env = SimpleMultiObsEnv(discrete_actions=False)
    model = algorithm("MultiInputFlowPolicy", env, **SMALL).learn(64)
    assert model.predict(env.observation_space.sample())[0].shape == env.action_space.shape


@both
@pytest.mark.parametrize("share", [True, False])
def test_images(algorithm: Algorithm, share: bool) -> None:
    env = FakeImageEnv(screen_height=40, screen_width=40, n_channels=1, discrete=False)
    stacked = VecFrameStack(make_vec_env(lambda: env), 4)
    policy_kwargs = {"share_features_extractor": share}
    model = algorithm("CnnFlowPolicy", stacked, policy_kwargs=policy_kwargs, **SMALL).learn(64)
    assert np.isfinite(evaluate_policy(model, model.get_env(), 1)[0])  # type: ignore[arg-type]


@both
def test_learns_to_copy_its_observation(algorithm: Algorithm) -> None:
    env = make_vec_env(lambda: IdentityEnvBox(eps=0.3), 8)
    options = {"n_steps": 64, "batch_size": 128, "learning_rate": 2e-3, "gamma": 0.4, "seed": 0}
    model = algorithm("MlpFlowPolicy", env, **options)
    untrained, _ = evaluate_policy(model, env, 8)
    model.learn(8_192)
    trained, _ = evaluate_policy(model, env, 8)
    assert trained > max(untrained, 60)  # of at most 100


@both
def test_same_seed_same_run(algorithm: Algorithm) -> None:
    runs = []
    for _ in range(2):
        env = make_vec_env("Pendulum-v1", 2)
        runs.append(parameters(algorithm("MlpPolicy", env, **SMALL, ent_coef=0.01).learn(128)))
    assert all(th.equal(one, other) for one, other in zip(*runs, strict=True))


@both
def test_policies_of_another_algorithm_are_refused(algorithm: Algorithm) -> None:
    other = PolicyFlow.policy_aliases["MlpFlowPolicy"]
    with pytest.raises(ValueError, match=f"{algorithm.__name__} trains policies derived from"):
        algorithm(other, "Pendulum-v1")  # type: ignore[arg-type]


DELIBERATE_DIFFERENCES = {
    # Only policies of flows fit, and the buffer keeps a record.
    "policy": {"annotation"},
    # None, or a number that is not positive, turns clipping off.
    "max_grad_norm": {"annotation"},
    # May be a schedule.
    "ent_coef": {"annotation"},
    # FPO's ratios are those of an average over probes, and move less.
    "clip_range": {"default"},
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


@pytest.mark.parametrize(
    ("algorithm", "options", "message"),
    [
        (FPO, {"n_probes": 0}, "n_probes must be at least 1"),
        (FPO, {"probe_average": "ratio"}, "probe_average must be one of 'loss', 'objective'"),
        (FPO, {"loss_target": "x0"}, "loss_target must be one of 'epsilon', 'velocity'"),
        (FPO, {"loss_reduction": "max"}, "loss_reduction must be one of 'mean', 'sum'"),
        (FPO, {"time_sampler": "beta"}, "time_sampler must be one of"),
        (FPO, {"trust_region": "trpo"}, "trust_region must be one of 'ppo', 'spo', 'aspo'"),
        (FPO, {"loss_clamp": 0.0}, "loss_clamp must be positive, or None"),
        (FPO, {"difference_clamp": -1.0}, "difference_clamp must be positive, or None"),
        (FPO, {"action_noise_std": -0.1}, "action_noise_std must be a number from 0"),
        (FPO, {"solver": "newton"}, "Unknown solver 'newton'"),
        (FPO, {"n_flow_steps": 0}, "n_flow_steps must be at least 1"),
        (FPO, {"n_flow_steps": 2.5}, "and a whole number, got 2.5"),
        (FPO, {"ent_coef": -1.0}, "ent_coef must not be negative"),
        (FPO, {"n_entropy_actions": 1}, "n_entropy_actions must be at least 2"),
        (FPO, {"policy_kwargs": {"solver": "rk4"}}, r"Give \['solver'\] to FPO itself"),
        (DPPO, {"process": "vp"}, "process must be one of 'ddpm', 'flow'"),
        (DPPO, {"n_denoising_steps": 0}, "n_denoising_steps must be at least 1"),
        (DPPO, {"n_finetuned_steps": 11}, "some of the n_denoising_steps=10, got 11"),
        (DPPO, {"min_sampling_std": 0.0}, "min_sampling_std must be positive"),
        (DPPO, {"min_log_prob_std": -1.0}, "min_log_prob_std must be positive"),
        (DPPO, {"log_prob_clamp": (2.0, -5.0)}, "log_prob_clamp must be two numbers in order"),
        (DPPO, {"log_prob_clamp": 3.0}, "log_prob_clamp must be two numbers in order, got 3.0"),
        (DPPO, {"log_prob_reduction": "max"}, "log_prob_reduction must be one of"),
        (DPPO, {"denoising_gamma": 1.5}, r"denoising_gamma must be in \(0, 1\]"),
        (DPPO, {"clip_range_base": 0.0}, "clip_range_base must be positive"),
        (DPPO, {"n_critic_warmup": -1}, "n_critic_warmup must be at least 0"),
        (DPPO, {"n_entropy_states": 0}, "n_entropy_states must be at least 1"),
        (DPPO, {"use_sde": True}, "use_sde=True is not supported"),
    ],
    ids=str,
)
def test_what_cannot_work_is_refused(
    algorithm: Algorithm, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        algorithm("MlpPolicy", "Pendulum-v1", n_steps=16, batch_size=8, **options)
