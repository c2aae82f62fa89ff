"""What an ExperimentManager of rl_zoo3 does for our algorithms and environments, in process."""

import argparse
import importlib.util
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

import sb3_policyflow  # registers
from sb3_policyflow.envs import PLAYGROUND_TASKS
from sb3_policyflow.envs.multigoal import MultiGoalVectorEnv
from sb3_policyflow.envs.native import make_native_vec_env
from sb3_policyflow.envs.vector import GymVectorVecEnv
from sb3_policyflow.integrations.rl_zoo3.experiment import choose_config, hyperparams_folder
from tests.helpers import TwoWays

if importlib.util.find_spec("rl_zoo3") is None:
    pytest.skip("rl_zoo3 is not installed", allow_module_level=True)

from rl_zoo3 import exp_manager
from rl_zoo3.exp_manager import ExperimentManager

SIMULATORS = {
    "LunarLanderContinuous-v3": "Box2D",
    "BipedalWalker-v3": "Box2D",
    "PointMaze_Medium_Diverse_GDense-v3": "gymnasium_robotics",
    "PointMazeMultiGoal-Medium-v0": "gymnasium_robotics",
    **dict.fromkeys((f"Playground/{task}-v0" for task in PLAYGROUND_TASKS), "mujoco_playground"),
    **dict.fromkeys(
        [
            "HalfCheetah-v5",
            "Hopper-v5",
            "Walker2d-v5",
            "Ant-v5",
            "Humanoid-v5",
            "Swimmer-v5",
            "Reacher-v5",
        ],
        "mujoco",
    ),
}
ENTRIES = [
    (path.stem, name)
    for path in sorted(hyperparams_folder().glob("*.yml"))
    for name in yaml.safe_load(path.read_text())
]


class Wrapper(gym.Wrapper):  # type: ignore[type-arg]
    """An environment wrapper for a YAML file to name."""


def manager(folder: Path, algo: str, env_id: str, **options: Any) -> ExperimentManager:
    defaults = {"eval_freq": -1, "log_interval": -1, "seed": 1, "verbose": 0, "device": "cpu"}
    arguments = {**defaults, **options}
    return ExperimentManager(argparse.Namespace(), algo, env_id, str(folder), **arguments)


