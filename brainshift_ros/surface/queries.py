"""Geometric queries of triangle surfaces, by libigl: closest points, inside or outside, rays."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from igl.embree import EmbreeIntersector
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.surface.surface import Surface


@dataclass(frozen=True)
class ClosestPoints:
    """Closest points of a surface: face (n,), barycentric coordinates (n, 3), position (n, 3) and distance (n,) in metres."""

    face: NDArray[np.int64]
    barycentric: NDArray[np.float64]
    position: NDArray[np.float64]
    distance: NDArray[np.float64]


def closest_points(surface: Surface, points: NDArray[np.float64]) -> ClosestPoints:
    """Find the closest point of a surface, open or closed, to each point, shape (n, 3)."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    squared, face, position = igl.point_mesh_squared_distance(points, surface.vertices, surface.faces.astype(np.int64))
    a, b, c = (np.ascontiguousarray(surface.vertices[surface.faces[face, corner]]) for corner in range(3))
    weights = igl.barycentric_coordinates(np.ascontiguousarray(position), a, b, c)
    return ClosestPoints(face, np.clip(weights, 0.0, 1.0), position, np.sqrt(squared))


def inside(surface: Surface, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which points, shape (n, 3), lie inside a closed surface: generalised winding number (Barill et al. 2018)."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    return np.asarray(igl.fast_winding_number(surface.vertices, surface.faces.astype(np.int64), points) > 0.5)


@dataclass(frozen=True)
class RayHits:
    """Where rays first meet a surface.

    Attributes
    ----------
    face
        Shape (...), -1 where the ray misses.
    barycentric
        Shape (..., 3), NaN where it misses.
    distance
        Shape (...), in lengths of the ray's direction, infinite where it misses.
    """

    face: NDArray[np.int64]
    barycentric: NDArray[np.float64]
    distance: NDArray[np.float64]


class RayCaster:
    """A surface prepared for ray casting (Embree, single precision)."""

    def __init__(self, surface: Surface) -> None:
        # Embree computes in single precision: coordinates are kept near zero.
        self._origin = surface.vertices.mean(axis=0)
        self._scene = EmbreeIntersector()
        self._scene.init(
            np.asfortranarray(surface.vertices - self._origin, dtype=np.float32),
            np.asfortranarray(surface.faces, dtype=np.int32),
        )

    def cast(self, origins: ArrayLike, directions: ArrayLike) -> RayHits:
        """Follow rays from `origins` along `directions`, both broadcast to shape (..., 3), metres."""
        start, along = np.broadcast_arrays(np.asarray(origins) - self._origin, directions)
        shape = start.shape[:-1]
        rays = zip(start.reshape(-1, 3).astype(np.float32), along.reshape(-1, 3).astype(np.float32), strict=True)
        table = np.array([self._scene.intersectRay_first(*ray) for ray in rays], dtype=np.float64).reshape(-1, 4)
        face = table[:, 0].astype(np.int64)
        missed = face < 0
        u, v = table[:, 2], table[:, 3]
        barycentric = np.where(missed[:, None], np.nan, np.stack([1.0 - u - v, u, v], axis=-1))
        distance = np.where(missed, np.inf, table[:, 1])
        return RayHits(face.reshape(shape), barycentric.reshape(*shape, 3), distance.reshape(shape))
