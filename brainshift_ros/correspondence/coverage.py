"""How far the visible cortex lies from the homologous points that must stand for it (thesis fig. 56)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

FAR_M = 15e-3


def far_share(region: NDArray[np.bool_], at: NDArray[np.float64], cell_m: float, far_m: float = FAR_M) -> float:
    """Share of a region that lies farther than `far_m` from every point.

    Parameters
    ----------
    region
        Visible cortex on a plane grid.
    at
        Shape (n, 2), (column, row), cells.
    cell_m
        Cell size, metres.
    far_m
        Distance in the plane, metres.

    Returns
    -------
    share
        0 to 1; 1 without any point, and without any region.
    """
    if len(at) == 0 or not region.any():
        return 1.0
    elsewhere = np.ones(region.shape, dtype=np.uint8)
    columns, rows = np.clip(np.rint(at).astype(int), 0, np.array(region.shape[::-1]) - 1).T
    elsewhere[rows, columns] = 0
    distance = cv2.distanceTransform(elsewhere, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * cell_m
    return float(np.mean(distance[region] > far_m))
