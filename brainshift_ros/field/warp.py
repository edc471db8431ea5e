"""Bring a preoperative image, its labels or a surface to where the brain is now."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.field.deformation import Deformation
from brainshift_ros.image.grid import Grid, reached, trilinear
from brainshift_ros.image.volume import Volume
from brainshift_ros.surface.surface import Surface

Interpolation = Literal["linear", "nearest"]


@dataclass(frozen=True)
class WarpedImage:
    """An image brought to the present, and the map that did it.

    Attributes
    ----------
    volume
        The image as it would look now, on the grid below.
    inverse
        Shape (I, J, K, 3), metres, patient frame: what is now at a voxel was at the voxel plus this.
    grid
        The output grid.
    warnings
        What a person should know.
    """

    volume: Volume
    inverse: NDArray[np.float32]
    grid: Grid
    warnings: tuple[str, ...]


def warp_image(
    deformation: Deformation, image: Volume, *, grid: Grid | None = None, interpolation: Interpolation = "linear"
) -> WarpedImage:
    """Update an image: voxel y of the result shows the old image at ``y + v(y)``.

    Parameters
    ----------
    deformation
        The estimated shift.
    image
        Preoperative image in the patient frame.
    grid
        Output grid; the image's own if None.
    interpolation
        ``linear`` for intensities (result in the image's type, integers rounded), ``nearest`` for labels.
    """
    grid = grid or Grid.of(image)
    inverse = deformation.inverse_on(grid)
    warnings = () if inverse.any() else ("the image shows nothing that moved",)
    return WarpedImage(resample_through(image, inverse, grid, interpolation), inverse, grid, warnings)


def resample_through(image: Volume, inverse: NDArray, grid: Grid, interpolation: Interpolation = "linear") -> Volume:
    """Sample an image at ``y + v(y)`` for the voxels y of a grid.

    As ITK does, voxels reach half a voxel beyond their centres at the image's border, and beyond that the result is 0.

    Parameters
    ----------
    image
        The image to sample.
    inverse
        Shape (I, J, K, 3), v at the voxels of `grid`, metres.
    grid
        The output grid.
    interpolation
        As for :func:`warp_image`.
    """
    T_image_patient = np.linalg.inv(image.T_patient_voxel)
    same = np.allclose(grid.T_patient_voxel, image.T_patient_voxel, rtol=0.0, atol=1e-9)
    T_image_grid = np.eye(4) if same else T_image_patient @ grid.T_patient_voxel
    # Once for all planes; NIfTI readers give Fortran order.
    data = np.ascontiguousarray(image.data, dtype=image.data.dtype if interpolation == "nearest" else np.float32)
    result = np.zeros(grid.shape, dtype=image.data.dtype)
    in_plane = np.indices(grid.shape[1:]).reshape(2, -1).T
    across = in_plane @ T_image_grid[:3, 1:3].T + T_image_grid[:3, 3]
    for i in range(grid.shape[0]):  # a plane at a time stays in the cache
        source = across + i * T_image_grid[:3, 0] + inverse[i].reshape(-1, 3) @ T_image_patient[:3, :3].T
        inside = np.flatnonzero(reached(source, image.shape, 0.5))
        result[i].reshape(-1)[inside] = _values(data, source[inside], interpolation, result.dtype)
    return Volume(result, grid.T_patient_voxel)


def _values(data: NDArray, voxels: NDArray[np.float64], interpolation: Interpolation, dtype: np.dtype) -> NDArray:
    if interpolation == "nearest":
        index = np.clip(np.floor(voxels + 0.5).astype(np.intp), 0, np.array(data.shape) - 1)
        return data[tuple(index.T)]
    values = trilinear(data[..., None], voxels)[:, 0]
    return values if np.issubdtype(dtype, np.floating) else np.rint(values).astype(dtype)


def warp_surface(deformation: Deformation, surface: Surface) -> Surface:
    """Move a surface with the tissue."""
    return Surface(surface.vertices + deformation.forward_at(surface.vertices), surface.faces)
