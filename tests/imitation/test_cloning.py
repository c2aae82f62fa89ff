"""Cloning: what a model is after it, and how it may be interrupted."""

from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.imitation import Demonstrations, clone
from tests.helpers import SMALL, TINY, learned, weights
from tests.imitation.short import ALGORITHMS, SHORT, pendulum, shown


class Interruption(BaseCallback):
    """Stops the process, or what stands for it, after some calls."""

    def __init__(self, after: int) -> None:
        super().__init__()
        self._after = after

    def _on_step(self) -> bool:
        if self.n_calls == self._after:
            raise KeyboardInterrupt
        return True


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_seed_decides(algorithm: type[Any]) -> None:
    models = [clone(pendulum(algorithm), shown(), seed=seed, **SHORT) for seed in (1, 1, 2)]
    same, again, other = map(weights, models)
    assert th.equal(same, again)
    assert not th.equal(same, other)


def test_the_seed_is_the_models_own_by_default() -> None:
    one, two = (clone(pendulum(PolicyFlow), shown(), **SHORT) for _ in range(2))
    named = clone(pendulum(PolicyFlow), shown(), seed=SMALL["seed"], **SHORT)
    assert th.equal(weights(one), weights(two))
    assert th.equal(weights(one), weights(named))


def test_nothing_else_is_drawn() -> None:
    model = pendulum(PolicyFlow)
    th.manual_seed(5)
    np.random.seed(5)
    expected = th.rand(1), np.random.rand()
    th.manual_seed(5)
    np.random.seed(5)
    clone(model, shown(), **SHORT)
    assert (th.rand(1), np.random.rand()) == expected


@pytest.mark.parametrize("algorithm", [PolicyFlow, DPPO])
def test_an_interrupted_cloning_continues_to_the_last_bit(
    algorithm: type[Any], tmp_path: Path
) -> None:
    checkpoint = tmp_path / "state"
    whole = clone(pendulum(algorithm), shown(), **SHORT)
    with pytest.raises(KeyboardInterrupt):
        clone(
            pendulum(algorithm), shown(), callback=Interruption(27), checkpoint=checkpoint, **SHORT
        )
    assert checkpoint.is_file()
    np.random.seed(99)
    rest = clone(pendulum(algorithm), shown(), checkpoint=checkpoint, **SHORT)
    assert th.equal(weights(rest), weights(whole))
    assert not checkpoint.exists()


def interrupted(model: Any, demonstrations: Any, **options: Any) -> Path:
    """The checkpoint of a cloning that was interrupted after its second validation."""
    with pytest.raises(KeyboardInterrupt):
        clone(model, demonstrations, callback=Interruption(20), **options)
    return Path(options["checkpoint"])


def numbered(n_episodes: int = 4) -> Demonstrations:
    observations, actions = shown()
    return Demonstrations(observations, actions, np.arange(256) % n_episodes)


@pytest.mark.parametrize(
    "demonstrations",
    [
        Demonstrations(*shown(300)),
        Demonstrations(*shown()),
        numbered(5),
        numbered()._replace(actions=-numbered().actions),
        numbered()._replace(observations=numbered().observations + 1e-3),
    ],
    ids=["more of them", "without episodes", "other episodes", "other actions", "other places"],
)
def test_a_checkpoint_of_other_demonstrations_is_refused(
    demonstrations: Demonstrations, tmp_path: Path
) -> None:
    options = {**SHORT, "checkpoint": tmp_path / "state"}
    interrupted(pendulum(FPO), numbered(), **options)
    with pytest.raises(ValueError, match="name another checkpoint, or delete it"):
        clone(pendulum(FPO), demonstrations, **options)
    clone(pendulum(FPO), numbered(), **options)


def test_other_dictionaries_are_other_demonstrations() -> None:
    one, two = (Demonstrations({"a": np.zeros((2, 1)), "b": x}, np.ones((2, 1))) for x in np.eye(2))
    renamed = Demonstrations({"b": np.zeros((2, 1)), "a": np.eye(2)[0]}, np.ones((2, 1)))
    digests = [shown.digest() for shown in (one, two, renamed)]
    assert len(set(digests)) == 3
    again = Demonstrations({"b": np.eye(2)[0], "a": np.zeros((2, 1))}, np.ones((2, 1)))
    assert again.digest() == one.digest()


