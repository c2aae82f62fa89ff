"""Names of arguments and methods: which there are, SB3's without a meaning here, misspelt ones."""

import inspect
import warnings
from collections.abc import Collection, Mapping
from typing import Any

import torch as th
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_policyflow.hints import did_you_mean, either, nearest

OF_GSDE = "it belongs to gSDE, which flow policies do not support. Leave it out."
FOREIGN_ARGUMENTS = {
    "use_sde": OF_GSDE,
    "sde_sample_freq": OF_GSDE,
    "full_std": OF_GSDE,
    "use_expln": OF_GSDE,
    "squash_output": (
        "it belongs to gSDE, which flow policies do not support. Leave it out: actions are clipped "
        "to their bounds, to which DPPO with process='ddpm' scales them."
    ),
    "log_std_init": (
        "only PolicyFlow has Gaussian noise that is learned; FPO and DPPO have options of their "
        "own for the noise of their actions."
    ),
}
"""Arguments of SB3's actor-critic policies that some or all flow policies do not have, and why."""

NOT_CALLED = {
    "_get_action_dist_from_latent": (
        "a flow policy has no distribution with a likelihood: override sample_actions, or "
        "_build_actor for another velocity field"
    ),
    "reset_noise": "flow policies do not support gSDE: override sample_actions",
}
"""Methods of SB3's policies that nothing would ever call, and what to override instead."""

NOT_CALLED_BY_TRAINING = ("evaluate_actions", "get_distribution")
"""Methods of SB3's policies that PPO trains with, and flow algorithms do not."""


class WithoutLikelihood:
    """SB3's methods of policies that make no sense without a likelihood of actions, refused."""

    def get_distribution(self, obs: PyTorchObs) -> Distribution:  # noqa: ARG002
        """Refuse: SB3's distributions say how likely actions are."""
        raise self._no_likelihood()

    def evaluate_actions(self, obs: PyTorchObs, actions: th.Tensor) -> Any:  # noqa: ARG002
        """Refuse: the likelihood of an action under a flow policy has no closed form."""
        raise self._no_likelihood()

    def reset_noise(self, n_envs: int = 1) -> None:  # noqa: ARG002
        """Refuse: this is gSDE's noise."""
        raise TypeError(f"{type(self).__name__} does not support gSDE, whose noise this resets.")

    def _no_likelihood(self) -> TypeError:
        return TypeError(
            f"{type(self).__name__} has no closed-form likelihood of actions, which PPO needs: "
            "make, load and train it with the flow algorithms of sb3_policyflow, which need none."
        )


def check_overridden_methods(policy_class: type[Any], base: type[Any]) -> None:
    """Refuse a policy class with methods that nothing calls, and warn of those that seldom are.

    :param policy_class: The class.
    :param base: The base of all flow policies.
    :raises TypeError: With the method to override instead.
    """

    def overrides(name: str) -> bool:
        return getattr(policy_class, name) is not getattr(base, name)

    for name, instead in NOT_CALLED.items():
        if overrides(name):
            raise TypeError(f"{policy_class.__name__} overrides {name}, but {instead}.")
    for name in filter(overrides, NOT_CALLED_BY_TRAINING):
        warnings.warn(
            f"{policy_class.__name__} overrides {name}, which the flow algorithms do not call: "
            "what they train on is in the terms of their update_class.",
            stacklevel=4,
        )


def own_options(policy_class: type[Any]) -> list[inspect.Parameter]:
    """The keyword-only parameters of a policy's constructors, its own options."""
    parameters = policy_parameters(policy_class).values()
    return [parameter for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY]


def settable_options(policy_class: type[Any]) -> set[str]:
    """Names of the options of a policy that are attributes of its algorithm too."""
    return {"deterministic_action"} | {option.name for option in own_options(policy_class)}


def policy_parameters(policy_class: type[Any]) -> dict[str, inspect.Parameter]:
    """What the constructors of a policy and of its bases take from ``policy_kwargs``."""
    found: dict[str, inspect.Parameter] = {}
    for cls in policy_class.__mro__:
        if "__init__" in vars(cls) and hasattr(cls, "option_checks"):
            parameters = named_parameters(inspect.signature(vars(cls)["__init__"]))
            found |= {name: p for name, p in parameters.items() if name not in found}
    for name in ("self", "observation_space", "action_space", "lr_schedule", "use_sde"):
        found.pop(name, None)
    return found


