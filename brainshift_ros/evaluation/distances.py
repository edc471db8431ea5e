"""How far things lie apart: a few figures of many distances, and the distances between the surfaces of two masks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from brainshift_ros.units import m_to_mm


@dataclass(frozen=True)
class DistanceFigures:
    """Mean, standard deviation, 95th percentile and largest of some distances in mm, and how many they are."""

    mean_mm: float
    std_mm: float
    p95_mm: float
    max_mm: float
    count: int


def figures_of(distances: ArrayLike) -> DistanceFigures | None:
    """Summarise distances, shape (n,), metres; None for n = 0."""
    millimetres = m_to_mm(distances)
    if millimetres.size == 0:
        return None
    return DistanceFigures(
        float(millimetres.mean()),
        float(millimetres.std()),
        float(np.percentile(millimetres, 95.0)),
        float(millimetres.max()),
        int(millimetres.size),
    )


def surface_distances(a: NDArray[np.bool_], b: NDArray[np.bool_], edges: ArrayLike) -> NDArray[np.float64]:
    """Distance of every surface voxel of either mask to the nearest surface voxel of the other.

    Parameters
    ----------
    a, b
        Masks of one shape, neither empty.
    edges
        Edge lengths of a voxel, metres.

    Returns
    -------
    ndarray
        Shape (n_a + n_b,), metres: both directions together, so mean and maximum are the symmetric mean surface distance and
        the Hausdorff distance.
    """
    box = ndimage.find_objects((a | b).astype(np.uint8))[0]
    points = [np.argwhere(mask & ~ndimage.binary_erosion(mask)) * np.asarray(edges) for mask in (a[box], b[box])]
    trees = [cKDTree(surface) for surface in points]
    return np.concatenate([trees[1].query(points[0])[0], trees[0].query(points[1])[0]])
