"""Homologous points: the sparse measurement that drives the inverse model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class HomologousPoints:
    """Where points of the cortex were, how far they moved, and how sure that is.

    Attributes
    ----------
    points
        Shape (n, 3), metres, patient frame, on the first scan.
    displacements
        Shape (n, 3), metres, patient frame, from the first to the later scan.
    sigma
        Shape (n,), standard deviation of each displacement component, metres, positive.
    """

    points: NDArray[np.float64]
    displacements: NDArray[np.float64]
    sigma: NDArray[np.float64]
