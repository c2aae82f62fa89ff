"""The algorithms that must keep SB3's contract."""

from typing import Any

import pytest

from sb3_policyflow import DPPO, FPO, PolicyFlow


@pytest.fixture(params=[PolicyFlow, FPO, DPPO], ids=lambda algorithm: str(algorithm.__name__))
def model_class(request: pytest.FixtureRequest) -> type[Any]:
    """Each of them in turn."""
    algorithm: type[Any] = request.param
    return algorithm
