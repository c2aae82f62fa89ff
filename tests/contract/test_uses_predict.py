"""What ``predict`` takes and refuses."""

from typing import Any

import numpy as np
import pytest
import torch as th

from tests.contract.uses import make

ROW = np.array([0.1, 0.2, 0.3], np.float32)
TAKEN: dict[str, Any] = {
    "list": ROW.tolist(),
    "tuple": tuple(ROW),
    "list of arrays": [ROW, ROW],
    "tensor": th.as_tensor(ROW),
    "float64": ROW.astype(np.float64),
    "float16": ROW.astype(np.float16),
    "int": ROW.astype(int),
    "negative strides": np.tile(ROW, (4, 1))[::-1, ::-1],
    "fortran": np.asfortranarray(np.tile(ROW, (4, 1))),
    "read-only": np.broadcast_to(ROW, (4, 3)),
    "empty batch": np.zeros((0, 3), np.float32),
    "huge": ROW * 1e30,
}


@pytest.mark.parametrize("kind", TAKEN)
def test_predict_takes_what_ppo_takes(any_algorithm: type[Any], kind: str) -> None:
    given = TAKEN[kind]
    for deterministic in (True, False):
        action, state = make(any_algorithm).predict(given, deterministic=deterministic)
        assert (action.dtype, action.shape) == (np.float32, (*np.shape(given)[:-1], 2))
        assert np.isfinite(action).all()
        assert state is None


@pytest.mark.parametrize(
    ("given", "error"),
    [
        (ROW[:2], ValueError),
        (ROW[None, None], ValueError),
        (None, ValueError),
        ({"a": ROW}, AssertionError),
        (ROW * np.nan, ValueError),
        (ROW * np.inf, ValueError),
    ],
    ids=["short", "3-d", "None", "dict", "nan", "inf"],
)
def test_predict_refuses_what_ppo_refuses(
    any_algorithm: type[Any], given: Any, error: type[Exception]
) -> None:
    with pytest.raises(error):
        make(any_algorithm).predict(given)
