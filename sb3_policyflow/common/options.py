"""Options of the flow algorithms: those that they share, and how a sibling adds its own to them."""

import functools
import inspect
import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypedDict, cast

import torch as th
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_policyflow.common import checks
from sb3_policyflow.common.former_names import check_given_once, with_present_names
from sb3_policyflow.common.names import (
    FOREIGN_ARGUMENTS,
    check_names,
    check_saved_by,
    named_parameters,
    own_options,
    policy_parameters,
    settable_options,
    unknown_argument,
)
from sb3_policyflow.common.schedules import (
    Coefficient,
    check_desired_kl,
    check_lr_adaptation,
    parse_schedule,
    positive_at_first,
)
from sb3_policyflow.common.update import check_cloned, check_model
from sb3_policyflow.hints import refuse_both_names

P = ParamSpec("P")


class FlowOptions(TypedDict, total=False):
    """Arguments that all flow algorithms share, behind ``policy`` and ``env``.

    They are documented, and have their defaults, in
    :class:`~sb3_policyflow.common.algorithm.FlowOnPolicyAlgorithm`.
    """

    learning_rate: Coefficient
    n_steps: int
    batch_size: int
    n_epochs: int
    gamma: float
    gae_lambda: float
    clip_range: Coefficient
    clip_range_vf: Coefficient | None
    normalize_advantage: bool
    ent_coef: Coefficient
    vf_coef: float
    max_grad_norm: float | None
    use_sde: bool
    sde_sample_freq: int
    rollout_buffer_class: type[RolloutBuffer] | None
    rollout_buffer_kwargs: dict[str, Any] | None
    target_kl: float | None
    stats_window_size: int
    tensorboard_log: str | None
    policy_kwargs: dict[str, Any] | None
    verbose: int
    seed: int | None
    device: th.device | str
    _init_setup_model: bool
    desired_kl: Coefficient | None
    lr_adaptation_kwargs: dict[str, Any] | None
    advantage_scope: str
    timeout_bootstrap: str
    allow_nan_observations: bool
    n_critic_warmup: int
    critic_learning_rate: Coefficient | None
    imitation_coef: Coefficient


SHARED_CHECKS: dict[str, checks.Check] = {
    "learning_rate": parse_schedule,
    "clip_range": positive_at_first,
    "clip_range_vf": checks.or_none(positive_at_first),
    "vf_coef": checks.between(0.0),
    "gamma": checks.between(0.0, 1.0),
    "gae_lambda": checks.between(0.0, 1.0),
    "ent_coef": parse_schedule,
    "target_kl": checks.or_none(checks.positive),
    "desired_kl": checks.or_none(parse_schedule),
    "lr_adaptation_kwargs": check_lr_adaptation,
    "max_grad_norm": checks.or_none(checks.between(-math.inf)),
    "n_steps": checks.at_least(1),
    "n_epochs": checks.at_least(1),
    "advantage_scope": checks.one_of(("minibatch", "rollout")),
    "timeout_bootstrap": checks.one_of(("terminal", "current", "none")),
    "n_critic_warmup": checks.at_least(0),
    "critic_learning_rate": checks.or_none(parse_schedule),
    "imitation_coef": parse_schedule,
}
"""Checks of the shared options by name; :func:`check_values` has those of several together."""

FORMER_NAMES = {
    "_n_rollouts": "n_rollouts",
    "random_latents": "deterministic_action",
    "lr_adaptation": "lr_adaptation_kwargs.interval",
    "lr_factor": "lr_adaptation_kwargs.factor",
    "lr_bounds": "lr_adaptation_kwargs.bounds",
    "kl_margin": "lr_adaptation_kwargs.margin",
    "kl_window": "lr_adaptation_kwargs.window",
}
"""Present names of the shared options, and of an attribute in files, by former ones."""
FORMER_DEFAULTS = {"latent_std": 1.0, "deterministic_action": "zero"}
"""Options of policies that had another default in version 0.1, with that default."""


def shares_options(
    base: type[Any],
    policy_class: type[Any],
    former_names: Mapping[str, str],
    **defaults: Any,
) -> Callable[[Callable[P, None]], Callable[P, None]]:
    """Complete a constructor that takes ``*args`` and ``**options`` besides its own options.

    The constructor then has the signature that IDEs, Sphinx and ``inspect`` show: the arguments of
    ``base`` in their order, the constructor's own, and the options of the policy. It can be called
    with positional arguments, and with former names of options, which warn.

    :param base: The class that has the shared options.
    :param policy_class: The class whose own options the algorithm hands on.
    :param former_names: See :func:`with_present_names`.
    :param defaults: Defaults of shared options that differ from those of ``base``.
    """

    def complete(init: Callable[P, None]) -> Callable[P, None]:
        signature = _complete_signature(init, base, policy_class, defaults)
        names = {option.name for option in own_options(policy_class)}

        @functools.wraps(init)
        def completed(*args: Any, **options: Any) -> None:
            refuse_both_names(options, former_names)
            options = with_present_names(options, former_names)
            check_names(signature, policy_class, args, options)
            given = signature.bind(*args, **options).arguments
            owner, policy = type(given["self"]).__name__, given["policy"]
            chosen = policy if isinstance(policy, type) else policy_class
            check_given_once(owner, names & given.keys(), given.get("policy_kwargs") or {}, chosen)
            cast("Callable[..., None]", init)(**{**defaults, **given})

        vars(completed)["__signature__"] = signature  # where inspect looks for it
        return cast("Callable[P, None]", completed)

    return complete


