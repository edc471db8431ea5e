"""Sums of element values at nodes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def sum_at(index: NDArray[np.integer], values: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Sum values by their index, both of any same shape, into an array (size,)."""
    return np.bincount(index.ravel(), weights=values.ravel(), minlength=size).astype(np.float64, copy=False)