@pytest.mark.parametrize(
    ("options", "model"),
    [
        ({"learning_rate": 1e-4}, {}),
        ({"learning_rate": lambda _: 1e-3}, {}),
        ({"batch_size": 16}, {}),
        ({}, {"algorithm": DPPO}),
        ({}, {"n_flow_steps": 3}),
        ({}, {"policy_kwargs": {"net_arch": [9]}}),
    ],
    ids=["rate", "function", "batch size", "algorithm", "steps", "networks"],
)
def test_a_checkpoint_of_other_options_or_networks_is_refused(
    options: dict[str, Any], model: dict[str, Any], tmp_path: Path
) -> None:
    same = {**SHORT, "learning_rate": 1e-3, "checkpoint": tmp_path / "state"}
    interrupted(pendulum(FPO), shown(), **same)
    with pytest.raises(ValueError, match="name another checkpoint, or delete it"):
        clone(pendulum(**{"algorithm": FPO, **model}), shown(), **{**same, **options})


def test_files_that_are_no_checkpoint_are_refused(tmp_path: Path) -> None:
    options = {**SHORT, "checkpoint": tmp_path / "state"}
    state = th.load(interrupted(pendulum(FPO), shown(), **options), weights_only=False)
    names = ("gradient_steps", "batch_size", "validation_fraction", "eval_freq", "seed")
    earlier = {name: state["settings"][name] for name in names}
    earlier |= {"n": 256, "parameters": state["settings"]["parameters"]}
    for name, content in {
        "earlier": {**state, "settings": earlier},
        "weights": {"weights": 1},
        "list": [1],
    }.items():
        th.save(content, tmp_path / name)
    pendulum(FPO).save(tmp_path / "model.zip")
    (tmp_path / "text").write_bytes(b"text")
    (tmp_path / "empty").touch()
    for name in ("earlier", "weights", "list", "model.zip", "text", "empty"):
        with pytest.raises(ValueError, match=f"{name} is not the state .* or delete it"):
            clone(pendulum(FPO), shown(), **{**SHORT, "checkpoint": tmp_path / name})
        assert (tmp_path / name).is_file()


def test_training_goes_on_with_the_same_numbers_after_a_file(tmp_path: Path) -> None:
    model = clone(pendulum(PolicyFlow, imitation_coef=0.1), shown(), **SHORT)
    model.save(tmp_path / "model")
    loaded = PolicyFlow.load(tmp_path / "model", env=gym.make("Pendulum-v1"))
    env = gym.make("Pendulum-v1")
    fresh = PolicyFlow.load(tmp_path / "model", env=env)
    one, two = loaded.learn(32), fresh.learn(32)
    assert th.equal(weights(one), weights(two))
    assert not th.equal(weights(one), weights(model))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_only_the_actor_learns(algorithm: type[Any]) -> None:
    model = pendulum(algorithm)
    critic = [parameter.clone() for parameter in model.policy.critic_parameters()]
    before = model.policy.velocity.output.weight.clone()
    clone(model, shown(), **SHORT)
    assert all(map(th.equal, critic, model.policy.critic_parameters()))
    assert not th.equal(model.policy.velocity.output.weight, before)
    assert all(th.isfinite(parameter).all() for parameter in learned(model.policy))


def test_the_frozen_steps_of_dppo_are_those_that_were_cloned() -> None:
    model = clone(pendulum(DPPO, n_finetuned_steps=2), shown(), **SHORT)
    trained, base = model.policy.velocity, model.policy.base_velocity
    assert all(map(th.equal, trained.parameters(), base.parameters()))
    model.learn(32)
    assert not all(map(th.equal, trained.parameters(), base.parameters()))


