"""The policy that made the rollout, kept while the update changes the policy."""

from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch.func import functional_call

from sb3_policyflow.common.type_aliases import rows
from sb3_policyflow.policyflow.policies import FlowPolicy

CHUNK = 8192
"""Rows evaluated at a time: large enough to be fast, small enough for images."""


class Behaviour:
    """A frozen view of a policy, for the observations of one rollout (paper, v-hat and sigma-hat).

    Features of the observations are extracted once for the whole update, because the policy that
    made the rollout does not change any more. Nothing of it is saved with a model.

    :param policy: The policy, in evaluation mode and not yet updated.
    :param observations: The rollout's n observations.
    """

    def __init__(self, policy: FlowPolicy, observations: PyTorchObs) -> None:
        self.log_std = policy.noise_log_std.detach().clone()
        self._field = policy.velocity
        self._parameters = {
            name: tensor.detach().clone() for name, tensor in self._field.state_dict().items()
        }
        self._features = self._extract(policy, observations)

    @th.no_grad()
    def _extract(self, policy: FlowPolicy, observations: PyTorchObs) -> th.Tensor:
        n_samples = len(_first_tensor(observations))
        chunks = [policy.actor_features(rows(observations, chunk)) for chunk in _slices(n_samples)]
        return th.cat(chunks)

    @th.no_grad()
    def velocity(self, points: th.Tensor, times: th.Tensor) -> th.Tensor:
        """The old velocity for the rollout's n samples.

        :param points: x_t, shape (n, k, action_dim).
        :param times: t, shape (n, k).
        :return: v-hat, shape (n, k, action_dim).
        """
        chunks = [
            functional_call(
                self._field,
                self._parameters,
                (points[chunk], times[chunk], self._features[chunk].unsqueeze(1)),
            )
            for chunk in _slices(len(points))
        ]
        return th.cat(chunks)


def _slices(n_rows: int) -> list[slice]:
    return [slice(start, start + CHUNK) for start in range(0, n_rows, CHUNK)]


def _first_tensor(tree: Any) -> th.Tensor:
    tensor: th.Tensor = next(iter(tree.values())) if isinstance(tree, dict) else tree
    return tensor