def _complete_signature(
    init: Callable[..., None],
    base: type[Any],
    policy_class: type[Any],
    defaults: Mapping[str, Any],
) -> inspect.Signature:
    shared = named_parameters(inspect.signature(base.__init__))
    own = named_parameters(inspect.signature(init))
    for name, default in defaults.items():
        shared[name] = shared[name].replace(default=default)
    merged = {**shared, **own, **{option.name: option for option in own_options(policy_class)}}
    parameters = sorted(merged.values(), key=lambda parameter: parameter.kind)
    return inspect.Signature(parameters, return_annotation=None)


class PolicyOption:
    """An option of the policy as an attribute of its algorithm: setting it has its effect.

    :param name: The option.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, model: Any, owner: type[Any] | None = None) -> Any:
        return self if model is None else getattr(model.policy, self._name)

    def __set__(self, model: Any, value: object) -> None:
        policy, name = model.policy, self._name
        if name in policy.fixed_options:
            raise AttributeError(_cannot_change(name))
        former = getattr(policy, name)
        setattr(policy, name, value)
        try:
            checks.check_options(policy)
        except ValueError:
            setattr(policy, name, former)
            raise


def values_on_policy(model: Any) -> dict[str, Any]:
    """The options of a model's policy that are attributes of the model too."""
    return {name: getattr(model.policy, name) for name in settable_options(model.policy_base)}


def note_changed_options(model: Any) -> None:
    """Take up into ``policy_options`` what has been changed on the policy itself.

    :param model: An algorithm that is about to be saved, or to go on.
    :raises ValueError: If an option has changed that cannot.
    """
    for name, value in values_on_policy(model).items():
        known = model.known_policy_options[name]
        if value == known:
            continue
        if name in model.policy.fixed_options:
            raise ValueError(f"Set {name} to {known!r} again. {_cannot_change(name)}")
        model.policy_options[name] = model.known_policy_options[name] = value


def _cannot_change(name: str) -> str:
    return f"{name} cannot change, because the policy was made with it: make another model."


def read_loaded_options(model: Any) -> None:
    """Read what ``load`` sets as attributes: former names, and options of the policy.

    :param model: An algorithm whose attributes have just been loaded.
    """
    attributes = vars(model)
    present = with_present_names(attributes, model.former_names, warn=False)
    for former in model.former_names.keys() & attributes.keys():
        del attributes[former]
    attributes.update(present)
    for name in settable_options(model.policy_base) & attributes.keys():
        model.policy_options[name] = attributes.pop(name)


def check_algorithm(model: Any) -> None:
    """Refuse what cannot be used, before networks and buffers are made.

    :param model: An algorithm whose attributes have been set.
    :raises ValueError: With what to use instead.
    """
    name, space = type(model).__name__, getattr(model, "observation_space", None)
    # Only what a file has set is there before networks are made.
    is_loaded = "lr_schedule" in vars(model)
    checks.check_environment(name, model.env, space)
    checks.check_flow_spaces(model.action_space, model.use_sde)
    if is_loaded:
        check_saved_by(model)
    checks.check_policy_class(name, model.policy_class, model.policy_base)
    checks.check_extractor(name, model.policy_class, model.policy_kwargs or {}, space)
    for option in (model.policy_kwargs or {}).keys() - policy_parameters(model.policy_class):
        if option in FOREIGN_ARGUMENTS:
            raise unknown_argument(model.policy_class.__name__, option, ())
        if option in inspect.signature(type(model)).parameters:
            raise TypeError(
                f"{option} is an option of the algorithm and not of its policy: take it out of "
                f"policy_kwargs, as {name}(..., {option}=...)."
            )
    check_values(model)
    if not is_loaded:
        if model.desired_kl is None and model.lr_adaptation_kwargs:
            warnings.warn(
                "lr_adaptation_kwargs have no effect: they say how the learning rate follows "
                "desired_kl, which is None.",
                stacklevel=2,
            )
        checks.warn_of_batches(model.batch_size, model.n_steps, model.ranks.size * model.n_envs)


def check_values(model: Any) -> None:
    """Refuse values that cannot be used, however they came to be the model's.

    :param model: An algorithm.
    :raises ValueError: With what to use instead.
    """
    checks.check_options(model)
    sizes = model.batch_size, model.n_steps, model.n_envs
    checks.check_batch_size(*sizes, model.normalize_advantage)
    if model.desired_kl is not None:
        check_desired_kl(model.desired_kl, model.learning_rate)


def take_up_changes(model: Any) -> None:
    """Let attributes that have been set since the last time have their effect.

    :param model: An algorithm that is about to learn: at all, or from a rollout.
    :raises ValueError: If a value cannot be used, or cannot change.
    """
    check_values(model)
    check_cloned(model)
    note_changed_options(model)
    check_model(model)
    model.rollout_buffer.gamma = model.gamma
    model.rollout_buffer.gae_lambda = model.gae_lambda
    model.read_learning_rate()
