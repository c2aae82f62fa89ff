"""Former names, values and defaults of options, which keep working."""

import functools
import inspect
import warnings
from collections.abc import Callable, Collection, Mapping
from typing import Any, ParamSpec, cast

from sb3_policyflow.common.names import policy_parameters, unknown_argument
from sb3_policyflow.hints import refuse_both_names
from sb3_policyflow.resilience.saving import SUPERSEDED

P = ParamSpec("P")

FORMER_VALUES: dict[tuple[str, object], str] = {
    ("time_sampler", "starts"): "grid_without_end",
    ("deterministic_action", True): "drawn",  # was random_latents
    ("deterministic_action", False): "zero",
}
"""Present values of options by option and former value."""


class FormerAttribute:
    """An attribute under its former name, with former values, for those who set it later.

    :param present: Its present name.
    """

    def __init__(self, present: str) -> None:
        self._present = present

    def __set_name__(self, owner: type[Any], name: str) -> None:
        self._name = name

    def __get__(self, holder: Any, owner: type[Any] | None = None) -> Any:
        return self if holder is None else getattr(holder, self._present)

    def __set__(self, holder: Any, value: object) -> None:
        changed = with_present_names({self._name: value}, {self._name: self._present})
        setattr(holder, self._present, changed[self._present])


def accepts_former_names(**former_names: str) -> Callable[[Callable[P, None]], Callable[P, None]]:
    """Let a policy take options under their former names too, with a warning.

    Where it does not hand others on, those that it does not have are refused with a sentence.

    :param former_names: Present names by former ones.
    """

    def extend(init: Callable[P, None]) -> Callable[P, None]:
        parameters = inspect.signature(init).parameters
        hands_on = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters.values())

        @functools.wraps(init)
        def extended(*args: P.args, **options: P.kwargs) -> None:
            # A present name has been set later than a former one in policy_kwargs.
            given = {
                name: options[name] for name in options if former_names.get(name) not in options
            }
            present = with_present_names(given, former_names)
            for name in present.keys() - parameters.keys() if not hands_on else ():
                owner = type(args[0])
                raise unknown_argument(owner.__name__, name, policy_parameters(owner))
            cast("Callable[..., None]", init)(*args, **present)

        vars(extended)["former_names"] = former_names
        return extended

    return extend


def check_given_once(
    owner: str, options: Collection[str], policy_kwargs: Mapping[str, Any], policy_class: type[Any]
) -> None:
    """Refuse an option of a policy that is given twice, under whichever of its names.

    :param owner: The algorithm, for error messages.
    :param options: Present names of the policy's options that were given to the algorithm.
    :param policy_kwargs: What was given for its policy.
    :param policy_class: The class of its policy.
    :raises ValueError: With what was given twice.
    """
    former_names = policy_former_names(policy_class)
    refuse_both_names(policy_kwargs, former_names)
    present = with_present_names(policy_kwargs, former_names, warn=False)
    twice = sorted(set(options) & present.keys())
    if twice:
        raise ValueError(f"Give {twice} to {owner} or in policy_kwargs, not to both.")


def policy_former_names(policy_class: type[Any]) -> dict[str, str]:
    """Present names by former ones of what the constructors of a policy and its bases take."""
    found: dict[str, str] = {}
    for cls in reversed(policy_class.__mro__):
        found |= getattr(vars(cls).get("__init__"), "former_names", {})
    return {name: found[name] for name in found.keys() - policy_parameters(policy_class)}


def keep_former_defaults(model: Any) -> None:
    """Give the policy of a file of version 0.1 the defaults of that version.

    A class of the user's own that has another default, or hands one on to its base, keeps it.

    :param model: An algorithm whose policy has just been made.
    """
    if not model.has_former_defaults:
        return
    model.has_former_defaults = False
    kwargs = model.policy_kwargs or {}
    given = with_present_names(kwargs, model.former_names, warn=False).keys() | model.policy_options
    present = policy_parameters(model.policy_base)
    for name, value in model.former_defaults.items():
        if name in given or name not in present or name in _own_parameters(model.policy_class):
            continue
        if getattr(model.policy, name) == present[name].default:
            model.policy_options[name] = value
            setattr(model, name, value)


def _own_parameters(policy_class: type[Any]) -> set[str]:
    """What constructors of a policy take that are not this package's."""
    package = __name__.partition(".")[0]
    own = [cls for cls in policy_class.__mro__ if cls.__module__.partition(".")[0] != package]
    constructors = [vars(cls)["__init__"] for cls in own if "__init__" in vars(cls)]
    return {name for init in constructors for name in inspect.signature(init).parameters}


def with_present_names(
    options: Mapping[str, Any], former_names: Mapping[str, str], warn: bool = True
) -> dict[str, Any]:
    """Options under their present names; where one has changed, a ``DeprecationWarning``.

    >>> with_present_names({"size": 2, "factor": 3}, {"factor": "rule_kwargs.factor"}, warn=False)
    {'size': 2, 'rule_kwargs': {'factor': 3}}

    :param options: Options by name, former or present. Where a file's are mixed with those given to
        ``load``, what has a former name counts; users are refused both names before.
    :param former_names: Present names by former ones; "DICTIONARY.KEY" for an option that has
        become a key of another one.
    :param warn: Whether to warn. Options that come from a file are nobody's mistake.
    """
    present = {name: value for name, value in options.items() if name not in former_names}
    for former in former_names.keys() & options.keys():
        name, _, key = former_names[former].partition(".")
        if options[former] is SUPERSEDED:
            continue
        present[name] = (
            {**(present.get(name) or {}), key: options[former]} if key else options[former]
        )
        _warn_if(warn, f"{former} is now {former_names[former].replace('.', ' with the key ')}")
    for (name, value), replacement in FORMER_VALUES.items():
        if present.get(name) == value:
            present[name] = replacement
            _warn_if(warn, f"{name}={value!r} is now {replacement!r}")
    return present


def _warn_if(warn: bool, change: str) -> None:
    if warn:
        warnings.warn(f"{change}: use the new name.", DeprecationWarning, stacklevel=4)
