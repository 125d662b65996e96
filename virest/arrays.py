"""The kinds of array that signatures name."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]
"""Grey (h, w) or RGB (h, w, 3), as stored."""
