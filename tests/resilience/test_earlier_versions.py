"""What version 0.1 saved loads, acts as it did and learns on as it would have.

``tests/data/v0.1`` holds, for each algorithm, the model, its policy alone, the statistics of its
``VecNormalize``, and what 0.1 itself made of them. They were made at commit bd8aa99 with torch
2.13, on two Pendulum-v1 with ``max_episode_steps=20``: three rollouts with ``n_steps=32,
batch_size=16, n_epochs=2, seed=7, clip_range_vf=0.2, desired_kl="lin_0.02_0.005",
lr_bounds=(1e-5, 5e-3)``, in ``policy_kwargs`` ``net_arch=[16, 16], embedding_dim=8,
initialisation="glorot"``, and options that are not the defaults, under the names that they had:

- PolicyFlow: ``path="trigflow", n_times=3, time_average="shift", time_sampler="starts",
  n_flow_steps=4, solver="heun", brownian_coef="lin_0.25_0.05", brownian_reduction="mean",
  ent_coef=0.01, uniform_noise_coef=0.1, log_ratio_clamp=0.05, lr_adaptation="minibatch",
  lr_factor=1.2, kl_margin=1.5, advantage_scope="rollout", timeout_bootstrap="current"``; in
  ``policy_kwargs`` ``latent_std=0.5, log_std_init=-0.5, log_std_bounds=(-2.0, 1.0),
  frequencies=[1.0, 2.0], share_features_extractor=False``
- FPO: ``n_probes=4, probe_average="objective", loss_target="velocity", loss_reduction="sum",
  trust_region="aspo", loss_clamp=3.0, difference_clamp=0.1, time_sampler="starts",
  n_flow_steps=4, solver="heun", action_noise_std=0.1, ent_coef=0.01, n_entropy_actions=4,
  n_entropy_states=8, kl_window="update", kl_margin=1.5``
- DPPO: ``n_denoising_steps=5, n_finetuned_steps=3, min_sampling_std=0.2, min_log_prob_std=0.15,
  noise_clip=2.0, denoised_clip=1.5, clip_range_base=0.01, clip_range_rate=2.0,
  denoising_gamma=0.9, log_prob_clamp=(-4.0, 1.0), n_critic_warmup=1, max_grad_norm=None,
  lr_factor=1.3``; in ``policy_kwargs`` ``activation_fn=Mish``

The parameters are those after one more rollout, and so depend on all that the files hold.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.save_util import load_from_zip_file, save_to_zip_file
from stable_baselines3.common.vec_env import VecNormalize
from torch.nn.utils import parameters_to_vector

from sb3_policyflow import FPO, PolicyFlow
from sb3_policyflow.flows import Interpolant
from sb3_policyflow.policyflow.policies import PolicyFlowPolicy

SAVED = Path(__file__).parents[1] / "data" / "v0.1"
# Rounding differs between processors, by less than 1e-6; almost any option makes more than 1e-4.
TOLERANCE: dict[str, Any] = {"rtol": 0.0, "atol": 5e-5}

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def saved(algorithm: type[Any], suffix: str) -> Path:
    return SAVED / f"{algorithm.__name__.lower()}.{suffix}"


def parameters(model: Any) -> th.Tensor:
    """All but the frequencies, which were buffers in 0.1."""
    named = model.policy.named_parameters()
    return parameters_to_vector(p for name, p in named if "frequencies" not in name).detach()


def normalized(algorithm: type[Any]) -> VecNormalize:
    env = make_vec_env("Pendulum-v1", 2, env_kwargs={"max_episode_steps": 20})
    return VecNormalize.load(str(saved(algorithm, "pkl")), env)


@pytest.mark.parametrize("with_env", [False, True])
def test_models_act_as_they_did(algorithm: type[Any], with_env: bool) -> None:
    env = normalized(algorithm) if with_env else None
    model = algorithm.load(saved(algorithm, "zip"), env=env, device="cpu")
    assert model.num_timesteps == 192
    expected = np.load(saved(algorithm, "npz"))
    actions, _ = model.predict(expected["observations"], deterministic=True)
    np.testing.assert_allclose(actions, expected["actions"], **TOLERANCE)


def test_policies_act_as_they_did(algorithm: type[Any]) -> None:
    policy = algorithm.policy_aliases["MlpPolicy"].load(saved(algorithm, "pt"), device="cpu")
    expected = np.load(saved(algorithm, "npz"))
    actions, _ = policy.predict(expected["observations"], deterministic=True)
    np.testing.assert_allclose(actions, expected["actions"], **TOLERANCE)


def test_models_without_options_have_the_defaults_of_0_1(
    algorithm: type[Any], tmp_path: Path
) -> None:
    algorithm("MlpPolicy", "Pendulum-v1", n_steps=32, batch_size=16).save(tmp_path / "model")
    data, parameters, others = load_from_zip_file(tmp_path / "model")
    assert data is not None
    assert data.pop("has_former_defaults") is False  # files of 0.1 do not have it
    save_to_zip_file(tmp_path / "former", data, parameters, others)
    policy = algorithm.load(tmp_path / "former", device="cpu").policy
    assert policy.deterministic_action == "zero"
    if algorithm.__name__ != "DPPO":
        expected = {"PolicyFlow": (1.0, 12), "FPO": (None, 10)}[algorithm.__name__]
        assert (getattr(policy, "latent_std", None), policy.n_flow_steps) == expected


def test_options_under_their_present_names_count_more_than_the_file(tmp_path: Path) -> None:
    """The file has them under their former names; what it has of others stays."""
    interpolated = PolicyFlow.load(saved(PolicyFlow, "zip"), interpolant="rectified", device="cpu")
    assert (interpolated.interpolant, interpolated.n_times) == ("rectified", 3)
    sampled = FPO.load(saved(FPO, "zip"), n_mc_samples=5, device="cpu")
    assert (sampled.n_mc_samples, sampled.mc_average) == (5, "objective")
    adapted = FPO.load(saved(FPO, "zip"), lr_adaptation_kwargs={"factor": 1.9}, device="cpu")
    assert adapted.lr_adaptation_kwargs == {"factor": 1.9}
    adapted.save(tmp_path / "again")
    assert FPO.load(tmp_path / "again", device="cpu").lr_adaptation_kwargs == {"factor": 1.9}
    one = FPO.load(saved(FPO, "zip"), lr_factor=1.9, device="cpu").lr_adaptation_kwargs
    assert (one["factor"], one["window"]) == (1.9, "update")


class OwnDefault(PolicyFlowPolicy):
    """Has a default of its own."""

    def __init__(self, *args: Any, n_flow_steps: int = 4, **kwargs: Any) -> None:
        super().__init__(*args, n_flow_steps=n_flow_steps, **kwargs)


class HandsOn(PolicyFlowPolicy):
    """Gives an option to its base."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, n_flow_steps=3, **kwargs)


