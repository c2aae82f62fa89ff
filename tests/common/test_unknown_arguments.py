"""An argument that does not exist is refused with where it belongs, or which one may be meant."""

from typing import Any

import pytest
from torch import nn

from sb3_policyflow import DPPO, FPO, PolicyFlow
from tests.helpers import SMALL, TINY


def make(algorithm: type[Any], policy: Any = "MlpPolicy", **options: Any) -> Any:
    return algorithm(policy, "Pendulum-v1", **{**SMALL, "policy_kwargs": TINY, **options})


@pytest.mark.parametrize(
    ("algorithm", "options", "message"),
    [
        (PolicyFlow, {"activation_fn": nn.ReLU}, r"give it in policy_kwargs, as PolicyFlow\("),
        (DPPO, {"net_arch": [8]}, r"policy_kwargs=dict\(net_arch=\.\.\.\)"),
        (PolicyFlow, {"initialisation": "zero"}, "did you mean initialization in policy_kwargs"),
        (FPO, {"log_std_init": -1.0}, "FPO has no log_std_init: only PolicyFlow"),
        (PolicyFlow, {"full_std": True}, "PolicyFlow has no full_std: it belongs to gSDE"),
        (FPO, {"lerning_rate": 1e-3}, "FPO has no argument 'lerning_rate': did you mean learning_"),
        (PolicyFlow, {"brownian": 0.1}, "did you mean brownian_"),
        (DPPO, {"denoising_steps": 5}, "did you mean n_denoising_steps"),
        (PolicyFlow, {"xyz": 1}, r"'xyz': help\(PolicyFlow\) shows those it has"),
        (FPO, {"policy_kwargs": {"net_arh": []}}, "FPOPolicy has no argument 'net_arh': did you"),
        (PolicyFlow, {"policy_kwargs": {"n_step": 5}}, "PolicyFlowPolicy has no argument"),
        (
            PolicyFlow,
            {"policy_kwargs": {"brownian_coef": 0.1}},
            r"not of its policy: take it out of policy_kwargs, as PolicyFlow\(\.\.\., brown",
        ),
    ],
    ids=str,
)
def test_arguments_that_do_not_exist(
    algorithm: type[Any], options: dict[str, Any], message: str
) -> None:
    with pytest.raises(TypeError, match=message):
        algorithm("MlpPolicy", "Pendulum-v1", **{**SMALL, **options})


def test_arguments_of_a_policy_of_ones_own() -> None:
    base = PolicyFlow.policy_aliases["MlpPolicy"]

    class Own(base):  # type: ignore[misc,valid-type]
        def __init__(self, *args: Any, scale: float = 1.0, **kwargs: Any) -> None:
            self.scale = scale
            super().__init__(*args, **kwargs)

    assert make(PolicyFlow, Own, policy_kwargs={**TINY, "scale": 2.0}).policy.scale == 2.0
    with pytest.raises(TypeError, match=r"scale is an option of PolicyFlow's policy: give it in"):
        make(PolicyFlow, Own, scale=2.0)
    with pytest.raises(TypeError, match=r"Own has no argument 'scal': did you mean scale"):
        make(PolicyFlow, Own, policy_kwargs={**TINY, "scal": 2.0})
