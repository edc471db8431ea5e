"""Bring a preoperative image or its labels to where the brain is now."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray

from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.label_vote import vote
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.volume import Volume

#: ``linear`` for intensities. For labels, which must not mix: ``nearest``, or ``labels``, where the label wins whose
#: indicator, interpolated linearly, is largest: no new values either, and smooth edges instead of stair steps.
Interpolation = Literal["linear", "nearest", "labels"]

_INTERPOLATORS = {"linear": sitk.sitkLinear, "nearest": sitk.sitkNearestNeighbor}


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
        The result has the image's type; interpolated integers are rounded.
    """
    grid = grid or Grid.of(image)
    inverse = deformation.inverse_on(grid)
    warnings = () if inverse.any() else ("the image shows nothing that moved",)
    return WarpedImage(resample_through(image, inverse, grid, interpolation), inverse, grid, warnings)


def resample_through(image: Volume, inverse: NDArray, grid: Grid, interpolation: Interpolation = "linear") -> Volume:
    """Sample an image at ``y + v(y)`` for the voxels y of a grid, by ITK where it can.

    Voxels reach half a voxel beyond their centres at the image's border, and beyond that the result is 0.

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
    result = np.zeros(grid.shape, dtype=image.data.dtype)
    window = _may_show(image, inverse, grid)
    if window is not None and interpolation == "labels":
        result[window] = vote(image, inverse[window], _corner_at(grid, window))
    elif window is not None:
        # ITK cuts off the fractions of integers that it interpolates.
        data = image.data.astype(np.float32) if interpolation == "linear" else image.data
        moving = _itk_image(data, image.T_patient_voxel)
        shifts = _itk_image(inverse[window], _corner_at(grid, window), vectors=True)
        space = (shifts.GetSize(), shifts.GetOrigin(), shifts.GetSpacing(), shifts.GetDirection())
        warped = sitk.Warp(moving, shifts, _INTERPOLATORS[interpolation], *space)
        values = sitk.GetArrayViewFromImage(warped)  # of memory that lives as long as `warped`
        result[window] = values if interpolation != "linear" or result.dtype.kind == "f" else np.rint(values)
    return Volume(result, grid.T_patient_voxel)


def _may_show(image: Volume, inverse: NDArray, grid: Grid) -> tuple[slice, slice, slice] | None:
    """Part of the grid outside of which the result is 0: the box of what is not 0 in the image, as far as it may move."""
    filled = [np.flatnonzero(image.data.any(axis=across)) for across in ((1, 2), (0, 2), (0, 1))]
    if not filled[0].size:
        return None
    ends = [(indices[0] - 1, indices[-1] + 1) for indices in filled]
    corners = grid.to_voxels(Grid.of(image).centres(list(itertools.product(*ends))))
    # A shift of at most so much in each component lies in a box, which is known in voxels of any affine too.
    largest = max(float(inverse.max()), -float(inverse.min()))
    shift = np.abs(np.linalg.inv(grid.T_patient_voxel[:3, :3])).sum(axis=1) * largest
    first = np.maximum(np.floor(corners.min(axis=0) - shift), 0).astype(int)
    stop = np.minimum(np.ceil(corners.max(axis=0) + shift) + 1, grid.shape).astype(int)
    if (first >= stop).any():
        return None
    i, j, k = (slice(int(a), int(b)) for a, b in zip(first, stop, strict=True))
    return i, j, k


def _corner_at(grid: Grid, window: tuple[slice, slice, slice]) -> NDArray[np.float64]:
    """Affine of the part of a grid."""
    T = grid.T_patient_voxel.copy()
    T[:3, 3] = grid.centres([part.start for part in window])
    return T


def _itk_image(data: NDArray, T_patient_voxel: NDArray[np.float64], vectors: bool = False) -> sitk.Image:
    """Give an array to ITK, in metres of the patient frame; ITK's axes are the array's in reverse order."""
    data = np.ascontiguousarray(data, dtype=_itk_type(data.dtype))
    image = sitk.GetImageFromArray(data, isVector=vectors)
    edges = np.linalg.norm(T_patient_voxel[:3, :3], axis=0)
    image.SetSpacing(edges[::-1].tolist())
    image.SetDirection((T_patient_voxel[:3, :3] / edges)[:, ::-1].ravel().tolist())
    image.SetOrigin(T_patient_voxel[:3, 3].tolist())
    return image


def _itk_type(dtype: np.dtype) -> np.dtype:
    """Return the type in this machine's byte order, or one that holds the same values where ITK does not know it."""
    replacement = {"b1": np.uint8, "f2": np.float32}.get(f"{dtype.kind}{dtype.itemsize}")
    return np.dtype(replacement) if replacement is not None else dtype.newbyteorder("=")
