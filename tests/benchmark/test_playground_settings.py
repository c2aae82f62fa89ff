"""The benchmark on MuJoCo Playground, as far as it goes without Playground."""

from pathlib import Path

import pytest
from gymnasium import spaces

pytest.importorskip("rl_zoo3")

from sb3_policyflow.benchmark.experiment import make_experiment
from sb3_policyflow.benchmark.playground import ROLLOUTS, VARIANTS

LATENT_STDS = {"policyflow": 1.0, "policyflow-latent0.3": 0.3}
"""The paper's, and narrower ones."""


@pytest.mark.parametrize("name", VARIANTS)
def test_each_algorithm_takes_its_settings(name: str, tmp_path: Path) -> None:
    """In another environment, with rollouts of the same size for all."""
    algo, hyperparams = VARIANTS[name].algo, VARIANTS[name].hyperparams
    # This environment's learning rate follows the divergence, which allows no schedule.
    pendulum = {"desired_kl": None} if algo == "policyflow" else {}
    settings = algo, "Pendulum-v1", 16384, 0, str(tmp_path), hyperparams | pendulum
    model = make_experiment(*settings).model
    assert isinstance(model.action_space, spaces.Box)
    assert model.n_envs * model.n_steps == 16384
    assert model.policy.net_arch == {"pi": [32] * 4, "vf": [128] * 3}
    assert model.lr_schedule(0.5) == pytest.approx(float(hyperparams["learning_rate"][4:]) / 2)
    assert {key: getattr(model, key) for key in ROLLOUTS} == ROLLOUTS
    if name in LATENT_STDS:
        assert model.policy.latent_std == LATENT_STDS[name]
    for key in hyperparams.keys() & {"min_sampling_std", "min_log_prob_std"}:
        assert getattr(model.policy, key) == hyperparams[key]