def test_the_noise_starts_small() -> None:
    observations, actions = shown()
    model = clone(pendulum(PolicyFlow, log_std_init=0.0), (observations, actions), **SHORT)
    spread = 0.1 * 2.0  # the bounds of Pendulum's action are -2 and 2
    assert model.policy.log_std.exp().item() == pytest.approx(spread)
    clone(model, (observations, actions), noise_std=0.25, **SHORT)
    assert model.policy.log_std.exp().item() == pytest.approx(0.25)


class Moving(gym.Env[Any, Any]):
    """Takes actions between some bounds."""

    observation_space = spaces.Box(-1, 1, (3,))

    def __init__(self, low: list[float], high: list[float]) -> None:
        self.action_space = spaces.Box(np.float32(low), np.float32(high))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        return np.zeros(3, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return np.zeros(3, np.float32), 0.0, True, False, {}


def test_the_noise_of_bounds_that_mean_nothing_is_that_of_minus_one_and_one() -> None:
    low, high = [-1, 0, -100, -3.4e38, 0.5], [1, 4, 100, 3.4e38, 0.5]
    model = PolicyFlow("MlpPolicy", Moving(low, high), policy_kwargs=TINY, **SMALL)
    observations, _ = shown()
    clone(model, (observations, np.full((256, 5), 0.5)), **SHORT)
    stds = model.policy.log_std.detach().exp().numpy()
    np.testing.assert_allclose(stds, [0.1, 0.2, 0.1, 0.1, 1e-7], rtol=1e-5)
    clone(model, (observations, np.full((256, 5), 0.5)), noise_std=0.3, **SHORT)
    np.testing.assert_allclose(model.policy.log_std.detach().exp(), 0.3, rtol=1e-5)


def test_bounds_of_the_noise_that_are_in_the_way_are_named() -> None:
    model = pendulum(PolicyFlow, policy_kwargs={"log_std_bounds": (-0.5, 2.0)})
    with pytest.warns(UserWarning, match="log_std_bounds"):
        clone(model, shown(), noise_std=0.1, **SHORT)


def test_a_gaussian_learns_mean_and_deviation() -> None:
    rng = np.random.default_rng(0)
    observations = rng.standard_normal((4096, 3)).astype(np.float32)
    actions = 0.5 + 0.3 * rng.standard_normal((4096, 1))
    options = {"gradient_steps": 300, "learning_rate": "lin_0.02", "batch_size": 256}
    for model in (
        pendulum(PolicyFlow, gaussian=True, n_flow_steps=2),
        PPO("MlpPolicy", "Pendulum-v1", seed=0),
    ):
        clone(model, (observations, actions), **options)
        drawn = model.predict(np.zeros((4096, 3), np.float32))[0]
        assert drawn.mean() == pytest.approx(0.5, abs=0.05)
        assert drawn.std() == pytest.approx(0.3, rel=0.1)


def test_the_best_parameters_are_kept_and_cloning_stops_early() -> None:
    model = pendulum(PolicyFlow)
    calls: list[int] = []
    options = {**SHORT, "gradient_steps": 400, "learning_rate": 3.0, "patience": 2}
    log = configure(None, [])
    model.set_logger(log)
    losses: list[float] = []

    def watch(local_variables: Any, _: Any) -> bool:
        calls.append(1)
        losses.append(log.name_to_value.get("imitation/best_validation_loss", np.inf))
        return True

    clone(model, shown(), callback=watch, **options)
    assert len(calls) < 400
    assert all(th.isfinite(parameter).all() for parameter in learned(model.policy))


@pytest.mark.parametrize("validation_fraction", [0.0, 0.1])
@pytest.mark.parametrize("n_steps", [7, 17, 20])
def test_a_callback_stops_it_and_what_was_learned_is_kept(
    n_steps: int, validation_fraction: float
) -> None:
    """Before the first validation, between two of them, and at one."""
    steps: list[int] = []

    def stop(*_: Any) -> bool:
        steps.append(1)
        return len(steps) < n_steps

    options = {**SHORT, "learning_rate": 1e-3, "validation_fraction": validation_fraction}
    stopped = clone(pendulum(FPO), shown(), callback=stop, **options)
    assert len(steps) == n_steps
    short = clone(pendulum(FPO), shown(), **{**options, "gradient_steps": n_steps})
    assert th.equal(weights(stopped), weights(short))
    assert not th.equal(weights(stopped), weights(pendulum(FPO)))


def test_callbacks_save_and_logs_are_written(tmp_path: Path) -> None:
    model = pendulum(PolicyFlow)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    callback = CheckpointCallback(save_freq=20, save_path=str(tmp_path))
    clone(model, shown(), callback=callback, progress_bar=True, **SHORT)
    assert list(tmp_path.glob("rl_model_*.zip"))
    lines = (tmp_path / "progress.csv").read_text().splitlines()
    names = ("loss", "validation_loss", "best_validation_loss", "learning_rate", "gradient_steps")
    assert set(lines[0].split(",")) == {f"imitation/{name}" for name in names}
    assert len(lines) == 1 + 4


@pytest.mark.parametrize("share", [True, False])
def test_images(share: bool) -> None:
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=3, discrete=False)
    policy_kwargs = {**TINY, "share_features_extractor": share}
    model = PolicyFlow("CnnPolicy", env, policy_kwargs=policy_kwargs, **SMALL)
    observations = np.stack([env.observation_space.sample() for _ in range(24)])
    assert observations.shape == (24, 36, 36, 3)  # SB3 puts the channels first
    actions = np.stack([env.action_space.sample() for _ in range(24)])
    extractor = next(model.policy.pi_features_extractor.parameters())
    before = extractor.clone()
    clone(model, (observations, actions), gradient_steps=3, batch_size=8, validation_fraction=0)
    assert not th.equal(extractor, before)
    channels_first = observations.transpose(0, 3, 1, 2)
    clone(model, (channels_first, actions), gradient_steps=1, batch_size=8)


