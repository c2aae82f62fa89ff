"""An option is written once: where it may be given, under which names, and what it then does."""

import inspect
import warnings
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3 import PPO
from torch import nn

from sb3_policyflow import DPPO, FPO, PolicyFlow
from tests.helpers import SMALL, learned

OWN_OPTIONS: dict[type[Any], dict[str, Any]] = {
    PolicyFlow: {"n_flow_steps": 3, "interpolant": "trigflow", "latent_std": 0.5},
    FPO: {"n_flow_steps": 3, "action_noise_std": 0.2},
    DPPO: {"n_denoising_steps": 4, "min_sampling_std": 0.2},
}
of_every_policy = pytest.mark.parametrize("algorithm", OWN_OPTIONS)


@of_every_policy
def test_signatures_are_complete(algorithm: type[Any]) -> None:
    parameters = inspect.signature(algorithm).parameters
    assert list(parameters)[: len(inspect.signature(PPO).parameters)] == list(
        inspect.signature(PPO).parameters
    )
    assert {"desired_kl", "lr_adaptation_kwargs", *OWN_OPTIONS[algorithm]} <= parameters.keys()
    assert not any(p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in parameters.values())


@of_every_policy
def test_options_of_the_policy_have_one_default(algorithm: type[Any]) -> None:
    ours = inspect.signature(algorithm).parameters
    of_policy = inspect.signature(algorithm.policy_base.__init__).parameters
    model = algorithm("MlpPolicy", "Pendulum-v1", **SMALL)
    for name in OWN_OPTIONS[algorithm]:
        assert ours[name].default == of_policy[name].default == getattr(model.policy, name)


def test_arguments_may_be_positional() -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", 1e-3, 32, 16, 2)
    assert (model.learning_rate, model.n_steps, model.batch_size, model.n_epochs) == (
        1e-3,
        32,
        16,
        2,
    )
    with pytest.raises(TypeError, match="multiple values"):
        PolicyFlow("MlpPolicy", "Pendulum-v1", 1e-3, learning_rate=1e-3)


@of_every_policy
def test_options_of_the_policy_are_given_to_either(algorithm: type[Any], tmp_path: Path) -> None:
    options = OWN_OPTIONS[algorithm]
    to_algorithm = algorithm("MlpPolicy", "Pendulum-v1", **SMALL, **options)
    to_policy = algorithm("MlpPolicy", "Pendulum-v1", **SMALL, policy_kwargs=options)
    for model in (to_algorithm, to_policy):
        model.save(tmp_path / "model")
        for one in (model, algorithm.load(tmp_path / "model")):
            assert {name: getattr(one.policy, name) for name in options} == options
    assert to_algorithm.policy_kwargs == {}
    assert to_policy.policy_kwargs == options


@of_every_policy
def test_options_may_change_when_loading(algorithm: type[Any], tmp_path: Path) -> None:
    options = OWN_OPTIONS[algorithm]
    name = next(iter(options))
    for given in ({}, {"policy_kwargs": options}):
        algorithm("MlpPolicy", "Pendulum-v1", **SMALL, **given).save(tmp_path / "model")
        loaded = algorithm.load(tmp_path / "model", gamma=0.5, **{name: 5})
        assert (loaded.gamma, getattr(loaded.policy, name)) == (0.5, 5)


