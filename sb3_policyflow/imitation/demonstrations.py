"""Demonstrations: observations and the actions that were taken there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecTransposeImage

from sb3_policyflow.resilience.files import atomic_write

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
    :param returns: Sum of rewards of each episode, shape (n_episodes,); None if it is not known.
    :param observation_space: Space of the observations; None to judge by the arrays alone.
    :param action_space: Space of the actions; None to judge by the arrays alone.
    """

    observations: Observations
    actions: np.ndarray
    episodes: np.ndarray | None = None
    returns: np.ndarray | None = None
    observation_space: spaces.Space[Any] | None = None
    action_space: spaces.Space[Any] | None = None

    def take(self, indices: np.ndarray) -> tuple[Observations, np.ndarray]:
        """Observations and actions of some transitions."""
        return rows(self.observations, indices), self.actions[indices]

    def save(self, path: str | Path) -> None:
        """Write them to a compressed ``.npz`` file, without their spaces.

        :param path: The file.
        """
        is_dict = isinstance(self.observations, dict)
        parts = self.observations if is_dict else {"": self.observations}
        arrays = {f"observations{'/' if is_dict else ''}{key}": parts[key] for key in parts}
        arrays["actions"] = self.actions
        for name in ("episodes", "returns"):
            if getattr(self, name) is not None:
                arrays[name] = getattr(self, name)
        with atomic_write(path, suffix="npz") as file:
            np.savez_compressed(file, **arrays)


def rows(observations: Observations, indices: np.ndarray | slice) -> Observations:
    """Some rows of an array or of a dictionary of arrays."""
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
    if isinstance(source, Demonstrations):
        return _checked(source)
    if isinstance(source, (str, Path)):
        name = str(source)
        if name.startswith(MINARI):
            return _checked(from_minari(name.removeprefix(MINARI)))
        return _checked(_from_file(Path(source)))
    if hasattr(source, "iterate_episodes"):
        return _checked(from_minari(source))
    if hasattr(source, "obs") and hasattr(source, "acts"):
        return _checked(_from_transitions([source]))
    if isinstance(source, tuple) and len(source) == 2:
        return _checked(Demonstrations(*source))
    if isinstance(source, Iterable) and not isinstance(source, Mapping):
        parts = list(source)
        if parts and all(hasattr(part, "obs") and hasattr(part, "acts") for part in parts):
            return _checked(_from_transitions(parts))
    raise ValueError(
        f"Demonstrations must be a name 'minari:DATASET', the path of an .npz file, a Minari "
        f"dataset, transitions with obs and acts, or a pair of arrays, got {type(source).__name__}."
    )


def _checked(shown: Demonstrations) -> Demonstrations:
    """Arrays of equal length, of which there is at least one transition."""
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
    return shown


def _from_file(path: Path) -> Demonstrations:
    if not path.is_file():
        raise ValueError(
            f"There are no demonstrations at {path}: give an .npz file, or '{MINARI}DATASET'."
        )
    with np.load(path) as arrays:
        kept = {name: arrays[name] for name in arrays.files}
    parts = {name: kept.pop(name) for name in list(kept) if name.startswith("observations/")}
    if parts:
        prefix = len("observations/")
        kept["observations"] = {name[prefix:]: values for name, values in parts.items()}
    return Demonstrations(**kept)


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
    observations, actions, episodes, returns = [], [], [], []
    for number, episode in enumerate(dataset.iterate_episodes()):
        acts = np.asarray(episode.actions)
        observations.append(rows(_as_plain(episode.observations), slice(len(acts))))
        actions.append(acts)
        episodes.append(np.full(len(acts), number))
        returns.append(np.sum(episode.rewards))
    return Demonstrations(
        _concatenated(observations),
        np.concatenate(actions),
        np.concatenate(episodes),
        np.array(returns),
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
            "Minari datasets need the library Minari: pip install 'sb3-policyflow[minari]'."
        ) from error
    return minari


def check_spaces(shown: Demonstrations, model: Any) -> None:
    """Refuse demonstrations that a model could not have made.

    :param shown: The demonstrations.
    :param model: An SB3 algorithm.
    :raises ValueError: With both spaces.
    """
    pairs = (
        ("observations", shown.observations, shown.observation_space, model.observation_space),
        ("actions", shown.actions, shown.action_space, model.action_space),
    )
    for name, values, space, wanted in pairs:
        if _fits(values, space, wanted, has_bounds=name == "actions"):
            continue
        theirs = space or _described(values)
        raise ValueError(
            f"The demonstrations do not fit the model: their {name} are {theirs}, the model's are "
            f"{wanted}. Use demonstrations of the environment that the model is made for, with the "
            "same wrappers."
        )


def _described(values: Observations) -> str:
    if isinstance(values, dict):
        return str({key: _described(part) for key, part in values.items()})
    return f"arrays of shape {values.shape[1:]} and dtype {values.dtype}"


def _fits(
    values: Observations,
    space: spaces.Space[Any] | None,
    wanted: spaces.Space[Any],
    has_bounds: bool = False,
) -> bool:
    """Whether values, and their space if it is known, are those of another space."""
    if isinstance(wanted, spaces.Dict):
        if not isinstance(values, dict) or values.keys() != wanted.spaces.keys():
            return False
        parts: Any = space.spaces if isinstance(space, spaces.Dict) else dict.fromkeys(values)
        return all(_fits(values[key], parts.get(key), wanted[key]) for key in values)
    if isinstance(values, dict):
        return False
    if isinstance(wanted, spaces.Box):
        shapes = {wanted.shape}
        if is_image_space(wanted, check_channels=True):
            height_last = spaces.Box(0, 255, (*wanted.shape[1:], wanted.shape[0]), np.uint8)
            if VecTransposeImage.transpose_space(height_last).shape == wanted.shape:
                shapes.add(height_last.shape)
        are_alike = values.shape[1:] in shapes and (values.dtype == np.uint8) == (
            wanted.dtype == np.uint8
        )
        if not has_bounds or not isinstance(space, spaces.Box):
            return are_alike and (space is None or isinstance(space, spaces.Box))
        same = space.shape == wanted.shape
        return (
            are_alike and same and np.allclose([space.low, space.high], [wanted.low, wanted.high])
        )
    return (space is None or space == wanted) and all(
        wanted.contains(value) for value in _values_of(wanted, values[:100])
    )


def _values_of(space: spaces.Space[Any], values: np.ndarray) -> list[Any]:
    """Values in the form that a discrete space contains them."""
    shape = space.shape or ()
    return list(values.reshape(len(values), *shape).astype(space.dtype))
