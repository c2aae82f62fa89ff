"""Episodes that a policy or a controller has been through, and files of them."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_policyflow.imitation.demonstrations import (
    MINARI,
    Demonstrations,
    Observations,
    import_minari,
    load_demonstrations,
    rows,
)

Act = Callable[[Observations, np.ndarray], np.ndarray]
"""Maps observations (n_envs, ...), and whether an episode starts (n_envs,), to actions."""


class Episode(NamedTuple):
    """An episode of T steps, with the names of the library ``imitation``.

    ``obs`` are T + 1 observations, ``acts`` T actions, ``rews`` T rewards, and ``terminal`` says
    whether the task has ended it, and no time limit.
    """

    obs: Observations
    acts: np.ndarray
    rews: np.ndarray
    terminal: bool


def run_episodes(env: VecEnv, act: Act, n_episodes: int) -> list[Episode]:
    """Go through episodes in several environments, as many in each.

    :param env: The environments.
    :param act: What acts.
    :param n_episodes: How many.
    :return: The episodes, those of the first environment first.
    """
    n_envs = env.num_envs
    targets = [(n_episodes + index) // n_envs for index in range(n_envs)]
    done: list[list[Episode]] = [[] for _ in range(n_envs)]
    steps: list[list[tuple[Any, Any, Any]]] = [[] for _ in range(n_envs)]
    observations, starts = env.reset(), np.ones(n_envs, dtype=bool)
    while any(len(own) < target for own, target in zip(done, targets, strict=True)):
        actions = act(observations, starts)
        following, rewards, starts, infos = env.step(actions)
        for index in range(n_envs):
            step = rows(observations, index), actions[index], rewards[index]
            steps[index].append(_copied(step))
            if not starts[index]:
                continue
            if len(done[index]) < targets[index]:
                info = infos[index]
                terminal = not info.get("TimeLimit.truncated", False)
                done[index].append(_joined(steps[index], info["terminal_observation"], terminal))
            steps[index] = []
        observations = following
    return [episode for own in done for episode in own]


def _copied(step: tuple[Any, ...]) -> Any:
    """A step that stays as it is when environments reuse their arrays."""
    observation, action, reward = step
    if isinstance(observation, dict):
        observation = {key: np.array(values) for key, values in observation.items()}
    else:
        observation = np.array(observation)
    return observation, np.array(action), float(reward)


def _joined(steps: Sequence[tuple[Any, Any, Any]], last: Any, terminal: bool) -> Episode:
    observations, actions, rewards = zip(*steps, strict=True)
    parts = [*observations, last]
    obs: Observations
    if isinstance(last, dict):
        obs = {key: np.stack([part[key] for part in parts]) for key in last}
    else:
        obs = np.stack(parts)
    return Episode(obs, np.stack(actions), np.array(rewards), terminal)


def record_episodes(
    model: BaseAlgorithm,
    env: VecEnv | None = None,
    n_episodes: int = 100,
    deterministic: bool = False,
) -> list[Episode]:
    """Record what a model does, as demonstrations for another one.

    Observations are kept as the environment gives them, before ``VecNormalize``.

    :param model: Any SB3 algorithm.
    :param env: Where it acts; the model's own environment by default. Statistics of a
        ``VecNormalize`` are used and not changed.
    :param n_episodes: How many episodes.
    :param deterministic: Passed to ``predict``.
    :return: The episodes, which ``clone`` and :func:`save_episodes` take.
    :raises ValueError: If there is no environment, or wrappers are outside of ``VecNormalize``.
    """
    env = model.get_env() if env is None else env
    if env is None:
        raise ValueError("The model has no environment to be recorded in: give one, as env.")
    normalize = unwrap_vec_normalize(env)
    if isinstance(env, VecNormalize):
        env = env.venv
    elif normalize is not None:
        raise ValueError(
            f"{type(env).__name__} wraps the VecNormalize, before which observations are recorded: "
            "give an env whose outermost wrapper is VecNormalize."
        )
    state: Any = None

    def act(observations: Observations, starts: np.ndarray) -> np.ndarray:
        nonlocal state
        if normalize is not None:
            observations = normalize.normalize_obs(observations)
        actions, state = model.predict(observations, state, starts, deterministic)
        return actions

    return run_episodes(env, act, n_episodes)


def save_episodes(
    episodes: Sequence[Episode], out: str | Path, env: VecEnv, env_id: str | None = None
) -> None:
    """Write episodes to a file, or as a local Minari dataset.

    :param episodes: The episodes.
    :param out: "minari:DATASET", or a path that ends in ".npz".
    :param env: Where they have been recorded, for its spaces.
    :param env_id: Id under which Gymnasium knows the environment.
    :raises ValueError: If ``out`` is neither.
    """
    name = str(out)
    if name.startswith(MINARI):
        _save_minari(episodes, name.removeprefix(MINARI), env, env_id)
    elif name.endswith(".npz"):
        as_demonstrations(episodes, env).save(name)
    else:
        raise ValueError(f"Give '{MINARI}DATASET' or a path that ends in '.npz', not {name!r}.")


def as_demonstrations(episodes: Sequence[Episode], env: VecEnv) -> Demonstrations:
    """The transitions of episodes, with the spaces of their environment."""
    shown = load_demonstrations(list(episodes))
    return shown._replace(observation_space=env.observation_space, action_space=env.action_space)


def _save_minari(episodes: Sequence[Episode], name: str, env: VecEnv, env_id: str | None) -> None:
    import_minari().create_dataset_from_buffers(
        name,
        [_minari_buffer(number, episode) for number, episode in enumerate(episodes)],
        env=env_id,
        eval_env=env_id,
        description="Episodes recorded by sb3_policyflow.imitation.",
        observation_space=env.observation_space,
        action_space=env.action_space,
        jpeg_encoding=False,
    )


def _minari_buffer(number: int, episode: Episode) -> Any:
    from minari.data_collector import EpisodeBuffer

    ends = np.zeros(len(episode.acts), dtype=bool)
    ends[-1] = True
    return EpisodeBuffer(
        id=number,
        observations=episode.obs,
        actions=episode.acts,
        rewards=list(episode.rews),
        terminations=list(ends & episode.terminal),
        truncations=list(ends & (not episode.terminal)),
    )
