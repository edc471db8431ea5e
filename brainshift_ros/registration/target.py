"""The cortical surface as a registration target: only what a scanner outside the head could see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from brainshift_ros.errors import InputError
from brainshift_ros.registration.exposure import open_fraction
from brainshift_ros.registration.nearest_grid import NearestGrid, make_nearest_grid
from brainshift_ros.registration.thinning import voxel_means
from brainshift_ros.surface.surface import Surface

_SPACING_M = 1.2e-3
_OPEN_FRACTION = 0.12


@dataclass(frozen=True)
class CortexTarget:
    """Points on the exposed cortex; prepare once for a patient.

    Attributes
    ----------
    points, normals
        Shape (n, 3), patient frame, metres; outward unit normals.
    tree
        KD-tree over `points`.
    grid
        The nearest of `points` from any place near them, tabulated.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    tree: cKDTree
    grid: NearestGrid


def prepare_target(cortex: Surface) -> CortexTarget:
    """Sample the cortex at 1.2 mm and drop what no scanner outside the head can see (sulcal depths, ventricles).

    A point counts as exposed when at least 12 % of all directions around it leave the head without meeting the surface.

    Parameters
    ----------
    cortex
        Surface in the patient frame, metres, normals outward.

    Raises
    ------
    InputError
        When the surface is empty, not finite, or not the size of a brain in metres.
    """
    vertices = np.asarray(cortex.vertices, dtype=np.float64)
    if len(vertices) < 100 or len(cortex.faces) < 100 or not np.isfinite(vertices).all():
        raise InputError("cortex surface", f"{len(vertices)} vertices, or not finite", "give the patient's cortical surface")
    extent = float(np.ptp(vertices, axis=0).max())
    if not 0.05 <= extent <= 0.4:
        raise InputError("cortex surface", f"it extends over {extent:.3g} m", "give it in metres (a head is 0.1 to 0.3 m)")
    points, normals = _samples(cortex)
    exposed = open_fraction(cortex, points, normals) >= _OPEN_FRACTION
    if exposed.sum() < 100:
        raise InputError("cortex surface", "no part of it can be seen from outside", "check that its normals point outward")
    points, normals = points[exposed], normals[exposed]
    return CortexTarget(points, normals, cKDTree(points), make_nearest_grid(points))


def _samples(cortex: Surface) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Vertices and face centres with normals, thinned to the spacing: even coverage for fine and coarse surfaces."""
    corners = cortex.vertices[cortex.faces]
    twice_area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    vertex_normals = np.stack(
        [
            np.bincount(cortex.faces.ravel(), weights=np.repeat(column, 3), minlength=len(cortex.vertices))
            for column in twice_area.T
        ],
        axis=-1,
    )
    normals = np.concatenate([vertex_normals, twice_area])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(float).tiny)
    points, normals = voxel_means(np.concatenate([cortex.vertices, corners.mean(axis=1)]), _SPACING_M, normals)
    length = np.linalg.norm(normals, axis=1)
    # Opposite walls of a closed sulcus fall into one voxel: their mean normal means nothing.
    kept = length > 0.3
    return points[kept], normals[kept] / length[kept, None]
