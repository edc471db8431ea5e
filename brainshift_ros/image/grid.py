"""Grids of voxels in the patient frame, and trilinear interpolation on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.geometry import transform_points
from brainshift_ros.image.volume import Volume


@dataclass(frozen=True)
class Grid:
    """Where the voxels of an image lie.

    Attributes
    ----------
    shape
        Number of voxels along each index axis.
    T_patient_voxel
        4x4 affine from voxel indices (voxel centres at integers) to the patient frame, metres.
    """

    shape: tuple[int, int, int]
    T_patient_voxel: NDArray[np.float64]

    @staticmethod
    def of(volume: Volume) -> Grid:
        """Return the grid of an image."""
        return Grid(volume.shape, volume.T_patient_voxel)

    @staticmethod
    def around(points: ArrayLike, spacing: float, margin: float) -> Grid:
        """Return the smallest axis-parallel RAS grid with cubic voxels that covers points, shape (n, 3), and a margin."""
        points = np.asarray(points, dtype=np.float64)
        low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
        i, j, k = (int(n) for n in np.ceil((high - low) / spacing).astype(int) + 1)
        T = np.diag([spacing, spacing, spacing, 1.0])
        T[:3, 3] = low
        return Grid((i, j, k), T)

    def to_voxels(self, points: ArrayLike) -> NDArray[np.float64]:
        """Continuous voxel indices, shape (..., 3), of points in the patient frame."""
        return transform_points(np.linalg.inv(self.T_patient_voxel), points)

    def centres(self, indices: ArrayLike) -> NDArray[np.float64]:
        """Patient coordinates, shape (..., 3), of voxel indices, shape (..., 3), fractions allowed."""
        return transform_points(self.T_patient_voxel, indices)

    @property
    def voxel_edges(self) -> NDArray[np.float64]:
        """Shape (3,), edge lengths of a voxel, metres."""
        return np.linalg.norm(self.T_patient_voxel[:3, :3], axis=0)


def reached(voxels: NDArray[np.float64], shape: tuple[int, ...], border: float) -> NDArray[np.bool_]:
    """Which voxel indices, shape (n, 3), lie in an image, `border` voxels beyond its outermost voxel centres included."""
    # Column by column: reducing over an axis of three is several times slower.
    within = [(column >= -border) & (column <= size - 1 + border) for column, size in zip(voxels.T, shape, strict=True)]
    return within[0] & within[1] & within[2]


def trilinear(vectors: NDArray, voxels: NDArray[np.float64]) -> NDArray[np.float32]:
    """Interpolate a vector image at continuous voxel indices; beyond the outermost voxel centres their value holds.

    Gathering whole vectors, in single precision, takes a third of the time of one ``map_coordinates`` per component.

    Parameters
    ----------
    vectors
        Shape (I, J, K, C).
    voxels
        Shape (n, 3).

    Returns
    -------
    Shape (n, C).
    """
    size = np.array(vectors.shape[:3])
    flat = np.asarray(vectors, dtype=np.float32).reshape(-1, vectors.shape[3])
    low = np.clip(np.floor(voxels), 0, np.maximum(size - 2, 0)).astype(np.intp)
    share = np.clip(voxels - low, 0.0, 1.0).astype(np.float32)
    # Along an axis of one voxel both neighbours are that voxel.
    step = np.where(size > 1, [size[1] * size[2], size[2], 1], 0)
    corner = low @ np.array([size[1] * size[2], size[2], 1])

    def blend(axis: int, offset: int) -> NDArray[np.float32]:
        if axis == 3:
            return flat.take(corner + offset, axis=0)
        below, above = blend(axis + 1, offset), blend(axis + 1, offset + int(step[axis]))
        above -= below
        above *= share[:, axis, None]
        above += below
        return above

    return blend(0, 0)
