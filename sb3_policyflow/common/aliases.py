"""The names under which SB3 users ask for a policy, for every flow algorithm alike."""

from typing import Any

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, NatureCNN

from sb3_policyflow.common.policies import FlowActorCriticPolicy


class ImageFeatures(FlowActorCriticPolicy):
    """Gives a policy SB3's ``NatureCNN`` as its default features extractor."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"features_extractor_class": NatureCNN, **kwargs})


class DictFeatures(FlowActorCriticPolicy):
    """Gives a policy SB3's ``CombinedExtractor`` as its default features extractor."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"features_extractor_class": CombinedExtractor, **kwargs})


def flow_policy_aliases(
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