def test_dictionaries() -> None:
    env = make_vec_env(lambda: SimpleMultiObsEnv(random_start=False, discrete_actions=False))
    model = FPO("MultiInputPolicy", env, policy_kwargs=TINY, **SMALL)
    space: Any = env.observation_space
    samples = [space.sample() for _ in range(16)]
    observations = {key: np.stack([sample[key] for sample in samples]) for key in space.spaces}
    actions = np.stack([env.action_space.sample() for _ in range(16)])
    clone(model, (observations, actions), gradient_steps=2, batch_size=8)
    del observations["vec"]
    with pytest.raises(ValueError, match=r"do not fit the model: their observations are .* Dict\("):
        clone(model, (observations, actions), gradient_steps=2)


def test_statistics_are_taken_from_the_demonstrations_and_kept() -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=2))
    observations, actions = shown()
    observations = 5 + 3 * observations
    model = PolicyFlow("MlpPolicy", env, policy_kwargs=TINY, **SMALL)
    clone(model, (observations, actions), **SHORT)
    statistics: Any = env.obs_rms
    np.testing.assert_allclose(statistics.mean, observations.mean(0), rtol=1e-6)
    np.testing.assert_allclose(statistics.var, observations.var(0), rtol=1e-6)
    assert statistics.count == 256
    clone(model, (observations - 5, actions), **SHORT)
    np.testing.assert_allclose(statistics.mean, observations.mean(0), rtol=1e-6)


def test_a_policy_learns_from_normalized_observations() -> None:
    observations, actions = shown()
    mean, std = observations.mean(0), np.sqrt(observations.var(0) + 1e-8)
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=2))
    one = PolicyFlow("MlpPolicy", env, policy_kwargs=TINY, **SMALL)
    clone(one, (observations, actions), **SHORT)
    two = clone(pendulum(PolicyFlow), ((observations - mean) / std, actions), **SHORT)
    assert th.allclose(weights(one), weights(two), atol=1e-4)


# What is refused


