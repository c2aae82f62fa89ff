"""However weights change, the next action is theirs."""

import copy
import itertools
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch as th
from torch import nn
from torch.nn.utils import parametrizations, prune

from sb3_policyflow import PolicyFlow
from sb3_policyflow.flows import SOLVERS, VelocityField, integrate
from tests.kernels.plain import integrate_plainly, make_field

OPTIONS: dict[str, Any] = {"solver": "midpoint", "n_steps": 4, "end_time": 1.0}
GLOROT = {"initialization": "glorot"}
Z, S = th.linspace(-1, 1, 10).view(5, 2), th.linspace(-2, 1, 15).view(5, 3)


def step(optimizer: Callable[..., th.optim.Optimizer], **options: Any) -> Callable[[Any], None]:
    def change(field: nn.Module) -> None:
        chosen = optimizer(field.parameters(), lr=0.1, **options)
        with th.enable_grad():
            field(Z, th.linspace(0, 1, 5), S).square().sum().backward()
        chosen.step()

    return change


def edit_data(field: Any) -> None:
    field.output.weight.data.add_(1.0)


def edit_memory(field: Any) -> None:
    field.hidden[2].bias.detach().numpy()[:] += 1.0


def replace_data(field: Any) -> None:
    for parameter in field.parameters():
        parameter.data = th.randn_like(parameter)


def transpose_data(field: Any) -> None:
    field.hidden[2].weight.data = field.hidden[2].weight.data.t()


def replace_parameter(field: Any) -> None:
    field.hidden[0].weight = nn.Parameter(th.randn_like(field.hidden[0].weight))


def replace_layer(field: Any) -> None:
    field.hidden[2] = nn.Linear(8, 8)


def replace_activations(field: Any) -> None:
    field.hidden[1], field.hidden[3] = nn.ReLU(), nn.ReLU()


def replace_one_activation(field: Any) -> None:
    field.hidden[3] = nn.SiLU()


def change_time(field: Any) -> None:
    field.time_embedding.mlp[2].weight.data.mul_(3.0)


def change_frequencies(field: Any) -> None:
    doubled = 2 * field.time_embedding.frequencies
    field.time_embedding.frequencies = nn.Parameter(doubled, requires_grad=False)


def change_frequencies_in_place(field: Any) -> None:
    field.time_embedding.frequencies.mul_(2)


def change_observation(field: Any) -> None:
    field.observation_embedding.bias.data[0] = 5.0


def load(field: Any) -> None:
    field.load_state_dict(make_field(2, 3, [8, 8]).state_dict())


def assign(field: Any) -> None:
    field.load_state_dict(make_field(2, 3, [8, 8]).state_dict(), assign=True)


def there_and_back(field: Any) -> None:
    field.double()
    field.output.bias.data.add_(1.0)
    field.float()


def sign_of_zero_and_back(field: Any) -> None:
    field.output.bias.data.zero_()
    field.output.bias.data.neg_()


def grow(field: Any) -> None:
    """Change shapes and leave the parameters the same objects."""
    field.hidden[2].weight.data = th.randn(6, 8)
    field.hidden[2].bias.data = th.randn(6)
    field.output.weight.data = th.randn(2, 6)


CHANGES: list[Callable[[Any], None]] = [
    step(th.optim.SGD),
    step(th.optim.Adam, fused=True),
    step(th.optim.Adam, foreach=True),
    step(th.optim.AdamW, fused=True),
    edit_data,
    edit_memory,
    replace_data,
    transpose_data,
    replace_parameter,
    replace_layer,
    replace_activations,
    replace_one_activation,
    change_time,
    change_frequencies,
    change_frequencies_in_place,
    change_observation,
    load,
    assign,
    there_and_back,
    sign_of_zero_and_back,
]


@pytest.mark.parametrize("change", CHANGES)
def test_every_change_is_seen(change: Callable[[Any], None]) -> None:
    field = make_field(2, 3, [8, 8], nn.Tanh)
    with th.no_grad():
        before = field.integrate(Z, S, **OPTIONS)
        assert th.equal(field.integrate(Z, S, **OPTIONS), before)
    change(field)
    with th.no_grad():
        after = field.integrate(Z, S, **OPTIONS)
        th.testing.assert_close(after, reference(field), rtol=1e-5, atol=1e-5)
    if change is not sign_of_zero_and_back:
        assert not th.allclose(after, before, atol=1e-4)


def reference(field: VelocityField) -> th.Tensor:
    """End points by the modules themselves, called one by one."""

    def velocity(x: th.Tensor, t: th.Tensor) -> th.Tensor:
        embedding = field.time_embedding(t) + field.observation_embedding(S)
        result: th.Tensor = field.output(field.hidden(th.cat([x, embedding], dim=-1)))
        return result

    return integrate(velocity, Z, **OPTIONS)


