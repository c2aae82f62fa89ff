"""Attributes set after construction: as if they had been given, or refused by a sentence."""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import FloatSchedule, set_random_seed

from sb3_policyflow import DPPO, FPO, PolicyFlow
from sb3_policyflow.common.names import own_options
from sb3_policyflow.policyflow.policies import PolicyFlowPolicy
from tests.contract.uses import Each, first_line, make, steps
from tests.helpers import weights

RATE = FloatSchedule(1e-3)
SIZES: dict[str, Any] = {"n_steps": 16, "batch_size": 8, "n_epochs": 2, "learning_rate": 1e-2}
OF_PPO: dict[str, Any] = {
    "ent_coef": 0.5,
    "vf_coef": 2.0,
    "clip_range": FloatSchedule(0.001),
    "clip_range_vf": FloatSchedule(0.001),
    "n_epochs": 3,
    "batch_size": 4,
    "target_kl": 1e-9,
    "max_grad_norm": 0.01,
    "normalize_advantage": False,
}
"""Attributes that SB3's PPO reads when it trains, and values that change what is learned."""
SHARED: dict[str, Any] = {
    **OF_PPO,
    "clip_range": 0.001,
    "clip_range_vf": 0.001,
    "gamma": 0.5,
    "gae_lambda": 0.1,
    "learning_rate": 1e-3,
    "desired_kl": 1e-4,
    "lr_adaptation_kwargs": {"interval": "minibatch"},
    "advantage_scope": "rollout",
    "timeout_bootstrap": "none",
    "n_steps": 24,
    "n_critic_warmup": 1,
    "critic_learning_rate": 1e-4,
    "imitation_coef": 50.0,
}
DRAWN: dict[str, Any] = {"n_entropy_actions": 3, "n_entropy_states": 2}
OWN: dict[type[Any], dict[str, Any]] = {
    PolicyFlow: {
        "brownian_coef": 0.5,
        "time_sampler": "uniform",
        "n_times": 3,
        "time_average": "shift",
        "brownian_reduction": "mean",
        "uniform_noise_coef": 0.5,
        "log_ratio_clamp": 1e-4,
    },
    FPO: {
        "n_mc_samples": 3,
        "mc_average": "objective",
        "loss_target": "velocity",
        "loss_reduction": "sum",
        "time_sampler": "uniform",
        "trust_region": "spo",
        "loss_clamp": 0.1,
        "difference_clamp": 1e-4,
        **DRAWN,
    },
    DPPO: {
        "log_prob_clamp": (-0.5, 0.5),
        "log_prob_reduction": "sum",
        "denoising_gamma": 0.5,
        "clip_range_base": 1e-4,
        "clip_range_rate": 30.0,
        **DRAWN,
    },
}
"""Options of our algorithms, and values that change what is learned."""
USED_WITH: dict[str, dict[str, Any]] = {
    "time_average": {"n_times": 2},
    "brownian_reduction": {"brownian_coef": 0.5},
    "lr_adaptation_kwargs": {"desired_kl": 1e-4},
    "n_entropy_actions": {"ent_coef": 0.5},
    "n_entropy_states": {"ent_coef": 0.5},
    "clip_range_rate": {"clip_range_base": 1e-4, "clip_range": 0.001},
}
"""Other options without which an option does nothing."""
OF_POLICIES: dict[type[Any], dict[str, Any]] = {
    PolicyFlow: {
        "interpolant": "trigflow",
        "n_flow_steps": 2,
        "solver": "euler",
        "latent_std": 0.5,
        "gaussian": True,
        "log_std_init": -2.0,
        "log_std_bounds": (0.1, 0.2),
    },
    FPO: {"n_flow_steps": 2, "solver": "midpoint", "action_noise_std": 0.3},
    DPPO: {
        "process": "flow",
        "n_denoising_steps": 3,
        "n_finetuned_steps": 2,
        "min_sampling_std": 0.5,
        "min_log_prob_std": 0.7,
        "noise_clip": 0.1,
        "denoised_clip": 0.3,
        "identity_skip": False,
    },
}
OURS = [
    pytest.param(algorithm, name, value, id=f"{algorithm.__name__}-{name}")
    for algorithm in OWN
    for name, value in {**SHARED, **OWN[algorithm]}.items()
]
POLICIES = [
    pytest.param(algorithm, name, value, id=f"{algorithm.__name__}-{name}")
    for algorithm in OF_POLICIES
    for name, value in OF_POLICIES[algorithm].items()
]