@pytest.mark.parametrize(
    ("observations", "actions", "what"),
    [
        (np.zeros((8, 4)), np.zeros((8, 1)), r"observations are arrays of shape \(4,\).*Box\(.*8"),
        (np.zeros((8, 3)), np.zeros((8, 2)), r"actions are arrays of shape \(2,\).*Box\(-2"),
        (np.zeros((8, 3)), np.zeros((9, 1)), "as many observations as actions"),
        (np.zeros((0, 3)), np.zeros((0, 1)), "at least one"),
        (np.zeros((8, 3)), np.full((8, 1), np.nan), "finite numbers"),
        ({"a": np.zeros((8, 3))}, np.zeros((8, 1)), "do not fit the model"),
    ],
)
def test_demonstrations_that_do_not_fit(observations: Any, actions: Any, what: str) -> None:
    with pytest.raises(ValueError, match=what):
        clone(pendulum(PolicyFlow), (observations, actions))


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"gradient_steps": 0}, "gradient_steps must be at least 1"),
        ({"batch_size": 0}, "batch_size must be at least 1"),
        ({"learning_rate": "fast"}, "learning_rate must be a number, a string such as"),
        ({"noise_std": -1.0}, "noise_std must be positive"),
        ({"validation_fraction": 1.0}, "validation_fraction must be a number from 0.0 to 0.9"),
        ({"patience": 0}, "patience must be at least 1"),
    ],
)
def test_options_that_cannot_be_used(options: dict[str, Any], what: str) -> None:
    model = pendulum(PolicyFlow)
    before = weights(model)
    with pytest.raises(ValueError, match=what):
        clone(model, shown(), **options)
    assert th.equal(weights(model), before)


def test_an_option_that_does_not_exist() -> None:
    with pytest.raises(TypeError, match=r"clone has no argument 'steps'.*gradient_steps"):
        clone(pendulum(PolicyFlow), shown(), steps=10)


def test_a_refusal_leaves_the_model_and_its_statistics_as_they_were(tmp_path: Path) -> None:
    (tmp_path / "other").write_text("not the state of a cloning")
    for algorithm, error, options in (
        (SAC, TypeError, {}),
        (PolicyFlow, TypeError, {"steps": 10}),
        (PolicyFlow, ValueError, {"checkpoint": tmp_path / "other"}),
    ):
        env = VecNormalize(make_vec_env("Pendulum-v1"))
        model = algorithm("MlpPolicy", env, seed=0)
        before, statistics = weights(model), deepcopy(env.obs_rms)
        with pytest.raises(error):
            clone(model, shown(), **options)
        assert th.equal(weights(model), before)
        assert vars(env.obs_rms)["count"] == vars(statistics)["count"]
        np.testing.assert_array_equal(vars(env.obs_rms)["mean"], vars(statistics)["mean"])


@pytest.mark.parametrize("algorithm", [SAC, TD3])
def test_a_model_that_is_not_on_policy(algorithm: type[Any]) -> None:
    with pytest.raises(TypeError, match=f"{algorithm.__name__} cannot be cloned .*use PolicyFlow"):
        clone(algorithm("MlpPolicy", "Pendulum-v1"), shown())


def test_observations_that_are_not_finite_stop_it() -> None:
    observations, actions = shown()
    observations[5] = np.nan
    with pytest.raises(FloatingPointError, match="not finite among the observations"):
        clone(pendulum(PolicyFlow), (observations, actions), batch_size=256)


def test_discrete_observations() -> None:
    class Counting(gym.Env[Any, Any]):
        observation_space = spaces.Discrete(5)
        action_space = spaces.Box(-1, 1, (1,))

        def reset(
            self, *, seed: int | None = None, options: Any = None
        ) -> tuple[int, dict[str, Any]]:
            return 0, {}

        def step(self, action: Any) -> tuple[int, float, bool, bool, dict[str, Any]]:
            return 0, 0.0, True, False, {}

    model = PolicyFlow("MlpPolicy", Counting(), policy_kwargs=TINY, **SMALL)
    actions = np.zeros((10, 1))
    clone(model, (np.arange(10) % 5, actions), gradient_steps=2)
    with pytest.raises(ValueError, match=r"the model's are Discrete\(5\)"):
        clone(model, (np.arange(10), actions))