def test_shapes_that_change_under_the_same_parameters() -> None:
    field = make_field(2, 3, [8, 8])
    with th.no_grad():
        field.integrate(Z, S, **OPTIONS)
        grow(field)
        th.testing.assert_close(field.integrate(Z, S, **OPTIONS), reference(field))


@pytest.mark.parametrize("wrap", [prune.random_unstructured, parametrizations.weight_norm])
def test_reparametrized_layers(wrap: Any) -> None:
    field = make_field(2, 3, [8, 8])
    with th.no_grad():
        field.integrate(Z, S, **OPTIONS)
    arguments = {"amount": 0.5} if wrap is prune.random_unstructured else {}
    wrap(field.hidden[2], name="weight", **arguments)
    with th.no_grad():
        th.testing.assert_close(field.integrate(Z, S, **OPTIONS), reference(field))


def test_a_hook_sees_and_changes_what_passes() -> None:
    field = make_field(2, 3, [8, 8])
    with th.no_grad():
        before = field.integrate(Z, S, **OPTIONS)
        handle = field.hidden[1].register_forward_hook(lambda _m, _i, output: 2 * output)
        hooked = field.integrate(Z, S, **OPTIONS)
        th.testing.assert_close(hooked, reference(field))
        assert not th.allclose(hooked, before)
        handle.remove()
        assert th.equal(field.integrate(Z, S, **OPTIONS), before)


def test_first_use_in_inference_mode() -> None:
    field = make_field(2, 3, [8, 8])
    with th.inference_mode():
        field.integrate(Z, S, **OPTIONS)
    with th.no_grad():
        others = {**OPTIONS, "solver": "rk4"}
        th.testing.assert_close(
            field.integrate(Z, S, **others), integrate_plainly(field, Z, S, **others)
        )
    step(th.optim.SGD)(field)
    with th.no_grad():
        th.testing.assert_close(field.integrate(Z, S, **OPTIONS), reference(field))


def test_copies_go_their_own_way() -> None:
    field = make_field(2, 3, [8, 8])
    with th.no_grad():
        before = field.integrate(Z, S, **OPTIONS)
        twins = [copy.deepcopy(field), pickle.loads(pickle.dumps(field))]
        field.output.bias.add_(1.0)
        field.integrate(Z, S, **OPTIONS)
        for twin in twins:
            assert th.equal(twin.integrate(Z, S, **OPTIONS), before)
            twin.output.bias.add_(2.0)
            after = twin.integrate(Z, S, **OPTIONS)
            th.testing.assert_close(after, integrate_plainly(twin, Z, S, **OPTIONS))


def test_one_field_serves_many_solvers_in_turn() -> None:
    """What is kept for one solver is not taken for another, and follows the weights too."""
    field = make_field(2, 3, [8, 8])
    choices = itertools.product(SOLVERS, (1, 3), (1.0, 1.5))
    all_options = [dict(zip(OPTIONS, choice, strict=True)) for choice in choices]
    with th.no_grad():
        for _ in range(3):
            for options in [*all_options, *all_options[-2:]]:
                ours = field.integrate(Z, S, **options)
                th.testing.assert_close(ours, integrate_plainly(field, Z, S, **options))
            field.output.weight.add_(0.1)


def test_a_policy_whose_steps_are_changed_takes_as_many_at_once() -> None:
    policy = PolicyFlow("MlpPolicy", "Pendulum-v1", policy_kwargs=GLOROT).policy
    observation = policy.observation_space.sample()
    actions = []
    for policy.n_flow_steps in (12, 1, 12):
        actions.append(policy.predict(observation, deterministic=True)[0].item())
    assert actions[0] == actions[2] != actions[1]


def test_a_loaded_and_a_changed_model(tmp_path: Any) -> None:
    model = PolicyFlow(
        "MlpFlowPolicy", "Pendulum-v1", n_steps=64, batch_size=32, n_epochs=1, seed=0
    )
    observation = model.observation_space.sample()
    first, _ = model.predict(observation, deterministic=True)
    model.save(tmp_path / "model")
    model.learn(64)
    learned, _ = model.predict(observation, deterministic=True)
    assert learned != first
    parameters = copy.deepcopy(model.get_parameters())
    model.set_parameters(str(tmp_path / "model.zip"))
    assert model.predict(observation, deterministic=True)[0] == first
    model.set_parameters(parameters)
    assert model.predict(observation, deterministic=True)[0] == learned
    loaded = PolicyFlow.load(tmp_path / "model")
    assert loaded.predict(observation, deterministic=True)[0] == first
    vector = model.policy.parameters_to_vector()
    loaded.policy.load_from_vector(vector)
    assert loaded.predict(observation, deterministic=True)[0] == learned