def new(algorithm: type[Any], **options: Any) -> Any:
    """A model; one whose sizes do not divide each other warns, which is not the matter here."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = make(algorithm, steps(2), **{**SIZES, **options})
    if algorithm is not PPO:
        # The policy is pulled towards what it was at the beginning, as if that had been cloned.
        state = model.policy.state_dict()
        model.cloned_parameters = {name: part.numpy().copy() for name, part in state.items()}
    return model


def trained(model: Any, callback: Any = None) -> th.Tensor:
    """The weights after two rollouts, whatever was drawn before."""
    set_random_seed(0)
    return weights(model.learn(2 * model.n_steps * model.n_envs, callback))


GIVEN: dict[str, th.Tensor] = {}


def given(algorithm: type[Any], **options: Any) -> th.Tensor:
    """The weights of a model that has its options from the beginning."""
    key = f"{algorithm.__name__} {options}"
    if key not in GIVEN:
        GIVEN[key] = trained(new(algorithm, **options))
    return GIVEN[key]


def unless_refused(holder: Any, name: str, value: Any, run: Callable[[], Any]) -> Any:
    """Set an attribute and run; None if one of them was refused by a sentence."""
    try:
        setattr(holder, name, value)
        return run()
    except (ValueError, AttributeError) as refusal:
        if len(first_line(refusal).split()) < 6:
            raise
    return None


def test_every_option_is_among_those_tried() -> None:
    for algorithm, own in OWN.items():
        checked = {name for cls in algorithm.__mro__ for name in vars(cls).get("option_checks", {})}
        assert checked <= {*SHARED, *own}
        options = {option.name for option in own_options(algorithm.policy_base)}
        assert options == {*OF_POLICIES[algorithm]}


@pytest.mark.parametrize(("name", "value"), OF_PPO.items(), ids=str)
def test_set_after_construction(any_algorithm: type[Any], name: str, value: Any) -> None:
    """What PPO reads when it trains counts as if it had been given."""
    model = new(any_algorithm)
    setattr(model, name, value)
    assert th.equal(trained(model), given(any_algorithm, **{name: value}))
    assert not th.equal(trained(model), given(any_algorithm))


@pytest.mark.parametrize(("name", "value"), OF_PPO.items(), ids=str)
def test_set_in_a_callback(any_algorithm: type[Any], name: str, value: Any) -> None:
    """SB3's maintainers advise it for schedules of ``ent_coef``: it counts from then on."""
    change = Each(lambda callback: setattr(callback.model, name, value))
    assert th.equal(trained(new(any_algorithm), change), given(any_algorithm, **{name: value}))


def test_a_train_of_ones_own_takes_up_changes(algorithm: type[Any]) -> None:
    """Whoever writes ``train`` begins, as SB3's PPO does, with the learning rate."""

    class Own(algorithm):  # type: ignore[misc, valid-type]
        def train(self) -> None:
            self._update_learning_rate(self.policy.optimizer)

    model = Own("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8, device="cpu")
    model.learn(8, Each(lambda callback: setattr(callback.model, "learning_rate", 1e-5)))
    assert model.policy.optimizer.param_groups[0]["lr"] == 1e-5


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "name", "value"), OURS)
def test_ours_set_after_construction(algorithm: type[Any], name: str, value: Any) -> None:
    """As if it had been given, or refused by a sentence; in no case without effect."""
    others = USED_WITH.get(name, {})
    expected = given(algorithm, **{**others, name: value})
    assert not th.equal(expected, given(algorithm, **others))
    model = new(algorithm, **others)
    after = unless_refused(model, name, value, lambda: trained(model))
    assert after is None or th.equal(after, expected)


