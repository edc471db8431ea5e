"""The boundary of a tetrahedral mesh, and the nearest point on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.surface.facets import LOCAL_FACES


def boundary_faces(elements: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Faces that belong to one element only.

    Parameters
    ----------
    elements
        Shape (M, 4), node indices.

    Returns
    -------
    faces
        Shape (F, 3), node indices, right-hand normal pointing out of the mesh. Both sides of a split sheet are boundary.
    owner
        Shape (F,), the element of each face.
    """
    faces = elements[:, LOCAL_FACES].reshape(-1, 3).astype(np.int64)
    ordered = np.sort(faces, axis=1)
    key = (ordered[:, 0] << 42) | (ordered[:, 1] << 21) | ordered[:, 2]
    _, first, counts = np.unique(key, return_index=True, return_counts=True)
    single = np.sort(first[counts == 1])
    return faces[single], single // 4


class SurfaceLocator:
    """Exact nearest point on the boundary faces of a mesh, by a tree of their centroids."""

    def __init__(self, mesh: TetMesh) -> None:
        faces, self._owner = boundary_faces(mesh.elements)
        self._triangles = mesh.nodes[faces]
        centroid = self._triangles.mean(axis=1)
        self._radius = float(np.linalg.norm(self._triangles - centroid[:, None], axis=2).max())
        self._tree = cKDTree(centroid)

    def nearest(self, points: NDArray) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Owner element (n,), nearest surface point (n, 3) and its distance (n,)."""
        # The triangle with the nearest centroid bounds the distance; only triangles whose centroid lies within that
        # bound plus the largest triangle radius can be nearer.
        to_centroid, first = self._tree.query(points)
        bound = np.linalg.norm(points - nearest_on_triangles(points, self._triangles[first]), axis=1)
        near = self._tree.query_ball_point(points, np.minimum(bound, to_centroid) * (1 + 1e-12) + self._radius)
        count = np.array([len(item) for item in near])
        row, face = np.repeat(np.arange(len(points)), count), np.concatenate(near).astype(np.int64)
        on_face = nearest_on_triangles(points[row], self._triangles[face])
        distance = np.linalg.norm(points[row] - on_face, axis=1)
        order = np.lexsort((-face, -distance, row))  # per row, the nearest (then the lowest face) comes last
        best = order[np.cumsum(count) - 1]
        return self._owner[face[best]], on_face[best], distance[best]


def nearest_on_triangles(points: ArrayLike, triangles: ArrayLike) -> NDArray[np.float64]:
    """Nearest point of each triangle to each point, pairwise (Ericson, Real-Time Collision Detection, 5.1.5).

    Parameters
    ----------
    points
        Shape (n, 3).
    triangles
        Shape (n, 3, 3), corners.

    Returns
    -------
    Shape (n, 3).
    """
    p, t = np.asarray(points, dtype=np.float64), np.asarray(triangles, dtype=np.float64)
    plane = _project_to_plane(p, t)
    best, best_squared = plane, np.where(np.isfinite(plane).all(axis=1), np.sum((p - plane) ** 2, axis=1), np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        start, along = t[:, a], t[:, b] - t[:, a]
        length_squared = np.maximum(np.sum(along**2, axis=1), 1e-300)
        s = np.clip(np.sum((p - start) * along, axis=1) / length_squared, 0.0, 1.0)
        on_edge = start + s[:, None] * along
        squared = np.sum((p - on_edge) ** 2, axis=1)
        nearer = squared < best_squared
        best = np.where(nearer[:, None], on_edge, best)
        best_squared = np.where(nearer, squared, best_squared)
    return best


def _project_to_plane(p: NDArray, t: NDArray) -> NDArray[np.float64]:
    """Orthogonal projection onto each triangle's plane, NaN where it falls outside the triangle."""
    u, v, w = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0], p - t[:, 0]
    uu, uv, vv = np.sum(u * u, axis=1), np.sum(u * v, axis=1), np.sum(v * v, axis=1)
    wu, wv = np.sum(w * u, axis=1), np.sum(w * v, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        area = uu * vv - uv**2
        b, c = (vv * wu - uv * wv) / area, (uu * wv - uv * wu) / area
        outside = ~((b >= 0) & (c >= 0) & (b + c <= 1))
    projected = t[:, 0] + b[:, None] * u + c[:, None] * v
    projected[outside] = np.nan
    return projected
