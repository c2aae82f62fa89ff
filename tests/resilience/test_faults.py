"""What goes wrong in environments is named, hangs nothing, and leaves a model that can be saved."""

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecNormalize

from sb3_policyflow import PolicyFlow
from sb3_policyflow.algorithms import ALGORITHMS
from sb3_policyflow.envs.vector import GymVectorVecEnv
from sb3_policyflow.fpo import FPO
from tests.helpers import SMALL, perturb, train, weights, within

FAULT_STEP = 5
EIGHT_STEPS: dict[str, Any] = {**SMALL, "n_steps": 8, "batch_size": 16}


class Faulty(gym.Env[Any, Any]):
    """Counts its steps; something happens at the fifth, and on request at the reset."""

    def __init__(self, fault: str = "none", as_dict: bool = False, limit: int = 100) -> None:
        box = spaces.Box(-np.inf, np.inf, (3,))
        self.as_dict = as_dict
        self.observation_space = spaces.Dict({"state": box}) if as_dict else box
        self.action_space = spaces.Box(-1, 1, (1,))
        self.fault, self.limit = fault, limit

    def observation(self, values: np.ndarray) -> Any:
        values = values.astype(np.float32)
        return {"state": values} if self.as_dict else values

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.time = 0
        return self.observation(np.full(3, np.nan if self.fault == "reset" else 0.0)), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.time += 1
        obs, reward = np.full(3, float(self.time)), 1.0
        if self.time == FAULT_STEP:
            if self.fault == "raises":
                raise LookupError("the gripper is lost")
            if self.fault == "dies":
                os.kill(os.getpid(), signal.SIGKILL)
            if self.fault == "shape":
                obs = np.zeros(4)
            if self.fault == "nan":
                obs[1] = np.nan
            if self.fault == "inf reward":
                reward = np.inf
        if self.fault == "huge" and self.time >= FAULT_STEP:
            reward = 3e38
        return self.observation(obs), reward, False, self.time >= self.limit, {}


def make(fault: str, **options: Any) -> list[Callable[[], gym.Env[Any, Any]]]:
    """Two environments, of which the second is at fault."""
    return [lambda: Faulty(**options), lambda: Faulty(fault, **options)]


def trained(env: VecEnv, **options: Any) -> PolicyFlow:
    policy = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
    return PolicyFlow(policy, env, **{**EIGHT_STEPS, **options})


def assert_saves_and_goes_on(model: PolicyFlow, folder: Path) -> None:
    """Assert that the model can be saved and trained on in another environment."""
    model.save(folder / "model")
    as_dict = isinstance(model.observation_space, spaces.Dict)
    env = DummyVecEnv(make("none", as_dict=as_dict))
    loaded = PolicyFlow.load(folder / "model", env=env)
    assert th.equal(weights(loaded), weights(model))
    train(loaded, 16, reset_num_timesteps=False)


# Faults


def test_an_environment_that_raises(tmp_path: Path) -> None:
    model = trained(DummyVecEnv(make("raises")))
    before = weights(model)
    with pytest.raises(LookupError, match="the gripper is lost"):
        model.learn(100)
    assert th.equal(weights(model), before)
    assert_saves_and_goes_on(model, tmp_path)


