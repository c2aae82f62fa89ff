"""A pull towards the policy that was cloned from demonstrations."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

import torch as th

from sb3_policyflow.common.buffers import FlowRolloutBufferSamples
from sb3_policyflow.flows import MatchingSamples


def check_cloned(model: Any) -> None:
    """Refuse a pull towards a policy that does not exist.

    :param model: An algorithm that is about to learn.
    :raises ValueError: If it was not cloned from demonstrations.
    """
    if model.imitation_coef != 0 and model.cloned_parameters is None:
        raise ValueError(
            f"imitation_coef={model.imitation_coef!r} pulls towards a policy that was cloned from "
            "demonstrations, and this model was not: call sb3_policyflow.imitation.clone first, or "
            "leave it out."
        )


def matched_outputs(policy: Any, drawn: MatchingSamples, features: th.Tensor) -> th.Tensor:
    """What a policy's network says at the points of flow matching, shape (n, action_dim).

    :param policy: The policy.
    :param drawn: The points.
    :param features: The actor's features, shape (n, features_dim).
    """
    # Behind its own, DPPO has features for networks that are not trained.
    features = features[:, : policy.mlp_extractor.latent_dim_pi]
    outputs: th.Tensor = policy.velocity(drawn.points, drawn.times, features)
    return outputs


class ImitationPull:
    """Pulls a policy towards the one that was cloned from demonstrations.

    E ||g (v - v_cloned)||^2    at points on the way from drawn latents to the actions taken

    v is the velocity, and g = 1; of DPPO the network's output, which g turns into what the mean of
    the next step changes by.

    :param policy: The policy that learns.
    :param parameters: Its parameters when it had been cloned, by name.
    """

    def __init__(self, policy: Any, parameters: Mapping[str, Any]) -> None:
        self._policy = policy
        self._cloned = deepcopy(policy).requires_grad_(False)
        tensors = {name: th.as_tensor(values) for name, values in parameters.items()}
        self._cloned.load_state_dict(tensors)
        self._cloned.set_training_mode(False)

    def loss(self, batch: FlowRolloutBufferSamples, features: th.Tensor) -> th.Tensor:
        """The mean squared change since cloning, a tensor without dimensions.

        :param batch: A minibatch of n samples.
        :param features: The actor's features, shape (n, features_dim).
        """
        drawn = self._policy.draw_matching(batch.actions.flatten(1))
        with th.no_grad():
            cloned_features = self._cloned.actor_features(batch.observations)
            cloned = matched_outputs(self._cloned, drawn, cloned_features)
        change = matched_outputs(self._policy, drawn, features) - cloned
        loss: th.Tensor = (drawn.gains.unsqueeze(-1) * change).square().sum(dim=-1).mean()
        return loss
