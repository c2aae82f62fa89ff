"""IsaacLab's environments without arrays: the same numbers as through its wrapper for SB3."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from fakes import EACH, TASKS, THREE, make_env
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_policyflow import PolicyFlow
from sb3_policyflow.device.environments import tensors_behind
from sb3_policyflow.envs.tensor import TensorVecEnv
from sb3_policyflow.integrations.isaaclab import presets, train
from sb3_policyflow.integrations.isaaclab.lab import LabError, wrap, wrap_for_arrays
from sb3_policyflow.integrations.isaaclab.tensors import IsaacLabTensorEnv
from tests.helpers import TINY, weights
from tests.helpers import train as learn

BOUNDS = (-100.0, 100.0)
OPTIONS: dict[str, Any] = {"n_steps": 16, "batch_size": 64, "n_epochs": 2, "seed": 0}


@pytest.mark.parametrize(("version", "final"), [("two", False), ("three", False), ("three", True)])
@pytest.mark.usefixtures("installed")
def test_same_parameters_as_through_arrays(version: str, final: bool) -> None:
    bootstrap = "terminal" if final else "current"

    def trained(env: Any) -> Any:
        model = PolicyFlow(
            "MlpPolicy",
            env,
            policy_kwargs=TINY,
            timeout_bootstrap=bootstrap,
            device="cpu",
            **OPTIONS,
        )
        return learn(model, 3 * 16 * 16)

    tensors = trained(IsaacLabTensorEnv(make_env(16, final, version), BOUNDS))
    arrays = trained(wrap_for_arrays(make_env(16, final, version), BOUNDS))
    assert tensors_behind(tensors.env) is not None
    assert th.equal(weights(tensors), weights(arrays))
    returns = [[episode["r"] for episode in model.ep_info_buffer] for model in (tensors, arrays)]
    assert len(returns[0]) == len(returns[1]) > 50
    np.testing.assert_allclose(*returns, rtol=1e-5)


@EACH
@pytest.mark.usefixtures("installed")
def test_what_was_returned_does_not_change(version: str) -> None:
    env = IsaacLabTensorEnv(make_env(64, version=version), BOUNDS)
    assert isinstance(env, TensorVecEnv)
    env.seed(0)
    observations = env.reset()
    kept = observations.clone()
    steps, copies = [], []
    for _ in range(12):
        step = env.step(th.ones(64, 2))
        steps.append(step)
        copies.append([part.clone() for part in step if part is not None])
    assert th.equal(observations, kept)
    for step, copy in zip(steps, copies, strict=True):
        assert all(map(th.equal, [part for part in step if part is not None], copy))
    assert sum(len(step.ended) for step in steps) > 64
    for step in steps:
        assert th.equal(step.ended, (step.terminated | step.truncated).nonzero().flatten())


@THREE
@pytest.mark.usefixtures("installed")
def test_spaces() -> None:
    env = make_env()
    unbounded = IsaacLabTensorEnv(env, (-1.0, 1.0))
    assert unbounded.action_space == spaces.Box(-1, 1, (2,))
    assert unbounded.observation_space == env.unwrapped.single_observation_space["policy"]
    env.unwrapped.single_action_space = spaces.Box(-3, 3, (2,))
    assert IsaacLabTensorEnv(env).action_space == spaces.Box(-3, 3, (2,))


@THREE
@pytest.mark.usefixtures("installed")
def test_seeding_leaves_the_policys_generators_alone() -> None:
    """IsaacLab's own seed sets those of NumPy and torch."""
    env = IsaacLabTensorEnv(make_env())
    th.manual_seed(1)
    expected = th.randn(3)
    th.manual_seed(1)
    env.seed(7)
    assert th.equal(th.randn(3), expected)
    first = env.reset()
    env.seed(7)
    assert th.equal(env.reset(), first)


@THREE
@pytest.mark.parametrize("bounds", [(1.0, -1.0), (-np.inf, 1.0), (0.0, 0.0)])
@pytest.mark.usefixtures("installed")
def test_bounds_that_are_none(bounds: tuple[float, float]) -> None:
    with pytest.raises(LabError, match="two finite numbers, the lower one first"):
        wrap(make_env(), bounds)


@THREE
@pytest.mark.usefixtures("installed")
def test_several_agents() -> None:
    env = make_env()
    del env.unwrapped.single_observation_space
    with pytest.raises(LabError, match="LabEnv has several agents"):
        wrap(env, BOUNDS)


@EACH
@pytest.mark.usefixtures("installed")
def test_images_go_through_isaaclabs_wrapper(version: str) -> None:
    env = make_env(version=version)
    assert tensors_behind(wrap(env, BOUNDS)) is not None
    camera = spaces.Box(0.0, 1.0, (32, 32, 3))
    env.unwrapped.single_observation_space["policy"] = camera
    with pytest.raises(ValueError, match=r"use IsaacLab's isaaclab_rl\.sb3\.Sb3VecEnvWrapper"):
        IsaacLabTensorEnv(env)
    assert tensors_behind(wrap(env, BOUNDS)) is None
    if version == "two":
        with pytest.raises(LabError, match="by -100 and 100, not by -1 and 1"):
            wrap(env, (-1.0, 1.0))


@EACH
@pytest.mark.usefixtures("installed")
def test_the_script_collects_tensors(version: str, tmp_path: Path) -> None:
    """With ``VecNormalize`` around them, on the simulator's device."""
    env = wrap(make_env(16, version=version), BOUNDS)
    options = train.make_parser().parse_args(["--task", TASKS[version], "--log_dir", str(tmp_path)])
    given = {**presets.flat_anymal_d(), "n_steps": 8}
    agent, _, _ = train.read_agent(given, 16, 2, 0)
    model = train.train(env, agent, 256, {"normalize_input": True}, options)
    assert isinstance(model.get_env(), VecNormalize)
    assert tensors_behind(model.env) is not None
    assert isinstance(model.rollout_buffer.rewards, th.Tensor)
    assert model.device == th.device("cpu")
