"""The deterministic action of a flow policy: one of its own, where they lie densely."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.dppo import DPPOPolicy
from sb3_policyflow.export import ActionModule
from sb3_policyflow.flows import Flow
from sb3_policyflow.flows.modes import candidate_latents, densest
from sb3_policyflow.fpo import FPOPolicy
from sb3_policyflow.kernels import KernelVelocityField
from sb3_policyflow.policyflow import PolicyFlowPolicy
from tests.helpers import SMALL, TINY

OBSERVATIONS = spaces.Box(-1, 1, (3,))
ACTIONS = spaces.Box(-1, 1, (2,))
algorithms = pytest.mark.parametrize("algorithm", [PolicyFlow, FPO, DPPO])


class TwoModes:
    """Latents end at -0.6 and 0.6 in each dimension, but z = 0 ends between them."""

    def transport(self, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        return 0.6 * th.tanh(500 * latents)


class TwoModesPolicyFlow(TwoModes, PolicyFlowPolicy):
    pass


class TwoModesFPO(TwoModes, FPOPolicy):
    pass


@pytest.mark.parametrize("policy_class", [TwoModesPolicyFlow, TwoModesFPO])
def test_is_in_a_mode_where_zero_is_between(policy_class: type[Any]) -> None:
    policy = policy_class(OBSERVATIONS, ACTIONS, lambda _: 1e-3)
    action = policy.predict(np.zeros(3, np.float32), deterministic=True)[0]
    np.testing.assert_allclose(np.abs(action), 0.6, atol=0.01)
    policy.deterministic_action = "zero"
    between = policy.predict(np.zeros(3, np.float32), deterministic=True)[0]
    np.testing.assert_allclose(between, 0, atol=1e-6)


class ShiftedFlow(Flow):
    """Ends at 0.25, whatever the field says."""

    def solve(self, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        return th.full_like(latents, 0.25)


class WithShiftedFlow(FPOPolicy):
    @property
    def flow(self) -> Flow:
        return ShiftedFlow(*super().flow)


class ShiftedField(KernelVelocityField, has_formula_of_paper=True):
    def integrate(self, latents: th.Tensor, features: th.Tensor, **_: Any) -> th.Tensor:
        return th.full_like(latents, 0.25)


class OtherField(nn.Module):
    def integrate(self, latents: th.Tensor, features: th.Tensor, **_: Any) -> th.Tensor:
        return th.full_like(latents, 0.25)


@pytest.mark.parametrize("kind", ["flow", "field", "module", "function"])
def test_what_carries_latents_is_what_the_choice_is_made_by(kind: str) -> None:
    """However it was replaced."""
    policy_class = WithShiftedFlow if kind == "flow" else FPOPolicy
    policy: Any = policy_class(OBSERVATIONS, ACTIONS, lambda _: 1e-3)
    if kind == "field":
        policy.velocity = ShiftedField(2, 3, [8])
    if kind == "module":
        policy.velocity = OtherField()
    if kind == "function":
        policy.transport = lambda latents, features: th.full_like(latents, 0.25)
    action = policy.predict(np.zeros(3, np.float32), deterministic=True)[0]
    np.testing.assert_array_equal(action, [0.25, 0.25])


def test_the_mode_of_one_cluster_is_near_its_center() -> None:
    """Untrained, the end points are the latents; nearest to all of them is z = 0, the first."""
    assert densest(candidate_latents(6).unsqueeze(0)).item() == 0


@pytest.mark.parametrize("dim", [1, 2, 6, 17])
def test_the_larger_cluster_wins(dim: int) -> None:
    """20 points around +1 and 12 around -1 in each dimension, far from zero, in any order."""
    generator = th.Generator().manual_seed(0)
    for _ in range(20):
        signs = th.ones(32)
        signs[:12] = -1
        signs = signs[th.randperm(32, generator=generator)]
        noise = 0.1 * th.randn(32, dim, generator=generator)
        chosen = densest((100 + signs.unsqueeze(1) + noise).unsqueeze(0)).item()
        assert signs[int(chosen)] == 1


@algorithms
def test_is_an_action_of_the_policy_and_repeatable(algorithm: type[Any]) -> None:
    model = algorithm("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, **SMALL).learn(64)
    obs = np.stack([model.observation_space.sample() for _ in range(4)])
    together = model.predict(obs, deterministic=True)[0]
    th.randn(10)  # no draw of anybody matters
    for row, action in zip(obs, together, strict=True):
        alone = model.predict(row, deterministic=True)[0]
        np.testing.assert_allclose(alone, action, rtol=1e-5, atol=1e-6)
    policy = model.policy
    with th.no_grad():
        features = policy.actor_features(th.as_tensor(obs))
        latents, endpoints = policy.draw_latents(features, deterministic=True)
        assert endpoints is not None
        assert th.equal(policy.transport(latents, features), endpoints)
        candidates = policy.latent_scale * candidate_latents(policy.action_dim)
        assert all((candidates == latent).all(dim=1).any() for latent in latents)
        module = ActionModule(policy)
        np.testing.assert_allclose(module(th.as_tensor(obs)).numpy(), together, atol=1e-5)


PREDICT = """
import sys
import numpy as np
from sb3_policyflow import PolicyFlow
model = PolicyFlow.load(sys.argv[1])
np.save(sys.argv[2], model.predict(np.ones((3, 3), np.float32), deterministic=True)[0])
"""


@pytest.mark.slow
def test_is_the_same_in_another_process(tmp_path: Path) -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs=TINY, **SMALL).learn(64)
    model.save(tmp_path / "model")
    files = [str(tmp_path / "model"), str(tmp_path / "actions.npy")]
    subprocess.run([sys.executable, "-c", PREDICT, *files], check=True)
    expected = model.predict(np.ones((3, 3), np.float32), deterministic=True)[0]
    np.testing.assert_array_equal(np.load(files[1]), expected)


def test_former_name_of_the_option() -> None:
    with pytest.warns(DeprecationWarning, match="random_latents is now deterministic_action"):
        policy = FPOPolicy(OBSERVATIONS, ACTIONS, lambda _: 1e-3, random_latents=True)
    assert policy.deterministic_action == "drawn"
    with pytest.warns(DeprecationWarning, match="deterministic_action"):
        policy.random_latents = False
    assert policy.deterministic_action == "zero"


def test_a_chain_starts_at_fixed_latents() -> None:
    """DPPO's, whose steps then have no noise."""
    policy = DPPOPolicy(OBSERVATIONS, ACTIONS, lambda _: 1e-3)
    _, record = policy.sample_actions(th.zeros(5, 3), deterministic=True)
    starts = candidate_latents(2)
    assert all((starts == start).all(dim=1).any() for start in record.points[:, 0])
