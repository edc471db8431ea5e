"""Nearest target points from a table over voxels: a look-up instead of a tree query, exact enough for coarse alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_VOXEL_M = 1.5e-3
_REACH_M = 15e-3


@dataclass(frozen=True)
class NearestGrid:
    """Index of the target point nearest to each voxel.

    Attributes
    ----------
    origin
        Shape (3,), lower corner of the first voxel, metres.
    index
        Shape (I, J, K), int32; -1 where no point lies within 15 mm.
    """

    origin: NDArray[np.float64]
    index: NDArray[np.int32]

    def lookup(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        """Index of the nearest target point of each of (..., 3) points, to within a voxel; -1 beyond 15 mm."""
        cell = ((points - self.origin) / _VOXEL_M).astype(np.int32)
        i, j, k = np.moveaxis(np.clip(cell, 0, np.array(self.index.shape, dtype=np.int32) - 1), -1, 0)
        return self.index[i, j, k]


def make_nearest_grid(points: NDArray[np.float64]) -> NearestGrid:
    """Tabulate the nearest of points (n, 3) over a grid of 1.5 mm around them (distance transform with its features)."""
    origin = points.min(axis=0) - _REACH_M
    shape = tuple(((points.max(axis=0) + _REACH_M - origin) // _VOXEL_M + 1).astype(int))
    cell = ((points - origin) / _VOXEL_M).astype(int)
    # Of several points in a voxel the one nearest to its centre is written last, and stays.
    order = np.argsort(-np.linalg.norm(points - origin - (cell + 0.5) * _VOXEL_M, axis=1))
    holder = np.full(shape, -1, dtype=np.int32)
    holder[tuple(cell[order].T)] = order
    distance, feature = ndimage.distance_transform_edt(holder < 0, sampling=_VOXEL_M, return_indices=True)
    return NearestGrid(origin, np.where(distance < _REACH_M, holder[tuple(feature)], np.int32(-1)))