@pytest.mark.parametrize(("policy", "n_flow_steps"), [(OwnDefault, 4), (HandsOn, 3)])
def test_policies_of_the_users_own_keep_their_defaults(
    policy: type[Any], n_flow_steps: int, tmp_path: Path
) -> None:
    PolicyFlow(policy, "Pendulum-v1", n_steps=32, batch_size=16).save(tmp_path / "model")
    data, parameters, others = load_from_zip_file(tmp_path / "model")
    assert data is not None
    del data["has_former_defaults"]
    save_to_zip_file(tmp_path / "former", data, parameters, others)
    for path in ("former", "again"):
        model = PolicyFlow.load(tmp_path / path, device="cpu")
        assert (model.policy.n_flow_steps, model.policy.latent_std) == (n_flow_steps, 1.0)
        model.save(tmp_path / "again")


def former_residual(
    self: Interpolant,
    velocity: th.Tensor,
    reference_velocity: th.Tensor,
    points: th.Tensor,
    times: th.Tensor,
    latent_std: float,
) -> th.Tensor:
    """The Brownian residual as 0.1 had it, in the unit of actions and not of latents."""
    score, of_velocity, of_point = (c.unsqueeze(-1) for c in self.score_coefficients(times))
    score_term = (of_point * points - of_velocity * reference_velocity) / latent_std**2
    return score * velocity - score_term


@pytest.mark.parametrize("saved_again", [False, True])
def test_models_learn_on_as_they_would_have(
    algorithm: type[Any], saved_again: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With all their options, by whatever name, and from the random states in the file."""
    monkeypatch.setattr(Interpolant, "brownian_residual", former_residual)
    path = saved(algorithm, "zip")
    if saved_again:
        algorithm.load(path, device="cpu").save(tmp_path / "model.zip")
        path = tmp_path / "model.zip"
    model = algorithm.load(path, env=normalized(algorithm), device="cpu")
    before = parameters(model)
    model.learn(64, reset_num_timesteps=False)
    found = parameters(model)
    expected = np.load(saved(algorithm, "npz"))["parameters"]
    assert (found - before).abs().max() > 1e-3
    np.testing.assert_allclose(found, expected, **TOLERANCE)
