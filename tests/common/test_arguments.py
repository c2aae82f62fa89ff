"""What cannot work is refused with a sentence, before training."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.envs import IdentityEnv, IdentityEnvBox, SimpleMultiObsEnv
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import LinearSchedule

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.common.buffers import DictFlowRolloutBuffer, FlowRolloutBuffer
from sb3_policyflow.policyflow import MlpFlowPolicy
from tests.helpers import SMALL


@pytest.mark.parametrize(
    "space",
    [spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(4)],
    ids=lambda space: type(space).__name__,
)
def test_actions_that_are_not_continuous(space: spaces.Space[Any]) -> None:
    with pytest.raises(ValueError, match=r"need continuous actions.*use PPO of stable_baselines3"):
        PolicyFlow("MlpPolicy", IdentityEnv(space=space), **SMALL)


@pytest.mark.parametrize("dtype", [np.int32, np.uint8])
def test_actions_that_are_whole_numbers(dtype: type[np.generic]) -> None:
    env = IdentityEnvBox()
    env.action_space = spaces.Box(0, 100, (1,), dtype)
    with pytest.raises(ValueError, match=rf"the actions are {dtype.__name__}: declare a Box"):
        PolicyFlow("MlpPolicy", env, **SMALL)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"use_sde": True}, r"use_sde=True is not supported: leave it out"),
        ({"rollout_buffer_class": RolloutBuffer}, r"needs a rollout buffer that stores.*derive"),
        ({"n_flow_steps": 0}, r"n_flow_steps must be at least 1"),
        ({"n_flow_steps": None}, r"n_flow_steps must be at least 1, and a whole number, got None"),
        (
            {"interpolant": "straight"},
            r"interpolant must be one of 'rectified', 'stochastic', .*'straight'",
        ),
        ({"solver": "dopri5"}, r"solver must be one of 'euler', 'midpoint', .*, got 'dopri5'"),
        (
            {"time_sampler": "beta"},
            r"time_sampler must be one of 'grid', 'grid_without_end', 'uniform'",
        ),
        ({"n_times": 0}, r"n_times must be at least 1"),
        ({"time_average": "ratio"}, r"time_average must be one of 'objective', 'shift'"),
        ({"brownian_coef": -0.1}, r"brownian_coef must not be negative"),
        ({"ent_coef": -0.1}, r"ent_coef must not be negative"),
        ({"brownian_coef": "linear"}, r"brownian_coef must be a number"),
        ({"brownian_reduction": "max"}, r"brownian_reduction must be one of 'sum', 'mean'"),
        ({"desired_kl": 0.0}, r"desired_kl must be positive or None"),
        ({"desired_kl": 0.01, "learning_rate": LinearSchedule(1e-3, 0, 1)}, r"not a schedule"),
        (
            {"lr_adaptation_kwargs": {"bounds": None}},
            r"bounds must be two numbers in order, got None",
        ),
        ({"lr_adaptation_kwargs": {"bounds": (0.0, 1e-3)}}, r"bounds must be positive"),
        ({"lr_adaptation_kwargs": {"factor": 0.5}}, r"factor must be greater than 1, got 0.5"),
        ({"lr_adaptation_kwargs": {"margin": 0.5}}, r"margin must be a number from 1.0 to inf"),
        ({"max_grad_norm": float("nan")}, r"max_grad_norm must be a number"),
        ({"max_grad_norm": "a"}, r"max_grad_norm must be a number"),
        ({"target_kl": -1.0}, r"target_kl must be positive"),
        ({"n_epochs": 2.5}, r"n_epochs must be at least 1, and a whole number"),
        ({"policy_kwargs": {"log_std_bounds": (2.0, -5.0)}}, r"log_std_bounds must be two numbers"),
        ({"policy_kwargs": {"log_std_bounds": (-1,)}}, r"log_std_bounds must be two numbers"),
        (
            {"policy_kwargs": {"log_std_init": float("nan")}},
            r"log_std_init must be a finite number",
        ),
        ({"policy_kwargs": {"frequencies": 0}}, r"frequencies must be a list of numbers"),
        ({"policy_kwargs": {"frequencies": 2.5}}, r"frequencies must be a list of numbers"),
        ({"policy_kwargs": {"latent_std": 0.0}}, r"latent_std must be positive, got 0.0"),
        (
            {"policy_kwargs": {"latent_std": 0.5}, "interpolant": "stochastic"},
            r"leave out latent_std, or use interpolant='rectified'",
        ),
        (
            {"policy_kwargs": {"latent_std": 0.5}, "gaussian": True},
            r"latents are 0: leave out latent_std",
        ),
        (
            {"lr_adaptation_kwargs": {"interval": "step"}},
            r"interval must be one of 'epoch', 'minibatch'",
        ),
        ({"lr_adaptation_kwargs": {"window": "all"}}, r"window must be one of 'epoch', 'update'"),
        ({"advantage_scope": "all"}, r"advantage_scope must be one of 'minibatch', 'rollout'"),
        ({"timeout_bootstrap": "yes"}, r"timeout_bootstrap must be one of 'terminal', 'current'"),
        ({"learning_rate": -1e-3}, r"learning_rate must not be negative nor infinite, got -0\.001"),
        ({"learning_rate": None}, r"learning_rate must be a number, a string .* got None"),
        ({"clip_range": -0.2}, r"clip_range must not be negative"),
        ({"clip_range": 0.0}, r"clip_range must be positive, got 0\.0"),
        ({"gamma": 1.5}, r"gamma must be a number from 0.0 to 1.0, got 1.5"),
        ({"gae_lambda": float("nan")}, r"gae_lambda must be a number from 0.0 to 1.0, got nan"),
        ({"batch_size": 1}, r"batch_size must be at least 2"),
        ({"n_steps": 0}, r"n_steps must be at least 1"),
        ({"n_epochs": 0}, r"n_epochs must be at least 1"),
        ({"clip_range_vf": -0.2}, r"clip_range_vf must not be negative"),
        (
            {"policy_kwargs": {"initialization": "he"}},
            r"initialization must be one of 'orthogonal', .*, got 'he'",
        ),
        ({"policy_kwargs": {"embedding_dim": 0}}, r"embedding_dim must be at least 1"),
        (
            {"policy_kwargs": {"solver": "rk4"}, "solver": "rk4"},
            r"Give \['solver'\] to PolicyFlow or in policy_kwargs, not to both",
        ),
        ({"policy_kwargs": {"solver": "newton"}}, r"solver must be one of .*, got 'newton'"),
        (
            {"lr_adaptation_kwargs": {"speed": 2}},
            r"lr_adaptation_kwargs must be a dictionary of interval",
        ),
        ({"lr_adaptation_kwargs": 1.5}, r"lr_adaptation_kwargs must be a dictionary of interval"),
    ],
    ids=str,
)
def test_options_of_policyflow(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PolicyFlow("MlpFlowPolicy", "Pendulum-v1", **{**SMALL, **options})


@pytest.mark.parametrize(
    ("algorithm", "options", "message"),
    [
        (FPO, {"n_mc_samples": 0}, "n_mc_samples must be at least 1"),
        (FPO, {"mc_average": "ratio"}, "mc_average must be one of 'loss', 'objective'"),
        (FPO, {"loss_target": "x0"}, "loss_target must be one of 'epsilon', 'velocity'"),
        (FPO, {"loss_reduction": "max"}, "loss_reduction must be one of 'mean', 'sum'"),
        (FPO, {"time_sampler": "beta"}, "time_sampler must be one of"),
        (FPO, {"trust_region": "trpo"}, "trust_region must be one of 'ppo', 'spo', 'aspo'"),
        (FPO, {"loss_clamp": 0.0}, "loss_clamp must be positive, got 0.0"),
        (FPO, {"difference_clamp": -1.0}, "difference_clamp must be positive, got -1.0"),
        (FPO, {"action_noise_std": -0.1}, "action_noise_std must be a number from 0"),
        (FPO, {"solver": "newton"}, "solver must be one of 'euler', .*, got 'newton'"),
        (FPO, {"n_flow_steps": 0}, "n_flow_steps must be at least 1"),
        (FPO, {"n_flow_steps": 2.5}, "and a whole number, got 2.5"),
        (FPO, {"ent_coef": -1.0}, "ent_coef must not be negative"),
        (FPO, {"n_entropy_actions": 1}, "n_entropy_actions must be at least 2"),
        (
            FPO,
            {"policy_kwargs": {"solver": "rk4"}, "solver": "rk4"},
            r"Give \['solver'\] to FPO or in policy_kwargs, not to both",
        ),
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
        (DPPO, {"clip_range_base": 0.5, "clip_range": 0.1}, r"0.5 is .* rises to clip_range=0.1"),
        (DPPO, {"n_critic_warmup": -1}, "n_critic_warmup must be at least 0"),
        (DPPO, {"n_entropy_states": 0}, "n_entropy_states must be at least 1"),
        (DPPO, {"use_sde": True}, "use_sde=True is not supported"),
    ],
    ids=str,
)
def test_options_of_fpo_and_dppo(
    algorithm: type[Any], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        algorithm("MlpPolicy", "Pendulum-v1", **{**SMALL, **options})


def test_options_that_do_not_exist_are_not_swallowed() -> None:
    with pytest.raises(TypeError, match="brownian"):
        PolicyFlow("MlpFlowPolicy", "Pendulum-v1", brownian=0.1)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="full_std"):
        PolicyFlow("MlpFlowPolicy", "Pendulum-v1", policy_kwargs={"full_std": True})


def test_policies_of_another_kind() -> None:
    with pytest.raises(
        ValueError, match=r"derived from PolicyFlowPolicy, not ActorCriticPolicy: use"
    ):
        PolicyFlow(ActorCriticPolicy, "Pendulum-v1")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="GaussianPolicy"):
        PolicyFlow("GaussianPolicy", "Pendulum-v1")


@pytest.mark.parametrize("policy", ["MlpPolicy", "MlpFlowPolicy", "CnnFlowPolicy", MlpFlowPolicy])
def test_flat_policy_for_dict_observations(policy: Any) -> None:
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        PolicyFlow(policy, SimpleMultiObsEnv(discrete_actions=False))


def test_an_adaptation_of_nothing_is_announced() -> None:
    with pytest.warns(UserWarning, match="have no effect: .* desired_kl, which is None"):
        PolicyFlow("MlpPolicy", "Pendulum-v1", lr_adaptation_kwargs={"factor": 2.0}, **SMALL)


@pytest.mark.parametrize("zero", [0.0, "0", "lin_0"])
def test_coefficients_of_zero_in_any_form(zero: Any) -> None:
    coefficients = dict.fromkeys(("brownian_coef", "uniform_noise_coef", "imitation_coef"), zero)
    PolicyFlow("MlpPolicy", "Pendulum-v1", gaussian=True, **coefficients, **SMALL).learn(16)


@pytest.mark.parametrize(
    ("env", "buffer"),
    [
        (SimpleMultiObsEnv(discrete_actions=False), FlowRolloutBuffer),
        ("Pendulum-v1", DictFlowRolloutBuffer),
    ],
    ids=["array buffer", "dict buffer"],
)
def test_buffers_for_other_observations(env: Any, buffer: type[RolloutBuffer]) -> None:
    policy = "MlpPolicy" if isinstance(env, str) else "MultiInputPolicy"
    with pytest.raises(ValueError, match=rf"{buffer.__name__} does not store .*: leave out"):
        PolicyFlow(policy, env, rollout_buffer_class=buffer, **SMALL)


def test_learning_without_an_environment(tmp_path: Path) -> None:
    PolicyFlow("MlpPolicy", "Pendulum-v1", **SMALL).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"no environment to learn in: give one to load"):
        PolicyFlow.load(tmp_path / "model").learn(16)


def test_truncated_minibatches_are_announced() -> None:
    with pytest.warns(UserWarning, match="last minibatch of each epoch will have 4 samples"):
        PolicyFlow("MlpPolicy", "Pendulum-v1", n_steps=20, batch_size=8)


def test_likelihoods_are_refused() -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", **SMALL)
    obs, _ = model.policy.obs_to_tensor(gym.make("Pendulum-v1").reset()[0])
    with pytest.raises(TypeError, match="no closed-form likelihood"):
        model.policy.evaluate_actions(obs, obs)
