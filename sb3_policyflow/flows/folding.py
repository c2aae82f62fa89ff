"""The first layer of a velocity field, split into its three summands, which saves most of its work.

W [x, t_emb(t) + W_o s + b_o] + b = W_x x + (W_e t_emb(t) + W_e b_o + b) + (W_e W_o) s

The middle term depends on time alone: a solver sees few times and needs a small table. The last
depends on the observation alone: it is computed once for all times.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import torch as th
from torch import nn
from torch.nn.modules import module as torch_module

from sb3_policyflow.flows.choices import choose
from sb3_policyflow.flows.solvers import SOLVERS, solver_times_like

if TYPE_CHECKING:  # that module imports this one
    from sb3_policyflow.flows.velocity import VelocityField

HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
"""Attributes of a module that hold its hooks, by name; torch has no public way to ask for them."""
GLOBAL_HOOKS: tuple[Mapping[int, object], ...] = (
    torch_module._global_forward_hooks,
    torch_module._global_forward_pre_hooks,
    torch_module._global_backward_hooks,
    torch_module._global_backward_pre_hooks,
)
"""Hooks of all modules, in torch's own dictionaries."""


def has_hooks(module: nn.Module) -> bool:
    """Whether anything takes part in a module's call beside the ``forward`` of its class.

    Hooks are how pruning, weight normalization and those who watch activations take part.

    >>> layer = nn.Linear(1, 1)
    >>> handle = layer.register_forward_hook(print)
    >>> has_hooks(layer), has_hooks(nn.Linear(1, 1))
    (True, False)
    """
    if "forward" in vars(module) or any(GLOBAL_HOOKS):
        return True
    return any(getattr(module, name) for name in HOOKS)


class FoldedLayer(NamedTuple):
    """What points, features and times contribute to the first layer of h outputs.

    ``points`` W_x, shape (h, dim); ``features`` W_e W_o, shape (h, features_dim); ``table``, a row
    for each time, shape (n_times, h).
    """

    points: th.Tensor
    features: th.Tensor
    table: th.Tensor


def is_foldable(field: "VelocityField") -> bool:
    """Whether the first layer of a field is plainly linear, and can be split."""
    first, observation = field.layers[0], field.observation_embedding
    is_linear = type(first) is nn.Linear and type(observation) is nn.Linear
    is_watched = has_hooks(field) or has_hooks(first) or has_hooks(observation)
    return field.has_formula_of_paper and is_linear and not is_watched


def fold(field: "VelocityField", times: th.Tensor) -> FoldedLayer:
    """Split the first layer; differentiable.

    :param field: The velocity field.
    :param times: Times for the table, shape (n_times,).
    """
    first = field.layers[0]
    assert isinstance(first, nn.Linear)
    observation = field.observation_embedding
    embeddings = field.time_embedding(times) + observation.bias
    dim = first.in_features - observation.out_features
    return split_first_layer(dim, first.weight, first.bias, observation.weight, embeddings)


def split_first_layer(
    dim: int,
    weight: th.Tensor,
    bias: th.Tensor,
    observation_weight: th.Tensor,
    embeddings: th.Tensor,
) -> FoldedLayer:
    """Split the first layer, given what it consists of.

    :param dim: Dimensions of the points.
    :param weight: W, shape (h, dim + embedding_dim).
    :param bias: b, shape (h,).
    :param observation_weight: W_o, shape (embedding_dim, features_dim).
    :param embeddings: t_emb(t) + b_o of each time, shape (n_times, embedding_dim).
    """
    of_points, of_embedding = weight[:, :dim], weight[:, dim:]
    table = nn.functional.linear(embeddings, of_embedding, bias)
    return FoldedLayer(of_points, of_embedding @ observation_weight, table)


def integrate_folded(
    field: "VelocityField",
    latents: th.Tensor,
    features: th.Tensor,
    *,
    n_steps: int,
    solver: str,
    end_time: float = 1.0,
) -> th.Tensor:
    """What ``integrate`` yields for a velocity field, with its first layer split.

    >>> from sb3_policyflow.flows import VelocityField
    >>> field, z, s = VelocityField(2, 3, [16]), th.randn(5, 2), th.randn(5, 3)
    >>> integrate_folded(field, z, s, n_steps=4, solver="heun").shape
    torch.Size([5, 2])

    :param field: The velocity field, see :func:`is_foldable`.
    :param latents: z, shape (..., dim).
    :param features: s, shape (..., features_dim).
    :param n_steps: Number of equal steps.
    :param solver: Name of the solver.
    :param end_time: T, where the flow ends.
    :return: phi, of the shape of ``latents``.
    """
    times = solver_times_like(latents, solver, n_steps, end_time)
    first = fold(field, times)
    shift = features @ first.features.T
    rest = nn.Sequential(*field.layers[1:])

    def velocity(points: th.Tensor, row: th.Tensor) -> th.Tensor:
        value: th.Tensor = rest(points @ first.points.T + (shift + row))
        return value

    return choose("solver", solver, SOLVERS).solve(velocity, latents, times, first.table)