@pytest.mark.parametrize(
    ("algorithm", "former", "present"),
    [
        (PolicyFlow, {"path": "trigflow"}, {"interpolant": "trigflow"}),
        (PolicyFlow, {"time_sampler": "starts"}, {"time_sampler": "grid_without_end"}),
        (FPO, {"n_probes": 3, "probe_average": "objective"}, {"n_mc_samples": 3}),
        (
            DPPO,
            {"desired_kl": 0.01, "lr_adaptation": "minibatch", "lr_bounds": [1e-5, 1e-3]},
            {"lr_adaptation_kwargs": {"interval": "minibatch", "bounds": [1e-5, 1e-3]}},
        ),
        (FPO, {"desired_kl": 0.01, "kl_margin": 3.0, "lr_factor": 1.2}, {}),
    ],
    ids=str,
)
def test_former_names(
    algorithm: type[Any], former: dict[str, Any], present: dict[str, Any], tmp_path: Path
) -> None:
    with pytest.warns(DeprecationWarning, match=r"is now .*: use the new name\.") as caught:
        model = algorithm("MlpPolicy", "Pendulum-v1", **SMALL, **former)
    assert {Path(warning.filename).name for warning in caught} == {Path(__file__).name}
    model.save(tmp_path / "model")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = algorithm.load(tmp_path / "model")
    for one in (model, loaded):
        for name, value in present.items():
            holder = one if hasattr(one, name) else one.policy
            assert getattr(holder, name) == value
        assert not former.keys() & vars(one).keys() - present.keys() - {"desired_kl"}


TRIGFLOW: dict[str, Any] = {"path": "trigflow"}


@pytest.mark.parametrize(
    ("algorithm", "options", "message"),
    [
        (PolicyFlow, {**TRIGFLOW, "interpolant": "rectified"}, "leave out path"),
        (
            PolicyFlow,
            {"interpolant": "rectified", "policy_kwargs": TRIGFLOW},
            r"Give \['interpolant'\] to PolicyFlow or in policy_kwargs, not to both",
        ),
        (
            PolicyFlow,
            {**TRIGFLOW, "policy_kwargs": {"interpolant": "rectified"}},
            r"Give \['interpolant'\] to PolicyFlow or in policy_kwargs, not to both",
        ),
        (PolicyFlow, {"policy_kwargs": {**TRIGFLOW, "interpolant": "rectified"}}, "leave out path"),
        (
            DPPO,
            {"policy_kwargs": {"initialisation": "glorot", "initialization": "zero"}},
            "initialisation is now initialization, and both are given: leave out initialisation",
        ),
        (FPO, {"n_probes": 3, "n_mc_samples": 3}, "leave out n_probes"),
        (
            FPO,
            {"lr_factor": 1.2, "lr_adaptation_kwargs": {"factor": 1.3}},
            "lr_factor is now lr_adaptation_kwargs with the key factor",
        ),
    ],
    ids=str,
)
def test_what_is_given_under_both_names_is_refused(
    algorithm: type[Any], options: dict[str, Any], message: str
) -> None:
    for policy in ("MlpPolicy", algorithm.policy_aliases["MlpPolicy"]):
        with pytest.raises(ValueError, match=message):
            algorithm(policy, "Pendulum-v1", **SMALL, **options)


def test_former_names_and_present_ones_of_other_keys_go_together() -> None:
    with pytest.warns(DeprecationWarning, match="lr_factor is now"):
        model = FPO(
            "MlpPolicy",
            "Pendulum-v1",
            **SMALL,
            lr_factor=1.2,  # type: ignore[call-arg]
            lr_adaptation_kwargs={"margin": 3.0},
        )
    assert model.lr_adaptation_kwargs == {"factor": 1.2, "margin": 3.0}


class WithOwnPath(PolicyFlow.policy_base):  # type: ignore[name-defined,misc]
    """Has an option of its own that was once the name of another."""

    def __init__(self, *args: Any, path: str, **kwargs: Any) -> None:
        self.own_path = path
        super().__init__(*args, **kwargs)


def test_a_policy_of_ones_own_may_have_an_option_of_a_former_name() -> None:
    own = {"path": "mine", "interpolant": "trigflow"}
    policy: Any = PolicyFlow(WithOwnPath, "Pendulum-v1", **SMALL, policy_kwargs=own).policy
    assert (policy.own_path, policy.interpolant) == ("mine", "trigflow")


def test_both_names_are_refused_when_loading(tmp_path: Path) -> None:
    for algorithm, former, present in (
        (PolicyFlow, {"path": "trigflow"}, {"interpolant": "rectified"}),
        (FPO, {"n_probes": 3}, {"n_mc_samples": 4}),
    ):
        algorithm("MlpPolicy", "Pendulum-v1", **SMALL).save(tmp_path / "model")
        options: dict[str, Any] = {**former, **present}
        with pytest.raises(ValueError, match="and both are given: leave out"):
            algorithm.load(tmp_path / "model", **options)