@pytest.mark.parametrize(
    "start_method", ["fork", pytest.param("forkserver", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    ("fault", "cause"),
    [
        ("raises", r"environment 1 \(exit code 1\)"),
        ("dies", r"environment 1 \(killed by SIGKILL\)"),
    ],
)
def test_a_worker_that_dies(
    fault: str, cause: str, start_method: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    env = SubprocVecEnv(make(fault), start_method=start_method)
    model = trained(VecNormalize(env))
    with within(300):
        with pytest.raises(RuntimeError, match=rf"has died after timestep 8: {cause}") as caught:
            model.learn(100)
        env.close()
    assert isinstance(caught.value.__cause__, (EOFError, ConnectionError))
    assert not any(process.is_alive() for process in env.processes)
    if fault == "raises" and start_method == "fork":  # a fork server prints where it was started
        assert "LookupError: the gripper is lost" in capfd.readouterr().err
    assert_saves_and_goes_on(model, tmp_path)


def test_a_worker_that_dies_between_steps() -> None:
    env = SubprocVecEnv(make("none"), start_method="fork")
    model = trained(env).learn(16)
    env.processes[0].kill()
    env.processes[0].join()
    with within(300), pytest.raises(RuntimeError, match=r"environment 0 \(killed by SIGKILL\)"):
        model.learn(16, reset_num_timesteps=False)


def test_other_environments_errors_of_this_kind_are_their_own() -> None:
    class Disconnected(Faulty):
        def step(self, action: Any) -> Any:
            raise ConnectionResetError("the robot hung up")

    with pytest.raises(ConnectionResetError, match="the robot hung up"):
        trained(DummyVecEnv([Disconnected, Disconnected])).learn(16)


@pytest.mark.parametrize("as_dict", [False, True])
def test_an_observation_of_another_shape(as_dict: bool, tmp_path: Path) -> None:
    model = trained(DummyVecEnv(make("shape", as_dict=as_dict)))
    with pytest.raises(ValueError, match=r"could not broadcast .* \(4,\) into shape \(3,\)"):
        model.learn(100)
    assert_saves_and_goes_on(model, tmp_path)


def test_observations_of_another_shape_from_all_environments() -> None:
    """A vectorized environment that is not SB3's does not notice."""

    class Batch(VecNormalize):
        def step_wait(self) -> Any:
            _, *rest = super().step_wait()
            return np.zeros((2, 4)), *rest

    model = trained(Batch(DummyVecEnv(make("none"))))
    with pytest.raises(ValueError, match=r"observation has shape \(4,\) at timestep 2, but its sp"):
        model.learn(100)


def test_native_vector_environments_that_raise() -> None:
    mode = gym.vector.AutoresetMode.SAME_STEP
    env = GymVectorVecEnv(gym.vector.SyncVectorEnv(make("raises"), autoreset_mode=mode))
    with pytest.raises(LookupError, match="the gripper is lost"):
        trained(env).learn(100)


# Numbers that are not finite


@pytest.mark.parametrize("as_dict", [False, True])
def test_the_first_observation(as_dict: bool, tmp_path: Path) -> None:
    model = trained(DummyVecEnv(make("reset", as_dict=as_dict)))
    name = "observation 'state'" if as_dict else "observation"
    with pytest.raises(
        FloatingPointError, match=rf"{name} is not finite at timestep 0, in env.* 1"
    ):
        model.learn(100)
    assert_saves_and_goes_on(model, tmp_path)


def test_the_last_observation() -> None:
    model = trained(DummyVecEnv(make("nan", limit=FAULT_STEP)))
    with pytest.raises(FloatingPointError, match=r"terminal observation is not finite .* 10, in"):
        model.learn(100)


@pytest.mark.parametrize("fault", ["nan", "inf reward"])
def test_running_statistics_stay_finite(fault: str, tmp_path: Path) -> None:
    env: Any = VecNormalize(DummyVecEnv(make(fault)))
    model = trained(env)
    with pytest.raises(FloatingPointError, match=r"is not finite at timestep 10, in environment 1"):
        model.learn(100)
    numbers = [env.obs_rms.mean, env.obs_rms.var, env.ret_rms.var, env.returns]
    assert all(np.isfinite(number).all() for number in numbers)
    assert_saves_and_goes_on(model, tmp_path)


def test_actions() -> None:
    model = trained(DummyVecEnv(make("none")))
    with th.no_grad():
        model.policy.velocity.output.bias.fill_(th.inf)
    env = model.get_env()
    assert isinstance(env, DummyVecEnv)
    with pytest.raises(FloatingPointError, match=r"action is not finite, for observation 0"):
        model.learn(16)
    assert [one.unwrapped.time for one in env.envs] == [0, 0]  # they have not seen it


@pytest.mark.parametrize("name", ["PolicyFlow", "FPO", "DPPO", "PPO"])
@pytest.mark.parametrize("deterministic", [True, False])
def test_predicted_actions(name: str, deterministic: bool) -> None:
    """An observation that is not finite has no action, as for PPO."""
    algorithm: Any = {**{kind.__name__: kind for kind in ALGORITHMS.values()}, "PPO": PPO}[name]
    model = algorithm("MlpPolicy", DummyVecEnv(make("none")), **EIGHT_STEPS)
    obs = np.array([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]], dtype=np.float32)
    model.predict(obs[:1], deterministic=deterministic)
    with pytest.raises(ValueError, match="observation 1" if name != "PPO" else "invalid values"):
        model.predict(obs, deterministic=deterministic)
    perturb(model.policy, float("nan"))  # nor has a policy whose parameters are not
    with pytest.raises(ValueError, match="observation 0" if name != "PPO" else "invalid values"):
        model.predict(obs[:1], deterministic=deterministic)


@pytest.mark.filterwarnings("ignore:overflow encountered")
def test_advantages_that_overflow() -> None:
    model = trained(DummyVecEnv(make("huge")), gae_lambda=1.0)
    with pytest.raises(FloatingPointError, match=r"rollout's advantages is not finite at timestep"):
        model.learn(16)


def test_losses(tmp_path: Path) -> None:
    """The parameters of the last good minibatch can be saved, and training goes on from there."""
    model = trained(DummyVecEnv(make("none"))).learn(16)
    model.rollout_buffer.returns[3] = 1e30  # its square overflows
    before = weights(model)
    with pytest.raises(
        FloatingPointError, match=r"The loss is not finite \(loss inf, 16 timesteps"
    ):
        model.train()
    assert th.equal(weights(model), before)
    assert_saves_and_goes_on(model, tmp_path)


def test_log_ratios_can_be_clamped() -> None:
    """A noise that has shrunk makes ratios overflow, unless they are clamped."""

    # Such networks change all samples alike: a ratio that grows with an advantage below zero.
    glorot = {"policy_kwargs": {"initialization": "glorot_zero_output"}, "latent_std": 1.0}

    def update(clamp: float | None) -> PolicyFlow:
        model = trained(DummyVecEnv(make("none")), log_ratio_clamp=clamp, n_epochs=2, **glorot)
        model.learn(16)
        model.rollout_buffer.endpoints -= 100.0  # type: ignore[union-attr]
        with th.no_grad():
            model.policy.log_std.fill_(-3.0)
        model.policy.optimizer.param_groups[0]["lr"] = 0.1
        model.lr_schedule = lambda _: 0.1
        model.train()
        return model

    with pytest.raises(FloatingPointError, match="is not finite"):
        update(None)
    model = update(20.0)
    assert th.isfinite(weights(model)).all()
    assert model.logger.name_to_value["train/log_ratio_max"] > 88  # what it was before


@pytest.mark.parametrize("trust_region", ["ppo", "spo", "aspo"])
def test_trust_regions_may_shrink_to_nothing(trust_region: str) -> None:
    """At the end of a linear schedule the clip range is 0."""
    env = DummyVecEnv(make("none"))
    options = {**EIGHT_STEPS, "n_epochs": 3, "trust_region": trust_region}
    model = FPO("MlpPolicy", env, clip_range=lambda progress: 0.2 * progress, **options)
    assert th.isfinite(weights(model.learn(32))).all()