@pytest.mark.slow
@pytest.mark.parametrize(("algo", "name"), ENTRIES)
def test_every_entry_runs(
    algo: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulator = SIMULATORS.get(name)
    if simulator and importlib.util.find_spec(simulator) is None:
        pytest.skip(f"{simulator} is not installed")
    env_id = "InvertedPendulum-v5" if name == "default" else name
    if name == "default" and importlib.util.find_spec("mujoco") is None:
        pytest.skip("mujoco is not installed")
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log here
    given = yaml.safe_load((hyperparams_folder() / f"{algo}.yml").read_text())[name]
    shorter = {"n_steps": 4, "batch_size": 2 * given.get("n_envs", 1), "n_epochs": 1}
    experiment = manager(
        tmp_path, algo, env_id, n_timesteps=4 * given.get("n_envs", 1), hyperparams=shorter
    )
    assert experiment.config == str(hyperparams_folder() / f"{algo}.yml")
    model, saved = experiment.setup_experiment()
    assert saved == {**given, **shorter}
    assert model.n_envs == given.get("n_envs", 1)
    if simulator == "mujoco_playground" and name != "Playground/CartpoleBalance-v0":
        return  # each task takes up to a minute to compile
    experiment.learn(model)
    assert model.num_timesteps == 4 * model.n_envs
    experiment.save_trained_model(model)


@pytest.mark.parametrize(
    ("algo", "env_id", "ours"),
    [
        ("policyflow", "CartPole-v1", True),
        ("ppo", "MultiGoal-v0", True),
        ("ppo", "HalfCheetah-v5", True),
        ("ppo", "HalfCheetah-v4", False),
        ("ppo", "CartPole-v1", False),
        ("ppo", "InvertedPendulum-v5", False),
        ("sac", "MultiGoal-v0", False),
    ],
)
def test_their_files_come_first(tmp_path: Path, algo: str, env_id: str, ours: bool) -> None:
    folder = hyperparams_folder() if ours else Path(exp_manager.__file__).parent / "hyperparams"
    experiment = manager(tmp_path, algo, env_id)
    assert Path(experiment.config) == folder / f"{algo}.yml"


def test_a_given_file_is_used(tmp_path: Path) -> None:
    experiment = manager(tmp_path, "policyflow", "MultiGoal-v0", config="mine.yml")
    assert experiment.config == "mine.yml"


def test_an_algorithm_without_any_file_is_left_to_rl_zoo3() -> None:
    assert choose_config("other", "MultiGoal-v0", "theirs/other.yml") == "theirs/other.yml"


def test_native_vectorization_is_seeded_and_monitored(tmp_path: Path) -> None:
    def first_observations(seed: int) -> Any:
        experiment = manager(tmp_path / str(seed), "policyflow", "MultiGoal-v0", seed=seed)
        env = experiment.create_envs(64)
        assert isinstance(env, VecMonitor)
        assert isinstance(env.venv, GymVectorVecEnv)
        assert isinstance(env.venv.env.unwrapped, MultiGoalVectorEnv)
        observations = env.reset()
        env.close()
        return observations

    assert np.array_equal(first_observations(1), first_observations(1))
    assert not np.array_equal(first_observations(1), first_observations(2))
    assert len(list(tmp_path.rglob("*.monitor.csv"))) == 4  # one for each call


def test_native_vectorization_respects_env_kwargs(tmp_path: Path) -> None:
    kwargs = {"max_episode_steps": 3}
    experiment = manager(tmp_path, "policyflow", "MultiGoal-v0", env_kwargs=kwargs)
    env = experiment.create_envs(2)
    env.reset()
    steps = [env.step(np.zeros((2, 2), dtype=np.float32)) for _ in range(3)]
    assert [dones.tolist() for _, _, dones, _ in steps] == [[False] * 2, [False] * 2, [True] * 2]
    assert [info["episode"]["l"] for info in steps[-1][3]] == [3, 3]


def test_an_env_wrapper_is_put_around_each_environment(tmp_path: Path) -> None:
    wrapper = {"env_wrapper": f"{__name__}.Wrapper", "n_envs": 2, "batch_size": 48}
    experiment = manager(tmp_path, "policyflow", "MultiGoal-v0", hyperparams=wrapper)
    model, _ = experiment.setup_experiment()
    assert model.env.env_is_wrapped(Wrapper) == [True, True]


@pytest.mark.parametrize(
    ("algo", "env_id", "options", "expected"),
    [
        # Resets in the next step, which SB3 has no notion of.
        ("policyflow", "CartPole-v1", {}, DummyVecEnv),
        # Neither the algorithm nor the environment is ours.
        ("ppo", "CartPole-v1", {}, DummyVecEnv),
        ("ppo", "MultiGoal-v0", {}, VecMonitor),
        ("policyflow", "Pendulum-v1", {}, DummyVecEnv),
        pytest.param(
            *("policyflow", "MultiGoal-v0", {"vec_env_type": "subproc"}, SubprocVecEnv),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_when_native_vectorization_is_used(
    tmp_path: Path, algo: str, env_id: str, options: dict[str, str], expected: type
) -> None:
    env = manager(tmp_path, algo, env_id, **options).create_envs(2)
    assert type(env) is expected
    assert env.num_envs == 2
    env.close()


def test_a_picture_for_people_is_left_to_gymnasium(monkeypatch: pytest.MonkeyPatch) -> None:
    """It puts a wrapper around each environment."""
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    human = {"render_mode": "human"}
    with pytest.warns(UserWarning, match="HumanRendering"):
        env = make_vec_env("MultiGoal-v0", 2, vec_env_cls=make_native_vec_env, env_kwargs=human)  # type: ignore[arg-type]
    assert type(env) is DummyVecEnv
    assert env.reset().shape == (2, 4)
    env.close()


def test_schedules_of_our_own_parameters(tmp_path: Path) -> None:
    schedules = {"brownian_coef": "lin_0.5_0.1", "ent_coef": "lin_0.01", "n_envs": 2}
    experiment = manager(tmp_path, "policyflow", "Pendulum-v1", hyperparams=schedules)
    model, _ = experiment.setup_experiment()
    assert (model.brownian_coef, model.ent_coef) == ("lin_0.5_0.1", "lin_0.01")


def evaluated(experiment: ExperimentManager) -> Any:
    """Whether the evaluations of an experiment act deterministically."""
    experiment.setup_experiment()
    [callback] = [each for each in experiment.callbacks if isinstance(each, EvalCallback)]
    return callback.deterministic


def test_evaluations_are_stochastic_by_one_key(tmp_path: Path) -> None:
    quick = {"n_timesteps": 64, "n_envs": 1, "policy": "MlpPolicy"}
    (tmp_path / "mine.yml").write_text(
        yaml.safe_dump({"Pendulum-v1": {**quick, "deterministic_eval": False}})
    )
    for algo in ("policyflow", "ppo"):
        options = {"config": str(tmp_path / "mine.yml"), "eval_freq": 32}
        assert not evaluated(manager(tmp_path, algo, "Pendulum-v1", **options))
        # What -params gives comes last.
        options["hyperparams"] = {"deterministic_eval": True}
        assert evaluated(manager(tmp_path, algo, "Pendulum-v1", **options))
    assert evaluated(manager(tmp_path, "policyflow", "Pendulum-v1", eval_freq=32))
    wrong = manager(tmp_path, "ppo", "Pendulum-v1", hyperparams={"deterministic_eval": "no"})
    with pytest.raises(SystemExit, match="must be True or False, got 'no'"):
        wrong.setup_experiment()


@pytest.mark.parametrize("deterministic", [True, False])
def test_the_value_of_a_trial_is_that_of_the_chosen_evaluation(
    deterministic: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []
    predict = sb3_policyflow.PolicyFlow.predict

    def watched(self: Any, *args: Any, deterministic: bool = False, **kwargs: Any) -> Any:
        asked.append(deterministic)
        return predict(self, *args, deterministic=deterministic, **kwargs)

    monkeypatch.setattr(sb3_policyflow.PolicyFlow, "predict", watched)
    experiment = manager(
        tmp_path,
        "policyflow",
        "Pendulum-v1",
        optimize_hyperparameters=True,
        n_timesteps=400,
        n_trials=1,
        n_evaluations=1,
        n_eval_episodes=1,
        no_optim_plots=True,
        hyperparams={"deterministic_eval": deterministic},
    )
    experiment.setup_experiment()
    experiment.hyperparameters_optimization()
    assert set(asked) == {deterministic}


def test_a_misspelt_hyperparameter_ends_the_command_with_a_sentence(tmp_path: Path) -> None:
    experiment = manager(tmp_path, "policyflow", "Pendulum-v1", hyperparams={"n_epoch": 3})
    with pytest.raises(SystemExit, match=r"no hyperparameter 'n_epoch': did you mean n_epochs"):
        experiment.setup_experiment()


@pytest.mark.parametrize("deterministic", [True, False])
def test_the_user_is_told_of_a_deterministic_action_between_modes(
    deterministic: bool, tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    gym.register("TwoWays-v0", TwoWays)
    try:
        experiment = manager(
            tmp_path,
            "policyflow",
            "TwoWays-v0",
            n_timesteps=64,
            eval_freq=64,
            hyperparams={
                "deterministic_eval": deterministic,
                "n_envs": 1,
                "n_steps": 64,
                "batch_size": 64,
                "normalize": False,
            },
        )
        experiment.learn(experiment.setup_experiment()[0])
    finally:
        del gym.registry["TwoWays-v0"]
    told = [str(each.message) for each in recwarn if "may be too few" in str(each.message)]
    assert len(told) == deterministic
    assert all("-params deterministic_eval:False" in text for text in told)
