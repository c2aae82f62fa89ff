"""What kernels take: arrays and places in memory, by name, and the functions that take them.

Addresses are those of contiguous float32 arrays, which somebody must keep alive; nothing checks
their shapes, so they are made from a module's current tensors for each call, see
:mod:`sb3_policyflow.kernels.inspection`. Numba compiles a kernel for these tuples as it does for
arrays. Nothing here imports it.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Integers = NDArray[np.int64]


class KernelInput(NamedTuple):
    """The first layer of a network, of h outputs: [points, features] @ weights + table[entries].

    ``points`` (n, n_points) and ``features`` (m, n_features), each of which serves n / m
    neighboring rows; ``weights`` (n_points + n_features, h); ``table`` (n_entries, h); ``entries``
    (n,), where an empty array stands for zeros.
    """

    points: Floats
    features: Floats
    weights: Floats
    table: Floats
    entries: Integers


class MLPLayout(NamedTuple):
    """Where an MLP is in memory.

    Addresses of the ``weights`` (n_out, n_in) and ``biases`` (n_out,) of all layers; ``widths``,
    the outputs of each layer but the last; the address of the ``activation``, and its parameter.
    """

    weights: Integers
    biases: Integers
    widths: Integers
    activation: int
    alpha: float


class MLPGradients(NamedTuple):
    """Gradients that an MLP's backward pass adds to.

    ``first``: those of the first layer's weights (n_points + n_features, h) and of the table, and
    ``others``: those of weight and bias of each layer behind the first, flat, one behind the other.
    ``points`` (n, n_points) and ``features`` (m, n_features) are filled, or empty if they are not
    wanted.
    """

    first: Floats
    others: Floats
    points: Floats
    features: Floats


class FieldLayout(NamedTuple):
    """Where the embeddings and the first layer of a velocity field are in memory.

    The ``dim`` of the points, which are the first inputs of the first layer; the activation of the
    time embedding, as in :class:`MLPLayout`; and addresses of the ``frequencies``, and of the
    weights and biases of the time embedding's hidden and output layer, of the observation
    embedding, and of the ``first`` layer.
    """

    dim: int
    activation: int
    alpha: float
    n_frequencies: int
    frequencies: int
    time_hidden_weight: int
    time_hidden_bias: int
    time_output_weight: int
    time_output_bias: int
    observation_weight: int
    observation_bias: int
    first_weight: int
    first_bias: int


class FirstLayer(NamedTuple):
    """A field's first layer of h outputs, for points and features, and what comes before it.

    The ``weights`` (dim + n_features, h) of points and features; the ``table`` of distinct times
    (n_times, h); the ``entries`` of it for each time (n_times,). For the backward pass the
    ``phases`` of the times (n_times, 2 n_frequencies); the time embedding's ``hidden`` layer, its
    ``derivatives``, and the ``embeddings`` plus b_o, each (n_times, embedding_dim).
    """

    weights: Floats
    table: Floats
    entries: Integers
    phases: Floats
    hidden: Floats
    derivatives: Floats
    embeddings: Floats


class FoldedNetwork(NamedTuple):
    """A velocity field whose first layer is split, see :mod:`sb3_policyflow.flows.folding`.

    Weights of the first layer for ``points`` (dim, widths[0]) and ``features`` (n_features,
    widths[0]); the ``hidden`` layers behind the first, weights (n_in, n_out) and biases, flat; the
    layers' ``widths``; weight (dim, widths[-1]) and ``bias`` of the ``output``; the
    activation, as in :class:`MLPLayout`.
    """

    points: Floats
    features: Floats
    hidden: Floats
    widths: Integers
    output: Floats
    bias: Floats
    activation: int
    alpha: np.float32


class Method(NamedTuple):
    """A fixed-step solver on a grid of times.

    Stage i of a step is k_i = v(x + sum_j a_ij k_j), and a step ends at x + sum_i b_i k_i, where a
    and b contain the step size; a multistep method adds m (k_0 - k_0 of the step before).

    ``table`` (n_times, widths[0]) is what each time adds to the first layer; ``time_indices``
    (n_steps, n_stages) are its rows for each stage; ``tableau`` has the rows a_i, b and m.
    """

    table: Floats
    time_indices: Integers
    tableau: Floats


class LossTargets(NamedTuple):
    """What a minibatch of m samples is to be like, for the losses of actor and critic.

    Of PolicyFlow's actor, with k rows for each sample: ``actions`` and ``endpoints`` (m, dim),
    ``advantages`` (m,), ``reference_velocity`` (m k, dim), ``scores`` (m k, 3), the interpolant's
    score coefficients, ``latent_std``, ``log_std`` and ``old_log_std`` (dim,).
    Of the critic: ``old_values`` and ``returns`` (m,).
    """

    actions: Floats
    endpoints: Floats
    advantages: Floats
    reference_velocity: Floats
    scores: Floats
    latent_std: Floats
    log_std: Floats
    old_log_std: Floats
    old_values: Floats
    returns: Floats


class LossOptions(NamedTuple):
    """Options of the losses of actor and critic.

    The ``end_time`` of the interpolant, whether the mean shift over a sample's
    times has one surrogate (``averages_shift``), infinity for bounds that there are not,
    ``sums_dimensions`` of the Brownian regularizer, and the weights of regularizers and critic.
    """

    end_time: float
    averages_shift: bool
    clip_range: float
    log_ratio_clamp: float
    brownian_coef: float
    sums_dimensions: bool
    ent_coef: float
    vf_coef: float
    clip_range_vf: float


class AdamOptions(NamedTuple):
    """Options of Adam, by torch's names; ``decoupled`` weight decay is that of AdamW."""

    lr: float
    beta1: float
    beta2: float
    eps: float
    weight_decay: float
    decoupled: bool


