"""The cortical surface as a registration target: only what a scanner outside the head could see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from brainshift_ros.errors import InputError
from brainshift_ros.mesh.surface import Surface

_SPACING_M = 1.2e-3
_RAYS = 24
_OPEN_FRACTION = 0.12


@dataclass(frozen=True)
class CortexTarget:
    """Points on the exposed cortex; prepare once for a patient.

    Attributes
    ----------
    points, normals
        Shape (n, 3), patient frame, metres; outward unit normals.
    cloud
        The same as an Open3D cloud.
    tree
        KD-tree over `points`.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    cloud: o3d.geometry.PointCloud
    tree: cKDTree


def _sphere_directions(count: int) -> NDArray[np.float64]:
    """Fibonacci sphere: `count` nearly even unit vectors."""
    k = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    return np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=-1)


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
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(cortex.faces))
    mesh.compute_vertex_normals()
    cloud = _mesh_samples(mesh, cortex)
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    directions = _sphere_directions(_RAYS)
    starts = points + 0.3e-3 * normals  # off the surface, so that a ray does not meet its own triangle
    open_count = np.zeros(len(points))
    for direction in directions:
        rays = np.concatenate([starts, np.broadcast_to(direction, starts.shape)], axis=1).astype(np.float32)
        open_count += ~scene.test_occlusions(o3d.core.Tensor(rays)).numpy()
    exposed = open_count >= _OPEN_FRACTION * _RAYS
    if exposed.sum() < 100:
        raise InputError("cortex surface", "no part of it can be seen from outside", "check that its normals point outward")
    cloud = cloud.select_by_index(np.flatnonzero(exposed).tolist())
    points = np.asarray(cloud.points).copy()
    return CortexTarget(points, np.asarray(cloud.normals).copy(), cloud, cKDTree(points))


def _mesh_samples(mesh: o3d.geometry.TriangleMesh, cortex: Surface) -> o3d.geometry.PointCloud:
    """Vertices and face centres, thinned to the spacing: even coverage for fine and coarse surfaces, no random numbers."""
    corners = np.asarray(mesh.vertices)[cortex.faces]
    mesh.compute_triangle_normals()
    cloud = o3d.geometry.PointCloud()
    cloud.points = o3d.utility.Vector3dVector(np.concatenate([np.asarray(mesh.vertices), corners.mean(axis=1)]))
    cloud.normals = o3d.utility.Vector3dVector(
        np.concatenate([np.asarray(mesh.vertex_normals), np.asarray(mesh.triangle_normals)])
    )
    thinned = cloud.voxel_down_sample(_SPACING_M)
    normals = np.asarray(thinned.normals)
    length = np.linalg.norm(normals, axis=1)
    # Opposite walls of a closed sulcus fall into one voxel: their mean normal means nothing.
    return thinned.select_by_index(np.flatnonzero(length > 0.3).tolist()).normalize_normals()
