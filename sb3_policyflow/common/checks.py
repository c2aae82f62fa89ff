"""Checks of the user's arguments, made before any work is done."""

import math
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from numbers import Integral, Real
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)
from torch import nn

from sb3_policyflow.common.buffers import (
    DictFlowRolloutBuffer,
    FlowRolloutBuffer,
    RecordBufferMixin,
)
from sb3_policyflow.flows.choices import choose

Check = Callable[[str, object], object]
"""``check(name, value)`` raises a ``ValueError`` that says what ``name`` must be."""


def check_options(options: object) -> None:
    """Check the attributes that the tables ``option_checks`` of a class and its bases name.

    Then the class's ``combination_checks``, functions that refuse options that do not go together.

    :raises ValueError: With the first one that cannot be used.
    """
    for cls in reversed(type(options).__mro__):
        for name, check in vars(cls).get("option_checks", {}).items():
            check(name, getattr(options, name))
    for combined in getattr(options, "combination_checks", ()):
        combined(options)


def one_of(choices: Collection[str]) -> Check:
    """One of some names.

    >>> one_of(("sum", "mean"))("reduction", "max")
    Traceback (most recent call last):
    ...
    ValueError: reduction must be one of 'sum', 'mean', got 'max'.
    """

    def check(name: str, value: object) -> None:
        choose(name, value, dict.fromkeys(choices))

    return check


def at_least(lowest: int) -> Check:
    """A whole number that is not too small."""

    def check(name: str, value: object) -> None:
        if not isinstance(value, Integral) or not int(value) >= lowest:
            raise ValueError(
                f"{name} must be at least {lowest}, and a whole number, got {value!r}."
            )

    return check


def between(lowest: float, highest: float = math.inf) -> Check:
    """A number in a range."""

    def check(name: str, value: object) -> None:
        if not isinstance(value, Real) or not lowest <= float(value) <= highest:
            raise ValueError(f"{name} must be a number from {lowest} to {highest}, got {value!r}.")

    return check


def finite(name: str, value: object) -> None:
    """A finite number."""
    if not isinstance(value, Real) or not math.isfinite(value):
        raise ValueError(f"{name} must be a finite number, got {value!r}.")


def greater_than(lowest: float) -> Check:
    """A number above a lowest one."""

    def check(name: str, value: object) -> None:
        if not isinstance(value, Real) or not float(value) > lowest:
            raise ValueError(f"{name} must be greater than {lowest:g}, got {value!r}.")

    return check


def positive(name: str, value: object) -> None:
    """A positive number."""
    if not isinstance(value, Real) or not float(value) > 0:
        raise ValueError(f"{name} must be positive, got {value!r}.")


def positive_up_to(highest: float) -> Check:
    """A positive number that is not too large."""

    def check(name: str, value: object) -> None:
        if not isinstance(value, Real) or not 0 < float(value) <= highest:
            raise ValueError(f"{name} must be in (0, {highest:g}], got {value!r}.")

    return check


def bounds(name: str, value: object) -> None:
    """A lowest and a highest number, which may be the same."""
    ends = list(value) if isinstance(value, Sequence) else []
    are_numbers = all(isinstance(end, Real) for end in ends)
    if len(ends) != 2 or not are_numbers or not ends[0] <= ends[1]:
        raise ValueError(f"{name} must be two numbers in order, got {value!r}.")


def positive_bounds(name: str, value: object) -> None:
    """A lowest and a highest positive number."""
    bounds(name, value)
    ends: Any = value
    if not ends[0] > 0:
        raise ValueError(f"{name} must be positive, got {value!r}.")


def or_none(check: Check) -> Check:
    """What another check allows, or None."""

    def check_unless_none(name: str, value: object) -> None:
        if value is not None:
            check(name, value)

    return check_unless_none


def check_policy_class(algorithm: str, policy_class: type[Any], base: type[Any]) -> None:
    """Refuse a policy of another kind.

    :raises ValueError: If ``policy_class`` is not derived from ``base``.
    """
    if not (isinstance(policy_class, type) and issubclass(policy_class, base)):
        raise ValueError(
            f"{algorithm} trains policies derived from {base.__name__}, not "
            f"{getattr(policy_class, '__name__', policy_class)}: use 'MlpFlowPolicy', "
            "'CnnFlowPolicy' or 'MultiInputFlowPolicy', or derive your own from "
            f"{base.__module__}.{base.__name__}."
        )


def check_networks(
    net_arch: object, activation_fn: object, optimizer_class: object, extractor_class: object
) -> None:
    """Refuse networks that cannot be built, before PyTorch does so in words of its own.

    :param net_arch: Hidden layers, or None.
    :param activation_fn: A module's class.
    :param optimizer_class: An optimizer's class.
    :param extractor_class: A features extractor's class, or None.
    :raises ValueError: With what to give instead.
    """
    if isinstance(net_arch, list) and net_arch and isinstance(net_arch[0], dict):
        net_arch = net_arch[0]  # the form before SB3 1.8, of which it warns
    parts = net_arch if isinstance(net_arch, dict) else {"pi": net_arch or []}
    sizes = [size for layers in parts.values() for size in _as_list(layers)]
    are_sizes = all(isinstance(size, Integral) and int(size) > 0 for size in sizes)
    if not are_sizes or not parts.keys() <= {"pi", "vf"}:
        raise ValueError(
            "net_arch must be a list of layer sizes, such as [64, 64], or "
            f"dict(pi=[64, 64], vf=[64, 64]), got {net_arch!r}."
        )
    classes = {
        "activation_fn": (activation_fn, nn.Module, "torch.nn.ReLU"),
        "optimizer_class": (optimizer_class, th.optim.Optimizer, "torch.optim.Adam"),
        "features_extractor_class": (
            extractor_class or BaseFeaturesExtractor,
            BaseFeaturesExtractor,
            "stable_baselines3.common.torch_layers.NatureCNN",
        ),
    }
    for name, (given, base, example) in classes.items():
        # A function that returns an activation or an optimizer serves as well as a class.
        if isinstance(given, (str, nn.Module)) or not callable(given):
            raise ValueError(
                f"{name} must be a class derived from {base.__name__}, such as {example} (the "
                f"class itself, without quotes or brackets), got {given!r}."
            )


