"""Jacobian determinants of a map: of the mesh's elements, and of displacements sampled on a grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.image.grid import Grid
from brainshift_ros.mesh.tetmesh import tetrahedron_volumes
from brainshift_ros.parallel import threaded

_PLANES_AT_ONCE = 4


def jacobian_of_elements(field: DisplacementField) -> NDArray[np.float64]:
    """Volume of each element after the shift over that before, shape (M,); NaN for elements of no volume."""
    mesh = field.mesh
    with np.errstate(divide="ignore", invalid="ignore"):
        return tetrahedron_volumes(mesh.nodes + field.displacement, mesh.elements) / mesh.volumes


def jacobian_of_cells(vectors: NDArray[np.float32], grid: Grid) -> NDArray[np.float32]:
    """Smallest Jacobian determinant of ``y + vectors(y)`` at two opposite corners of each cell between voxel centres.

    Differences along the edges, not central ones, which would step over a fold as thin as a voxel.

    Parameters
    ----------
    vectors
        Shape (I, J, K, 3), metres, patient frame.
    grid
        Where they lie; any affine.

    Returns
    -------
    Shape (I-1, J-1, K-1).
    """
    edges = grid.T_patient_voxel[:3, :3].astype(np.float32)
    shape = tuple(size - 1 for size in grid.shape)
    smallest = np.empty(shape, dtype=np.float32)

    def slab(first: int) -> None:
        # Components first: whole planes are then contiguous.
        part = np.ascontiguousarray(np.moveaxis(vectors[first : first + _PLANES_AT_ONCE + 1], -1, 0))
        along = [np.diff(part, axis=1 + axis) + edges[:, axis, None, None, None] for axis in range(3)]
        one = _triple_product(along[0][:, :, :-1, :-1], along[1][:, :-1, :, :-1], along[2][:, :-1, :-1, :])
        other = _triple_product(along[0][:, :, 1:, 1:], along[1][:, 1:, :, 1:], along[2][:, 1:, 1:, :])
        per_volume = np.float32(1.0 / np.linalg.det(edges))
        np.minimum(one * per_volume, other * per_volume, out=smallest[first : first + _PLANES_AT_ONCE])

    for _ in threaded(slab, range(0, shape[0], _PLANES_AT_ONCE)):
        pass
    return smallest


def _triple_product(a: NDArray, b: NDArray, c: NDArray) -> NDArray[np.float32]:
    """Take ``a . (b x c)`` of vectors whose components come first."""
    return a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