N_SUMS = 8
OBJECTIVE, CLIPPED, RATIO, LARGEST, KL, BROWNIAN, CHANGE, VALUE = range(N_SUMS)
"""Where a kernel of losses adds up its terms: of the surrogate objective, whether a ratio is
clipped, of the ratio, of the divergence, the Brownian regularizer, the change of the velocity, and
the squared error of the value; ``LARGEST`` is the greatest absolute log ratio."""


class Choice(NamedTuple):
    """How to choose the latent of a row by where it ends, see :mod:`~sb3_policyflow.flows.modes`.

    :param latents: Filled with the chosen ones, shape (n, dim); of no rows if there is no choice.
    :param bandwidth: Twice the square of the bandwidth, in variances of all end points together.
    :param first: What the density at the first end point is multiplied by.
    """

    latents: Floats
    bandwidth: float
    first: float


class Kernels(Protocol):
    """The functions of :mod:`sb3_policyflow.kernels._numba`, where they are documented."""

    def forward(
        self,
        first: KernelInput,
        network: MLPLayout,
        outputs: Floats,
        values: Floats,
        derivatives: Floats,
        start: int,
        stop: int,
    ) -> None:
        """Evaluate an MLP on some rows."""

    def backward(
        self,
        first: KernelInput,
        network: MLPLayout,
        values: Floats,
        derivatives: Floats,
        grad_outputs: Floats,
        gradients: MLPGradients,
        start: int,
        stop: int,
    ) -> None:
        """Add an MLP's gradients of some rows."""

    def loss_gradients(
        self,
        first: KernelInput,
        network: MLPLayout,
        targets: LossTargets,
        options: LossOptions,
        is_actor: bool,
        gradients: MLPGradients,
        sums: NDArray[np.float64],
        start: int,
        stop: int,
    ) -> None:
        """Add the gradients of an actor's or a critic's loss on some samples."""

    def embed(self, times: Floats, field: FieldLayout, first: FirstLayer) -> int:
        """Evaluate a field up to what points and features contribute to its first layer."""

    def embed_backward(
        self, field: FieldLayout, first: FirstLayer, grad_first: Floats, grads: Floats
    ) -> None:
        """Gradients of what :meth:`embed` takes."""

    def flow(
        self,
        network: FoldedNetwork,
        method: Method,
        features: Floats,
        latents: Floats,
        choice: Choice,
        endpoints: Floats,
        start: int,
        stop: int,
    ) -> None:
        """Carry some rows of latents to their end points, or choose a latent for some rows."""

    def activation_address(self, kind: int) -> int:
        """Where an activation is in memory."""

    def are_same(self, addresses: Integers, others: Integers, sizes: Integers) -> bool:
        """Whether arrays have the bits of others."""

    def clip(self, addresses: Integers, sizes: Integers, max_norm: float) -> float:
        """Clip arrays to a norm of all together, and return the norm that they had."""

    def adam(self, addresses: Integers, sizes: Integers, options: AdamOptions) -> None:
        """Take a step of Adam."""
