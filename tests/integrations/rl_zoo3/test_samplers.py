import contextvars
import warnings

import gymnasium as gym
import numpy as np
import optuna
import pytest
from gymnasium import spaces
from optuna.samplers import RandomSampler
from optuna.trial import FixedTrial
from stable_baselines3.common.env_util import make_vec_env

from sb3_policyflow import PolicyFlow
from sb3_policyflow.algorithms import ALGORITHMS
from sb3_policyflow.integrations.rl_zoo3.samplers import (
    SAMPLERS,
    TASK,
    Task,
    convert_flow_params,
)

N_ENVS = [1, 3, 8, 24, 32, 1000, 1024, 4096]


def test_every_algorithm_has_a_search_space() -> None:
    assert SAMPLERS.keys() == ALGORITHMS.keys()


@pytest.fixture(params=ALGORITHMS)
def algo(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def draws(algo: str, n_envs: int, number: int) -> list[tuple[optuna.Trial, dict[str, object]]]:
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=RandomSampler(seed=n_envs))
    trials = [study.ask() for _ in range(number)]
    return [(trial, SAMPLERS[algo](trial, 2, n_envs, {})) for trial in trials]


@pytest.mark.parametrize("n_envs", N_ENVS)
def test_sizes_fit_the_environments(algo: str, n_envs: int) -> None:
    for _, hyperparams in draws(algo, n_envs, 100):
        rollout = hyperparams["n_steps"] * n_envs
        assert rollout % hyperparams["batch_size"] == 0
        assert 8 <= hyperparams["batch_size"] <= rollout // 4
        assert hyperparams["n_steps"] >= 8
        assert 2**9 < rollout <= max(2**15, 2**7 * n_envs)


@pytest.mark.parametrize("n_envs", [1, 24, 1024])
def test_raw_values_make_the_same_hyperparameters_again(algo: str, n_envs: int) -> None:
    for trial, hyperparams in draws(algo, n_envs, 20):
        again = convert_flow_params(trial.params)
        assert again.pop("n_envs") == n_envs
        assert again == hyperparams
        assert hyperparams == SAMPLERS[algo](FixedTrial(trial.params), 2, n_envs, {})
        for name, value in trial.user_attrs.items():
            assert hyperparams[name] == value


@pytest.mark.parametrize(
    ("algo", "old_names"),
    [
        ("policyflow", {"interpolant": "path"}),
        ("fpo", {"n_mc_samples": "n_probes", "mc_average": "probe_average"}),
    ],
)
def test_studies_of_earlier_versions_can_be_read(algo: str, old_names: dict[str, str]) -> None:
    for trial, _ in draws(algo, 4, 5):
        old = {old_names.get(name, name): value for name, value in trial.params.items()}
        assert old.keys() != trial.params.keys()
        assert convert_flow_params(old) == convert_flow_params(trial.params)


@pytest.mark.slow
def test_whatever_is_drawn_can_be_constructed_and_learns(algo: str) -> None:
    """All of it but the long rollouts and many epochs, which are a matter of patience."""
    env = make_vec_env("Pendulum-v1", n_envs=4)
    for _, hyperparams in draws(algo, 4, 20):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            ALGORITHMS[algo](env=env, policy="MlpPolicy", **hyperparams)  # type: ignore[call-arg]
        short = {**hyperparams, "n_steps": 8, "batch_size": 16, "n_epochs": 2}
        ALGORITHMS[algo](env=env, policy="MlpPolicy", **short).learn(64)  # type: ignore[call-arg]


def test_every_choice_is_drawn_and_reaches_the_policy() -> None:
    env = gym.make("Pendulum-v1")
    drawn = [hyperparams for _, hyperparams in draws("policyflow", 1, 100)]
    assert {params["interpolant"] for params in drawn} == {"rectified", "stochastic", "trigflow"}
    assert {params["solver"] for params in drawn} == {"euler", "midpoint", "heun", "ab2"}
    assert {params["desired_kl"] for params in drawn} == {None, 0.005, 0.01, 0.02}
    spread = [params["policy_kwargs"].get("latent_std") for params in drawn]  # type: ignore[attr-defined]
    stochastic = [params["interpolant"] == "stochastic" for params in drawn]
    assert [std is None for std in spread] == stochastic
    assert all(0.1 <= std <= 1 for std in spread if std is not None)
    model = PolicyFlow("MlpPolicy", env, **drawn[0])
    assert model.policy.solver == drawn[0]["solver"]
    assert model.policy.n_flow_steps == drawn[0]["n_flow_steps"]
    assert model.policy.embedding_dim == drawn[0]["policy_kwargs"]["embedding_dim"]


def draws_for(task: Task, algo: str, n_envs: int = 1, number: int = 50) -> list[dict[str, object]]:
    def draw() -> list[dict[str, object]]:
        TASK.set(task)
        return [hyperparams for _, hyperparams in draws(algo, n_envs, number)]

    return contextvars.copy_context().run(draw)


@pytest.mark.parametrize("n_timesteps", [500, 4_000, 100_000, 10_000_000])
@pytest.mark.parametrize("n_envs", [1, 8, 1024])
def test_short_trials_have_short_rollouts(algo: str, n_timesteps: int, n_envs: int) -> None:
    for hyperparams in draws_for(Task(n_timesteps), algo, n_envs):
        n_steps, batch_size = int(hyperparams["n_steps"]), int(hyperparams["batch_size"])  # type: ignore[call-overload]
        rollout = n_steps * n_envs
        # Ten updates, unless the environments alone take more.
        assert 10 * rollout <= n_timesteps or n_steps <= max(8, 32 // n_envs)
        assert 8 <= batch_size <= rollout // 4
        assert rollout <= max(2**15, 2**7 * n_envs)


def test_the_spread_is_drawn_on_the_scale_of_the_actions() -> None:
    task = Task.of(10**6, spaces.Box(-5.0, 5.0, (3,)))
    assert task.action_scale == 5.0
    drawn = draws_for(task, "policyflow", number=200)
    stds = [params["policy_kwargs"].get("latent_std") for params in drawn]  # type: ignore[attr-defined]
    stds = [std for std in stds if std is not None]
    assert 0.5 <= min(stds) < 1
    assert 2.5 < max(stds) <= 5
    coefs = np.array([params["brownian_coef"] for params in drawn], dtype=float)
    assert 1e-4 <= coefs.min() < 1e-3
    assert 0.1 < coefs.max() <= 0.5


@pytest.mark.parametrize(
    ("half_widths", "scale"),
    [
        ([np.inf, np.inf], 1.0),
        ([100.0, 3.4e38], 1.0),
        ([2.0, 4.0, 100.0, 3.4e38, np.inf], 3.0),
        ([0.0, 1.0], 0.5),
    ],
)
def test_bounds_that_mean_nothing_have_no_scale(half_widths: list[float], scale: float) -> None:
    bounds = np.array(half_widths, dtype=np.float32)
    task = Task.of(10, spaces.Box(-bounds, bounds))
    assert task.action_scale == pytest.approx(scale, rel=1e-5)
