"""Bring a volume onto another grid."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from brainshift_ros.geometry import transform_points
from brainshift_ros.image.volume import Volume

_ORDER = {"nearest": 0, "linear": 1}

# Zero beyond the voxels, whose outermost half belongs to the image: "constant" would drop a whole face of it by round-off.
_OUTSIDE = "grid-constant"


def resample(volume: Volume, grid: Volume, interpolation: Literal["nearest", "linear"]) -> Volume:
    """Sample `volume` at the voxel centres of `grid`.

    Parameters
    ----------
    volume
        The image to move; use ``nearest`` for labels, which must not mix.
    grid
        Its shape and affine are the target; its data are not read.
    interpolation
        ``nearest`` keeps the data type; ``linear`` gives float32.

    Returns
    -------
    Volume
        On the grid of `grid`; zero where `volume` does not reach.
    """
    dtype = volume.data.dtype if interpolation == "nearest" else np.dtype(np.float32)
    same = volume.shape == grid.shape and np.allclose(volume.T_patient_voxel, grid.T_patient_voxel, atol=1e-9)
    if same:
        return Volume(volume.data.astype(dtype), grid.T_patient_voxel)
    T_voxel_grid = np.linalg.solve(volume.T_patient_voxel, grid.T_patient_voxel)
    data = ndimage.affine_transform(
        volume.data.astype(dtype, copy=False),
        T_voxel_grid[:3, :3],
        offset=T_voxel_grid[:3, 3],
        output_shape=grid.shape,
        output=dtype,
        order=_ORDER[interpolation],
        mode=_OUTSIDE,
    )
    return Volume(data, grid.T_patient_voxel)


def sample(volume: Volume, points: ArrayLike, interpolation: Literal["nearest", "linear"] = "linear") -> NDArray:
    """Values of `volume` at points of the patient frame.

    Parameters
    ----------
    volume
        The image.
    points
        Shape (..., 3), metres.
    interpolation
        ``nearest`` keeps the data type, ``linear`` gives float64.

    Returns
    -------
    ndarray
        Shape (...,); zero outside the image.
    """
    points = np.asarray(points, dtype=np.float64)
    voxels = transform_points(np.linalg.inv(volume.T_patient_voxel), points.reshape(-1, 3)).T
    dtype = volume.data.dtype if interpolation == "nearest" else np.dtype(np.float64)
    values = ndimage.map_coordinates(volume.data, voxels, output=dtype, order=_ORDER[interpolation], mode=_OUTSIDE)
    return values.reshape(points.shape[:-1])
