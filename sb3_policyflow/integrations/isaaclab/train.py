"""Training PolicyFlow on a task of IsaacLab."""

import argparse
import importlib
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_policyflow.distributed.ranks import current
from sb3_policyflow.envs.tensor import TensorEnvAdapter
from sb3_policyflow.integrations.isaaclab.checkpoint import Checkpoint, read_checkpoint
from sb3_policyflow.integrations.isaaclab.lab import (
    Configured,
    Lab,
    LabError,
    find_lab,
    prepare_timeouts,
    wrap,
)
from sb3_policyflow.integrations.isaaclab.presets import AGENT_KEY
from sb3_policyflow.policyflow import PolicyFlow
from sb3_policyflow.resilience.checkpoints import RolloutCheckpointCallback

NORMALIZATION = ("normalize_input", "normalize_value", "clip_obs")
"""Keys that configure ``VecNormalize`` in IsaacLab's files for Stable-Baselines3."""


def main(arguments: list[str]) -> int:
    """The command.

    :param arguments: Arguments of the command line.
    :return: The exit code.
    :raises SystemExit: With a sentence that says what to change, if it cannot run.
    """
    parser = make_parser()
    try:
        lab = _find_lab_unless_asked_for_help(parser, arguments)
        lab.add_arguments(parser)
        options, overrides = parser.parse_known_args(arguments)
        if options.checkpoint is not None:
            options.checkpoint = read_checkpoint(options.checkpoint, overrides)
        with lab.launched(options, overrides) as configured:
            run(configured, options)
    except LabError as error:
        raise SystemExit(str(error)) from error
    return 0


def _find_lab_unless_asked_for_help(parser: argparse.ArgumentParser, arguments: list[str]) -> Lab:
    try:
        return find_lab()
    except LabError:
        parser.parse_known_args(arguments)
        raise