@pytest.mark.parametrize(("algorithm", "name", "value"), OURS)
def test_ours_set_to_what_is_not_allowed(algorithm: type[Any], name: str, value: Any) -> None:
    """Refused when it is set, or when it is used, if the constructor would refuse it."""
    try:
        new(algorithm, **{name: "nonsense"})
    except ValueError:
        model = new(algorithm)
        assert unless_refused(model, name, "nonsense", lambda: model.learn(64)) is None


@pytest.mark.slow
@pytest.mark.parametrize("holder", ["model", "policy"])
@pytest.mark.parametrize(("algorithm", "name", "value"), POLICIES)
def test_options_of_the_policy_set_after_construction(
    algorithm: type[Any], name: str, value: Any, holder: str, tmp_path: Path
) -> None:
    """On the model or its policy: with effect, in a file too, or refused."""
    model = new(algorithm)
    target = model if holder == "model" else model.policy
    after = unless_refused(target, name, value, lambda: trained(model))
    if after is None or (name, holder) == ("log_std_init", "policy"):  # a start, which has passed
        return
    assert not th.equal(after, given(algorithm)), "no effect"
    assert th.equal(*resumed(algorithm, model, tmp_path / "model"))


# Files have what is in force


def resumed(algorithm: type[Any], model: Any, path: Path) -> tuple[th.Tensor, th.Tensor]:
    """The weights of a run that goes on, and of one that goes on from a file."""
    model.save(path)
    again = {} if algorithm is PPO else {"reseed": True}
    loaded = algorithm.load(path, env=steps(2), device="cpu", **again)
    model.set_env(steps(2))
    return trained(model), trained(loaded)


SAVED = [pytest.param(PPO, name, value, id=f"PPO-{name}") for name, value in OF_PPO.items()] + [
    *OURS,
    *(pytest.param(k, "lr_schedule", RATE, id=f"{k.__name__}-lr_schedule") for k in OWN),
]


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "name", "value"), SAVED)
def test_saved_and_resumed(algorithm: type[Any], name: str, value: Any, tmp_path: Path) -> None:
    """A run that is resumed from a file goes on as the one that was not broken off.

    PPO's own do not with ``gamma``, ``gae_lambda``, ``n_steps``, ``learning_rate`` and
    ``lr_schedule``: its buffer and its schedule have copies, which a file makes anew.
    """
    model = new(algorithm, **USED_WITH.get(name, {}))
    trained(model)
    path = tmp_path / "model"
    both = unless_refused(model, name, value, lambda: resumed(algorithm, model, path))
    assert both is None or th.equal(*both)


# Learning rates


def test_learning_rate_is_set_through_its_schedule(any_algorithm: type[Any]) -> None:
    expected = given(any_algorithm, learning_rate=1e-3)
    model = new(any_algorithm)
    model.lr_schedule = RATE
    assert th.equal(trained(model), expected)
    model = new(any_algorithm)
    model.learning_rate = 1e-3
    model._setup_lr_schedule()
    assert th.equal(trained(model), expected)


class Decay(BaseCallback):
    """Halves the learning rate with each rollout."""

    def _on_rollout_end(self) -> None:
        rate = self.model.lr_schedule(1.0) / 2
        self.model.lr_schedule = lambda _: rate

    def _on_step(self) -> bool:
        return True


def test_learning_rate_set_by_a_callback(any_algorithm: type[Any]) -> None:
    model = new(any_algorithm).learn(96, Decay())
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(1e-2 / 8)


def test_learning_rate_of_the_optimizer_is_overwritten(any_algorithm: type[Any]) -> None:
    """The schedule has the last word."""

    def change(callback: Any) -> None:
        callback.model.policy.optimizer.param_groups[0]["lr"] = 1.0

    assert th.equal(trained(new(any_algorithm), Each(change)), given(any_algorithm))