def test_former_names_when_loading(tmp_path: Path) -> None:
    PolicyFlow("MlpPolicy", "Pendulum-v1", desired_kl=0.01, **SMALL).save(tmp_path / "model")
    loaded = PolicyFlow.load(tmp_path / "model", lr_factor=1.25)
    assert loaded.lr_adaptation_kwargs == {"factor": 1.25}


def test_a_former_name_that_is_also_a_parameter_of_load(tmp_path: Path) -> None:
    """``path`` is the file where it alone is given, and an option beside a file."""
    with pytest.warns(DeprecationWarning, match="path is now interpolant"):
        model = PolicyFlow("MlpPolicy", "Pendulum-v1", path="trigflow", **SMALL)
    model.save(tmp_path / "model")
    options: dict[str, Any] = {**SMALL, "path": "rectified"}
    assert PolicyFlow.load(tmp_path / "model", **options).policy.interpolant == "rectified"
    env = model.get_env()
    loaded = PolicyFlow.load(str(tmp_path / "model"), env, **options)
    assert loaded.policy.interpolant == "rectified"
    assert loaded.learn(16).num_timesteps == 16
    assert PolicyFlow.load(path=tmp_path / "model", env=env).policy.interpolant == "trigflow"
    assert next(iter(inspect.signature(PolicyFlow.load).parameters)) == "path"


@of_every_policy
def test_load_needs_one_file(algorithm: type[Any], tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'path'"):
        algorithm.load()
    if algorithm is not PolicyFlow:
        with pytest.raises(TypeError, match="multiple values for argument 'path'"):
            algorithm.load(tmp_path / "model", path=tmp_path / "model")


def test_former_names_of_policies() -> None:
    with pytest.warns(DeprecationWarning, match="initialisation is now initialization"):
        model = FPO("MlpPolicy", "Pendulum-v1", policy_kwargs={"initialisation": "zero"}, **SMALL)
    assert not any(parameter.any() for parameter in learned(model.policy.velocity))
    with pytest.warns(DeprecationWarning, match="path is now interpolant"):
        policy = PolicyFlow.policy_aliases["MlpPolicy"](
            model.observation_space,
            model.action_space,
            lambda _: 1e-3,
            path="trigflow",  # type: ignore[call-arg]
        )
    assert policy.interpolant == "trigflow"


def test_a_coefficient_that_a_callback_changes_has_an_effect() -> None:
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", ent_coef="lin_0.1", **SMALL)
    assert model.value_of("ent_coef") == 0.1
    model.ent_coef = 0.25  # type: ignore[assignment]  # as in SB3
    assert model.value_of("ent_coef") == 0.25


def test_verbose_says_once_why_kernels_are_off(capsys: pytest.CaptureFixture[str]) -> None:
    policy_kwargs = {"activation_fn": nn.Softsign}
    model = PolicyFlow("MlpPolicy", "Pendulum-v1", verbose=1, policy_kwargs=policy_kwargs, **SMALL)
    model.learn(SMALL["n_steps"])
    model.learn(SMALL["n_steps"], reset_num_timesteps=False)
    assert capsys.readouterr().out.count("Softsign") == 1


def test_verbose_has_nothing_to_say_of_kernels_that_are_on(
    capsys: pytest.CaptureFixture[str],
) -> None:
    PolicyFlow("MlpPolicy", "Pendulum-v1", verbose=1, **SMALL).learn(SMALL["n_steps"])
    assert "kernels" not in capsys.readouterr().out


@of_every_policy
def test_the_cpu_is_recommended_as_for_ppo(algorithm: type[Any]) -> None:
    for one in (PPO, algorithm):
        with pytest.warns(UserWarning, match=f"You are trying to run {one.__name__} on the GPU"):
            one("MlpPolicy", "Pendulum-v1", device="meta")