def named_parameters(signature: inspect.Signature) -> dict[str, inspect.Parameter]:
    """The parameters that have names, without ``*args`` and ``**options``."""
    collecting = inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD
    return {name: p for name, p in signature.parameters.items() if p.kind not in collecting}


def unknown_argument(
    owner: str, name: str, own: Collection[str], of_policy: Collection[str] = ()
) -> TypeError:
    """An error that says where an argument that does not exist belongs.

    :param owner: Who does not have it.
    :param name: The argument.
    :param own: Names of the arguments that the owner has.
    :param of_policy: Names of those of the owner's policy, if that is another.
    """
    if name in of_policy:
        return TypeError(
            f"{name} is an option of {owner}'s policy: give it in policy_kwargs, as "
            f"{owner}(..., policy_kwargs=dict({name}=...))."
        )
    if name in FOREIGN_ARGUMENTS:
        return TypeError(f"{owner} has no {name}: {FOREIGN_ARGUMENTS[name]}")
    similar = nearest(name, {*own, *of_policy})
    places = [n if n in own else f"{n} in policy_kwargs" for n in similar]
    meant = f"did you mean {either(places)}?" if places else f"help({owner}) shows those it has."
    return TypeError(f"{owner} has no argument {name!r}: {meant}")


def check_names(
    signature: inspect.Signature,
    policy_class: type[Any],
    args: tuple[Any, ...],
    options: Mapping[str, Any],
) -> None:
    """Refuse arguments that an algorithm does not have, and one that would have no effect.

    :param signature: The signature of the algorithm's constructor.
    :param policy_class: The base of its policies.
    :param args: What was given by position, the algorithm first.
    :param options: What was given by name.
    :raises TypeError: With where an argument belongs, or which one may be meant.
    :raises ValueError: If there is no policy of a name, or options of gSDE are given.
    """
    model, policy, *_ = (*args, options.get("policy"))
    if isinstance(policy, str) and policy not in model.policy_aliases:
        raise ValueError(
            f"{type(model).__name__} has no policy {policy!r}: "
            f"{did_you_mean(policy, model.policy_aliases)}"
        )
    if not isinstance(options.get("policy_kwargs") or {}, dict):
        raise ValueError(
            f"policy_kwargs must be a dictionary, such as dict(net_arch=[64, 64]), got "
            f"{options['policy_kwargs']!r}."
        )
    if isinstance(policy, type) and issubclass(policy, policy_class):
        policy_class = policy
    own = signature.parameters.keys() - {"self"}
    for name in options.keys() - own:
        of_policy = policy_parameters(policy_class).keys() - own
        raise unknown_argument(type(model).__name__, name, own, of_policy)
    if options.get("sde_sample_freq", -1) != -1:
        raise ValueError(
            f"sde_sample_freq={options['sde_sample_freq']} belongs to gSDE, which flow policies do "
            "not support: leave it out."
        )


def check_saved_by(model: Any) -> None:
    """Refuse a file that another algorithm has saved.

    :param model: An algorithm whose attributes are those of the file.
    :raises ValueError: With the algorithm to load it with.
    """
    name, policy_class = type(model).__name__, model.policy_class
    if issubclass(policy_class, model.policy_base):
        return
    shared: Any = type(model).__base__
    siblings = [
        cls.__name__ for cls in shared.__subclasses__() if issubclass(policy_class, cls.policy_base)
    ]
    of_sb3 = {"SACPolicy": "SAC", "TD3Policy": "TD3", "DQNPolicy": "DQN"}
    # A file of PPO has made a schedule of the number that is there at first.
    of_sb3["ActorCriticPolicy"] = "PPO" if callable(model.clip_range) else "A2C"
    names = [cls.__name__ for cls in policy_class.__mro__]
    saver, *_ = siblings + [of_sb3[base] for base in names if base in of_sb3] + [""]
    if not saver:
        raise ValueError(f"This file holds a {names[0]}, which {name} did not save.")
    raise ValueError(f"This file was saved by {saver}, not by {name}: use {saver}.load.")


def policy_aliases(
    mlp: type[BasePolicy], cnn: type[BasePolicy], multi_input: type[BasePolicy]
) -> dict[str, type[BasePolicy]]:
    """An algorithm's policies by the names of flow policies and by those of SB3."""
    return {
        "MlpFlowPolicy": mlp,
        "CnnFlowPolicy": cnn,
        "MultiInputFlowPolicy": multi_input,
        "MlpPolicy": mlp,
        "CnnPolicy": cnn,
        "MultiInputPolicy": multi_input,
    }