@pytest.mark.parametrize(("name", "value"), [("lr_schedule", RATE), ("learning_rate", 1e-3)])
def test_schedule_under_an_adaptive_learning_rate(
    algorithm: type[Any], name: str, value: Any
) -> None:
    """With ``desired_kl`` the rate goes on from what was set, or setting it is refused."""
    model = new(algorithm, desired_kl=0.01)
    after = unless_refused(model, name, value, lambda: trained(model))
    assert after is None or not th.equal(after, given(algorithm, desired_kl=0.01))


# Changes that need more than one option to be judged


@pytest.mark.parametrize("name", ["desired_kl", "learning_rate", "ent_coef"])
def test_schedules_that_end_at_zero(algorithm: type[Any], name: str, tmp_path: Path) -> None:
    value = "lin_0.01" if name != "learning_rate" else lambda remaining: 0.01 * remaining
    model = new(algorithm, **{name: value}).learn(64)
    model.save(tmp_path / "model")
    algorithm.load(tmp_path / "model", env=steps(2)).learn(64)


def test_policies_with_other_defaults(tmp_path: Path) -> None:
    """What a policy class sets itself has not been changed by the user."""
    model = PolicyFlow(Quiet, steps(2), n_steps=16, batch_size=8, device="cpu").learn(64)
    model.save(tmp_path / "model")
    loaded = PolicyFlow.load(tmp_path / "model", env=steps(2)).learn(32)
    assert loaded.policy.n_flow_steps == 3


class Quiet(PolicyFlowPolicy):
    """Has defaults of its own."""

    def __init__(self, *args: Any, log_std_init: float = -1.0, **kwargs: Any) -> None:
        super().__init__(*args, log_std_init=log_std_init, n_flow_steps=3, **kwargs)


def test_options_that_do_not_go_together() -> None:
    model = new(PolicyFlow, brownian_coef=0.5)
    model.gaussian = True
    with pytest.raises(ValueError, match="brownian_coef"):
        model.learn(64)


def test_options_changed_to_and_fro(tmp_path: Path) -> None:
    model = new(PolicyFlow, policy_kwargs={"deterministic_action": "drawn", "n_flow_steps": 5})
    for n_flow_steps, kind in ((4, "zero"), (5, "drawn"), (6, "mode")):
        model.n_flow_steps, model.deterministic_action = n_flow_steps, kind
        model.learn(32).save(tmp_path / "model")
        loaded = PolicyFlow.load(tmp_path / "model").policy
        assert (loaded.n_flow_steps, loaded.deterministic_action) == (n_flow_steps, kind)


def test_former_names_do_not_come_back(tmp_path: Path) -> None:
    model = new(PolicyFlow, policy_kwargs={"path": "trigflow"})
    model.interpolant = "rectified"
    model.save(tmp_path / "model")
    assert PolicyFlow.load(tmp_path / "model").interpolant == "rectified"


def test_fixed_options_can_be_set_back() -> None:
    model = new(DPPO)
    model.policy.denoised_clip = 0.5
    with pytest.raises(ValueError, match=r"Set denoised_clip to 1\.0 again"):
        model.learn(32)
    model.policy.denoised_clip = 1.0
    model.learn(32)


@pytest.mark.parametrize("name", ["gamma", "target_kl", "vf_coef", "max_grad_norm"])
def test_functions_are_schedules_where_there_are_schedules(algorithm: type[Any], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        new(algorithm, **{name: lambda remaining: 0.5})


class Larger(BaseCallback):
    """Sets ``n_steps`` when training has begun."""

    def _on_training_start(self) -> None:
        self.model.n_steps = 32

    def _on_step(self) -> bool:
        return True


def test_rollouts_cannot_become_longer(algorithm: type[Any]) -> None:
    with pytest.raises(ValueError, match=r"n_steps cannot change from 16 to 32"):
        new(algorithm).learn(64, Larger())


def test_one_rollout_has_one_gamma(algorithm: type[Any]) -> None:
    def change(callback: Any) -> None:
        callback.model.gamma = 0.0

    usual, changed = new(algorithm).learn(32), new(algorithm).learn(32, Each(change))
    for name in ("rewards", "returns"):
        found = getattr(changed.rollout_buffer, name)
        assert (found == getattr(usual.rollout_buffer, name)).all()