def _as_list(layers: object) -> list[Any]:
    """The layers of a part; what is no list of them becomes one that is refused."""
    is_list = isinstance(layers, Sequence) and not isinstance(layers, str)
    return list(cast("Sequence[Any]", layers)) if is_list else [layers]


def check_extractor(
    algorithm: str,
    policy_class: type[Any],
    policy_kwargs: Mapping[str, Any],
    observation_space: object,
) -> None:
    """Refuse a policy for other observations.

    :raises ValueError: With the policy to use.
    """
    extractor = policy_kwargs.get("features_extractor_class")
    extractor = extractor or policy_class.default_features_extractor_class
    is_dict = isinstance(observation_space, spaces.Dict)
    if extractor is CombinedExtractor and not is_dict:
        raise ValueError(
            f"{policy_class.__name__} is for observations that are a Dict, and these are "
            f"{observation_space}: use {algorithm}('MlpPolicy', ...), or 'CnnPolicy' for images."
        )
    if extractor in (FlattenExtractor, NatureCNN) and is_dict:
        raise ValueError(
            f"{extractor.__name__} takes a single array, and these observations are a Dict: use "
            f"{algorithm}('MultiInputPolicy', ...)."
        )


def check_flow_spaces(action_space: spaces.Space[Any], use_sde: bool) -> None:
    """Refuse what a flow policy cannot do.

    :raises ValueError: If the actions are not continuous or not floats, or gSDE is asked for.
    """
    if not isinstance(action_space, spaces.Box):
        raise ValueError(
            f"Flow policies need continuous actions (a Box), but the action space is "
            f"{action_space}: use PPO of stable_baselines3 for it."
        )
    if not np.issubdtype(action_space.dtype, np.floating):
        raise ValueError(
            f"Flow policies draw real numbers, but the actions are {action_space.dtype}: declare a "
            "Box of np.float32, and round in the environment (gymnasium.wrappers.TransformAction)."
        )
    if use_sde:
        raise ValueError(
            "Flow policies draw their own exploration noise, so use_sde=True is not supported: "
            "leave it out. The noise has options of its own, such as PolicyFlow's "
            "policy_kwargs=dict(log_std_init=...)."
        )


def check_environment(algorithm: str, env: object, observation_space: object) -> None:
    """Refuse an environment that is missing, or observations that SB3 cannot encode.

    :raises ValueError: If there are no spaces, or a discrete observation does not count from 0.
    """
    if observation_space is None:
        raise ValueError(f"{algorithm} needs an environment to know its spaces: got env={env!r}.")
    parts = observation_space.values() if isinstance(observation_space, spaces.Dict) else []
    for space in (observation_space, *parts):
        if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)) and np.any(space.start):
            raise ValueError(
                f"Discrete observations must count from 0, as SB3 encodes them, but the space is "
                f"{space}: subtract its start in a gymnasium.wrappers.TransformObservation."
            )


def choose_buffer_class(
    algorithm: str, given: type[RolloutBuffer] | None, observation_space: spaces.Space[Any]
) -> type[RecordBufferMixin]:
    """The buffer for an observation space, or the user's own if it keeps a record.

    :raises ValueError: If the user's own keeps none, or is for other observations.
    """
    is_dict = isinstance(observation_space, spaces.Dict)
    default = DictFlowRolloutBuffer if is_dict else FlowRolloutBuffer
    if given is None:
        return default
    if not issubclass(given, RecordBufferMixin):
        raise ValueError(
            f"{algorithm} needs a rollout buffer that stores how each action was made, which "
            f"{given.__name__} does not: leave out rollout_buffer_class, or derive yours from "
            f"{default.__module__}.{default.__name__}."
        )
    if issubclass(given, DictRolloutBuffer) is not is_dict:
        kind = "dictionaries of observations" if is_dict else "observations that are arrays"
        raise ValueError(
            f"{given.__name__} does not store {kind}, which the environment has: leave out "
            f"rollout_buffer_class, or derive yours from {default.__module__}.{default.__name__}."
        )
    return given


def check_batch_size(batch_size: int, n_steps: int, n_envs: int, normalize_advantage: bool) -> None:
    """Refuse sizes that SB3's PPO refuses.

    :raises ValueError: If advantages would be normalized over one sample.
    """
    at_least(2 if normalize_advantage else 1)("batch_size", batch_size)
    if normalize_advantage and n_steps * n_envs < 2:
        raise ValueError(
            "Advantages cannot be normalized over one sample: n_steps * n_envs must be greater "
            f"than 1, got n_steps={n_steps} and n_envs={n_envs}."
        )


def warn_of_batches(batch_size: int, n_steps: int, n_envs: int) -> None:
    """Warn of sizes that SB3's PPO warns of."""
    buffer_size = n_steps * n_envs
    if buffer_size % batch_size > 0:
        warnings.warn(
            f"batch_size={batch_size} does not divide n_steps * n_envs = {n_steps} * {n_envs} = "
            f"{buffer_size}: the last minibatch of each epoch will have "
            f"{buffer_size % batch_size} samples. Use a factor of {buffer_size}.",
            stacklevel=4,
        )
