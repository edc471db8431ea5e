"""Thin a cloud of points to an even spacing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def voxel_means(points: NDArray[np.float64], spacing_m: float, *attached: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Mean of the points in each cell of a cubic grid: at most one point a cell, whatever the density was.

    Parameters
    ----------
    points
        Shape (n, 3), n >= 1, metres.
    spacing_m
        Edge of a cell, metres.
    *attached
        Values at the points, shape (n, k) each, that are averaged with them, such as normals.

    Returns
    -------
    list
        The means of `points`, shape (m, 3), then those of each of `attached`, in the order of the cells.
    """
    cell = np.floor((points - points.min(axis=0)) / spacing_m).astype(np.int64)
    sides = cell.max(axis=0) + 1
    _, owner, count = np.unique(np.ravel_multi_index(cell.T, sides), return_inverse=True, return_counts=True)
    return [
        np.stack([np.bincount(owner, weights=column, minlength=len(count)) / count for column in values.T], axis=-1)
        for values in (points, *attached)
    ]