def make_parser() -> argparse.ArgumentParser:
    """The arguments of the script, to which IsaacLab adds those of its launcher."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_policyflow.integrations.isaaclab",
        description="Train PolicyFlow on a task of IsaacLab.",
        epilog="Whatever else is given goes to Hydra, such as agent.learning_rate=1e-3.",
    )
    parser.add_argument("--task", required=True, help="the task's id")
    parser.add_argument(
        "--num_envs", type=int, help="environments, instead of the task's own number"
    )
    parser.add_argument(
        "--seed", type=int, help="seed, instead of that of the hyperparameters or the model"
    )
    parser.add_argument("--max_iterations", type=int, help="updates, instead of agent.n_timesteps")
    parser.add_argument(
        "--agent", default=AGENT_KEY, help="key of the hyperparameters in the registry"
    )
    parser.add_argument(
        "--checkpoint",
        type=Path,
        help="a model to resume, with its own hyperparameters, for as many timesteps again",
    )
    parser.add_argument("--save_interval", type=int, default=50, help="updates between checkpoints")
    parser.add_argument(
        "--log_dir",
        type=Path,
        help="folder, instead of logs/sb3_policyflow/TASK/TIME",
    )
    parser.add_argument(
        "--action_bounds",
        type=float,
        nargs=2,
        default=(-100.0, 100.0),
        metavar=("LOW", "HIGH"),
        help="for actions that have none of their own",
    )
    return parser


def run(configured: Configured, options: argparse.Namespace) -> PolicyFlow:
    """Make the environment, and train in it.

    :param configured: The task; its configuration is changed in place.
    :param options: The parsed command line, with the :class:`Checkpoint` that it names.
    :return: The trained model.
    :raises LabError: If torchrun has started several processes.
    """
    if current().size > 1:
        raise LabError(
            "This command trains in one process: start it without torchrun. In a script of your "
            "own, each process makes its environment and calls learn, see docs/distributed.md."
        )
    config = configured.env
    if options.num_envs is not None:
        config.scene.num_envs = options.num_envs
    if getattr(options, "device", None) is not None:
        config.sim.device = options.device
    saved = {} if options.checkpoint is None else options.checkpoint.hyperparameters
    agent, n_timesteps, normalization = read_agent(
        {**configured.agent, **saved}, config.scene.num_envs, options.max_iterations, options.seed
    )
    config.seed = agent["seed"]
    prepare_timeouts(config, agent.get("timeout_bootstrap", "terminal"))
    env = gym.make(options.task, cfg=config)
    try:
        venv = wrap(env, tuple(options.action_bounds))
        return train(venv, agent, n_timesteps, normalization, options)
    finally:
        env.close()


def read_agent(
    agent: dict[str, Any], n_envs: int, n_iterations: int | None, seed: int | None
) -> tuple[dict[str, Any], int, dict[str, Any]]:
    """Split hyperparameters of the registry into what constructs, trains and normalizes.

    :param agent: The hyperparameters in the registry's form.
    :param n_envs: Number of environments.
    :param n_iterations: Number of updates, instead of ``n_timesteps``.
    :param seed: Seed, instead of theirs.
    :return: Arguments of :class:`PolicyFlow`, the number of timesteps, and the options of
        :data:`NORMALIZATION`.
    :raises LabError: If the number of timesteps is missing.
    """
    agent = importlib.import_module("isaaclab_rl.sb3").process_sb3_cfg(dict(agent), n_envs)
    agent["seed"] = agent.get("seed") if seed is None else seed
    n_timesteps = agent.pop("n_timesteps", None)
    if n_iterations is not None:
        n_timesteps = n_iterations * agent["n_steps"] * n_envs
    if n_timesteps is None:
        raise LabError(
            "The hyperparameters have no n_timesteps: give --max_iterations, or agent.n_timesteps."
        )
    normalization = {name: agent.pop(name) for name in NORMALIZATION if name in agent}
    return agent, int(n_timesteps), normalization


def train(
    env: VecEnv,
    agent: dict[str, Any],
    n_timesteps: int,
    normalization: dict[str, Any],
    options: argparse.Namespace,
) -> PolicyFlow:
    """Train, and write models, statistics and logs.

    :param env: The wrapped environment.
    :param agent: Arguments of :class:`PolicyFlow`.
    :param n_timesteps: Number of timesteps.
    :param normalization: See :data:`NORMALIZATION`.
    :param options: The parsed command line, with the :class:`Checkpoint` that it names.
    :return: The trained model.
    """
    moment = time.strftime("%Y-%m-%d_%H-%M-%S")
    folder = options.log_dir or Path("logs", "sb3_policyflow", options.task, moment)
    # Tensors of the simulator stay where it is, and so does the model.
    device = env.env.device if isinstance(env, TensorEnvAdapter) else "auto"
    env = normalized(env, normalization, agent.get("gamma", 0.99), options.checkpoint)
    if options.checkpoint is None:
        model = PolicyFlow(
            agent.pop("policy"),
            env,
            verbose=1,
            tensorboard_log=str(folder),
            **{"device": device, **agent},
        )
    else:
        # A seed restarts the random generators; without one they continue.
        seed = {} if options.seed is None else {"seed": options.seed}
        model = PolicyFlow.load(
            options.checkpoint.path,
            env=env,
            device=device,
            tensorboard_log=str(folder),
            **seed,
        )
    callback = RolloutCheckpointCallback(
        options.save_interval * model.n_steps,
        str(folder),
        "model",
        save_vecnormalize=True,
        verbose=1,
    )
    model.learn(n_timesteps, callback, reset_num_timesteps=options.checkpoint is None)
    model.save(folder / "model.zip")
    if isinstance(env, VecNormalize):
        env.save(str(folder / "model_vecnormalize.pkl"))
    return model


def normalized(
    env: VecEnv, options: dict[str, Any], gamma: float, checkpoint: Checkpoint | None
) -> VecEnv:
    """Put ``VecNormalize`` around an environment, if its hyperparameters or the model ask for it.

    :param env: The environment.
    :param options: See :data:`NORMALIZATION`.
    :param gamma: Discount factor, which scales rewards.
    :param checkpoint: A model to resume, which is normalized as it was, whatever the options say.
    """
    if checkpoint is not None:
        if checkpoint.statistics is None:
            return env
        checkpoint.statistics.set_venv(env)
        return checkpoint.statistics
    if not (options.get("normalize_input") or options.get("normalize_value")):
        return env
    return VecNormalize(
        env,
        norm_obs=options.get("normalize_input", False),
        norm_reward=options.get("normalize_value", False),
        clip_obs=options.get("clip_obs", 100.0),
        clip_reward=np.inf,
        gamma=gamma,
    )
