"""The policy that made the rollout, kept while the update changes the policy."""

import torch as th
from torch.func import functional_call

from sb3_policyflow.common.chunks import in_chunks
from sb3_policyflow.policyflow.policies import FlowPolicy


class Behavior:
    """A frozen view of a policy, for one rollout (paper, v-hat and sigma-hat).

    Nothing of it is saved with a model.

    :param policy: The policy, not yet updated.
    :param features: Its actor's features of the rollout's observations, (n, features_dim). One
        extraction serves the whole update, because the policy of the rollout stays what it was.
    """

    def __init__(self, policy: FlowPolicy, features: th.Tensor) -> None:
        self.log_std = policy.noise_log_std.detach().clone()
        self._field = policy.velocity
        self._parameters = {
            name: tensor.detach().clone() for name, tensor in self._field.state_dict().items()
        }
        self._features = features

    def velocity(self, points: th.Tensor, times: th.Tensor) -> th.Tensor:
        """The old velocity for the rollout's n samples.

        :param points: x_t, shape (n, k, action_dim).
        :param times: t, shape (n, k).
        :return: v-hat, shape (n, k, action_dim).
        """
        return in_chunks(self._old_velocity, (points, times, self._features))

    def _old_velocity(self, inputs: tuple[th.Tensor, th.Tensor, th.Tensor]) -> th.Tensor:
        points, times, features = inputs
        arguments = (points, times, features.unsqueeze(1))
        velocity: th.Tensor = functional_call(self._field, self._parameters, arguments)
        return velocity
