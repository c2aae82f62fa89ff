"""What a velocity field consists of, for those who read its memory."""

import torch as th

from sb3_policyflow.flows import FourierTimeEmbedding, VelocityField
from sb3_policyflow.kernels.inspection import Layer, ModuleInspector, UnsupportedError, are_usable
from sb3_policyflow.kernels.layouts import FieldLayout, Kernels
from sb3_policyflow.kernels.mlp import MLP, read_mlp


class FieldParts:
    """What a velocity field consists of, and all tensors that it depends on.

    ``held`` are these tensors for those who read memory, see :class:`~.mlp.MLP`.

    :param frequencies: Those of the time embedding.
    :param time: The time embedding's two layers.
    :param observation: The observation embedding.
    :param network: The rest.
    :raises UnsupportedError: If their shapes do not fit each other.
    """

    def __init__(self, frequencies: th.Tensor, time: MLP, observation: Layer, network: MLP) -> None:
        self.kernels = network.kernels
        self.frequencies = frequencies
        self.time = time
        self.network = network
        self.dim = network.n_outputs
        self.features_dim = observation.weight.shape[1]
        # In the order of FieldLayout and of named_parameters.
        self.embedding = [*time.tensors, *observation, *network.layers[0]]
        self.n_embedding = sum(tensor.numel() for tensor in self.embedding)
        self.parameters = [*self.embedding, *network.tensors[2:]]
        self.n_parameters = sum(tensor.numel() for tensor in self.parameters)
        self.tensors = [frequencies, *self.parameters]
        embedding = [*time.held, *(tensor.detach() for tensor in observation), *network.held[:2]]
        self.held = [frequencies.detach(), *embedding, *network.held[2:]]
        self.shapes = [tensor.shape for tensor in self.held]
        self.places = [tensor.data_ptr() for tensor in self.held]
        self._require_fit()
        self.layout = FieldLayout(
            self.dim, *time.activation_layout, len(frequencies), self.places[0], *self.places[1:9]
        )

    def _require_fit(self) -> None:
        (n_frequencies,), width = self.shapes[0], self.time.n_outputs
        expected = (2 * n_frequencies, (width, self.features_dim), (width,), self.dim + width)
        weight, bias = self.shapes[5:7]
        if (self.time.n_inputs, weight, bias, self.network.n_inputs) != expected:
            raise UnsupportedError("the shapes of the velocity field's layers do not fit")

    def supports(self, points: th.Tensor, features: th.Tensor) -> bool:
        """Whether points and features are those of kernels, and of this field."""
        dims = points.shape[-1], features.shape[-1]
        is_known = dims == (self.dim, self.features_dim) and points.numel() > 0
        return is_known and are_usable((points, features))


def read_field(kernels: Kernels, inspector: ModuleInspector, field: VelocityField) -> FieldParts:
    """Read the parts of a field, or raise :class:`UnsupportedError`."""
    embedding = inspector.child(field, "time_embedding")
    if type(embedding) is not FourierTimeEmbedding:
        raise UnsupportedError("the velocity field has other parts than VelocityField's")
    inspector.require_no_hooks(field, embedding)
    return FieldParts(
        inspector.parameter(embedding, "frequencies"),
        read_mlp(kernels, inspector, inspector.sequence(embedding, "mlp")),
        inspector.layer(inspector.child(field, "observation_embedding")),
        read_mlp(
            kernels,
            inspector,
            [*inspector.sequence(field, "hidden"), inspector.child(field, "output")],
        ),
    )
