"""Types shared by the environments."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Info = dict[str, Any]
"""What ``reset`` and ``step`` say besides, and the options of ``reset``."""

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
"""What algorithms see and do: observations and actions."""
