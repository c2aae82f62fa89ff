"""Demonstrations: observations and the actions that were taken there."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_policyflow.hints import install_command
from sb3_policyflow.resilience.files import atomic_write, with_ending

MINARI = "minari:"
"""What the name of a Minari dataset begins with where a file may be meant."""
Observations = Any
"""An array (n, ...), or a dictionary of such arrays."""


class Demonstrations(NamedTuple):
    """n transitions of one or several demonstrators.

    >>> shown = Demonstrations(np.zeros((3, 4)), np.ones((3, 2)))
    >>> len(shown.actions), shown.episodes is None
    (3, True)

    :param observations: As the environment gives them: an array (n, ...), or a dictionary of them.
    :param actions: As the environment takes them, shape (n, ...).
    :param episodes: Number of the episode that each transition belongs to, shape (n,); None if it
        is not known. Validation then holds out transitions instead of whole episodes.
    :param observation_space: Space of the observations; None to judge by the arrays alone.
    :param action_space: Space of the actions; None to judge by the arrays alone.
    """

    observations: Observations
    actions: np.ndarray
    episodes: np.ndarray | None = None
    observation_space: spaces.Space[Any] | None = None
    action_space: spaces.Space[Any] | None = None

    def take(self, indices: np.ndarray) -> tuple[Observations, np.ndarray]:
        """Observations and actions of some transitions."""
        return rows(self.observations, indices), self.actions[indices]

    def save(self, path: str | Path) -> None:
        """Write them to a compressed ``.npz`` file, without their spaces.

        :param path: The file; the ending may be left out.
        """
        with atomic_write(with_ending(path, ".npz")) as file:
            np.savez_compressed(file, **self._arrays())

    def digest(self) -> str:
        """A hash of all arrays, by which the same demonstrations are known again."""
        sha = hashlib.sha256()
        for name, array in sorted(self._arrays().items()):
            sha.update(f"{name} {array.dtype} {array.shape}".encode())
            sha.update(np.ascontiguousarray(array).data)
        return sha.hexdigest()

    def _arrays(self) -> dict[str, Any]:
        is_dict = isinstance(self.observations, dict)
        parts = self.observations if is_dict else {"": self.observations}
        arrays = {f"observations{'/' if is_dict else ''}{key}": parts[key] for key in parts}
        arrays["actions"] = self.actions
        if self.episodes is not None:
            arrays["episodes"] = self.episodes
        return arrays


def rows(observations: Observations, indices: Any) -> Observations:
    """One or some rows of an array or of a dictionary of arrays."""
    if isinstance(observations, dict):
        return {key: values[indices] for key, values in observations.items()}
    return observations[indices]


def load_demonstrations(source: Any) -> Demonstrations:
    """Demonstrations, from any of the forms in which they come.

    :param source: ``Demonstrations``; a name "minari:DATASET" or a Minari dataset; the path of an
        ``.npz`` file that :meth:`Demonstrations.save` wrote; transitions of the library
        ``imitation``, or other objects with ``obs`` and ``acts``, one or several; or a pair of
        observations and actions.
    :raises ValueError: If it is nothing of this, or its arrays do not fit together.
    """
    if isinstance(source, (str, Path)):
        return _checked(_named(str(source)))
    if isinstance(source, Demonstrations):
        return _checked(source)
    if hasattr(source, "iterate_episodes"):
        return _checked(from_minari(source))
    if _is_transitions(source):
        return _checked(_from_transitions([source]))
    if isinstance(source, (list, tuple)) and source and all(map(_is_transitions, source)):
        return _checked(_from_transitions(list(source)))
    if isinstance(source, tuple) and len(source) == 2:
        return _checked(Demonstrations(*source))
    raise ValueError(
        f"Demonstrations must be a name 'minari:DATASET', the path of an .npz file, a Minari "
        f"dataset, transitions with obs and acts, or a pair of arrays, got {type(source).__name__}."
    )


def _named(name: str) -> Demonstrations:
    is_minari = name.startswith(MINARI)
    return from_minari(name.removeprefix(MINARI)) if is_minari else _from_file(Path(name))


def _is_transitions(source: object) -> bool:
    return hasattr(source, "obs") and hasattr(source, "acts")


def _checked(shown: Demonstrations) -> Demonstrations:
    """Arrays of equal length, of which there is at least one transition, and finite actions."""
    observations = shown.observations
    if isinstance(observations, Mapping):
        observations = {key: np.asarray(values) for key, values in observations.items()}
    else:
        observations = np.asarray(observations)
    shown = shown._replace(observations=observations, actions=np.asarray(shown.actions))
    parts = observations.values() if isinstance(observations, dict) else [observations]
    lengths = {len(part) for part in parts} | {len(shown.actions)}
    if len(lengths) > 1 or 0 in lengths:
        raise ValueError(
            "Demonstrations need as many observations as actions, and at least one, got "
            f"{sorted(lengths)}: leave out the observation after the last action of an episode."
        )
    if not np.isfinite(shown.actions).all():
        raise ValueError(
            "Demonstrated actions must be finite numbers: leave out those that are not."
        )
    if shown.episodes is None:
        return shown
    return shown._replace(episodes=_checked_episodes(shown.episodes, len(shown.actions)))


def _checked_episodes(episodes: Any, n: int) -> np.ndarray:
    """The number of the episode of each of n transitions."""
    numbers = np.asarray(episodes)
    if numbers.shape != (n,) or not np.issubdtype(numbers.dtype, np.integer):
        raise ValueError(
            f"The episodes of demonstrations must be {n} integers, for each transition the number "
            f"of its episode, got an array of shape {numbers.shape} and dtype {numbers.dtype}: "
            "correct it, or leave it out."
        )
    return numbers


def _from_file(path: Path) -> Demonstrations:
    if not path.is_file():
        raise ValueError(
            f"There are no demonstrations at {path}: give an .npz file, or '{MINARI}DATASET'."
        )
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    prefix = "observations/"
    parts = {key.removeprefix(prefix): arrays[key] for key in arrays if key.startswith(prefix)}
    observations = parts or arrays.get("observations")
    if observations is None or "actions" not in arrays:
        raise ValueError(
            f"{path} has the arrays {sorted(arrays)}, but demonstrations are 'observations' and "
            "'actions': give a file that Demonstrations.save wrote, or a pair of arrays."
        )
    # Whatever else is there is not needed: earlier files have returns too.
    return Demonstrations(observations, arrays["actions"], arrays.get("episodes"))


def _from_transitions(parts: list[Any]) -> Demonstrations:
    """Of objects with ``obs`` and ``acts``; trajectories have one observation more than actions."""
    observations, actions, episodes = [], [], []
    for number, part in enumerate(parts):
        acts = np.asarray(part.acts)
        observations.append(rows(_as_plain(part.obs), slice(len(acts))))
        actions.append(acts)
        episodes.append(np.full(len(acts), number))
    return Demonstrations(
        _concatenated(observations),
        np.concatenate(actions),
        np.concatenate(episodes) if len(parts) > 1 else None,
    )


def _as_plain(observations: Any) -> Observations:
    """An array, or a dictionary of arrays, which ``imitation`` has a class of its own for."""
    unwrapped = observations.unwrap() if hasattr(observations, "unwrap") else observations
    if isinstance(unwrapped, Mapping):
        return {key: np.asarray(values) for key, values in unwrapped.items()}
    return np.asarray(unwrapped)


def _concatenated(observations: list[Observations]) -> Observations:
    if isinstance(observations[0], dict):
        return {
            key: np.concatenate([part[key] for part in observations]) for key in observations[0]
        }
    return np.concatenate(observations)


def from_minari(dataset: Any) -> Demonstrations:
    """All episodes of a Minari dataset.

    :param dataset: The dataset, or the name of a local or remote one; a remote one is downloaded.
    :raises ImportError: If Minari is not installed.
    """
    if isinstance(dataset, str):
        dataset = import_minari().load_dataset(dataset, download=True)
    observations, actions, episodes = [], [], []
    for number, episode in enumerate(dataset.iterate_episodes()):
        acts = np.asarray(episode.actions)
        observations.append(rows(_as_plain(episode.observations), slice(len(acts))))
        actions.append(acts)
        episodes.append(np.full(len(acts), number))
    return Demonstrations(
        _concatenated(observations),
        np.concatenate(actions),
        np.concatenate(episodes),
        dataset.spec.observation_space,
        dataset.spec.action_space,
    )


def import_minari() -> Any:
    """The library Minari.

    :raises ImportError: If it is not installed, with what installs it.
    """
    try:
        import minari
    except ImportError as error:
        raise ImportError(
            f"Minari datasets need the library Minari: {install_command('minari')}"
        ) from error
    return minari
