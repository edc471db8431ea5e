"""What the tissue has left: the gap that opens beneath the skull, and the cavity of a resected tumour.

A displacement moves what was there; it cannot show what came in its place, air or fluid. These two draw it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.errors import InputError
from brainshift_ros.field.deformation import Deformation
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.resample import resample
from brainshift_ros.image.volume import Region, Volume

#: The mesh is a little smaller than the brain of the image, whose outermost voxels belong to it, metres.
_RIM = 0.002


def draw_gap(updated: Volume, image: Volume, deformation: Deformation, owner: NDArray[np.int32], value: float) -> Volume:
    """Hold still what is not brain, and draw the space that the brain has left.

    The smooth field around the brain carries skull and scalp along with it. Here they stay where they were; the brain moves
    beneath them, and what it left is `value`.

    Parameters
    ----------
    updated
        The image, warped.
    image
        The image before.
    deformation
        What warped it.
    owner
        ``deformation.owner_now(grid)`` of its grid.
    value
        Intensity of what came in: 0 for air, that of cerebrospinal fluid otherwise.
    """
    grid = Grid.of(updated)
    outside = ~_with_rim(owner >= 0, grid)
    data = updated.data.copy()
    still = resample(image, updated, "linear").data[outside]
    data[outside] = still if data.dtype.kind == "f" else np.rint(still)
    data[outside & _with_rim(deformation.inside(grid), grid)] = value
    return Volume(data, updated.T_patient_voxel)


def draw_cavity(updated: Volume, deformation: Deformation, owner: NDArray[np.int32], value: float) -> Volume:
    """Draw the tumour as a cavity, where its walls are now.

    Parameters
    ----------
    updated
        The image, warped.
    deformation, owner
        As for :func:`draw_gap`.
    value
        Intensity of what fills it.

    Raises
    ------
    InputError
        The field's mesh has no tumour.
    """
    tumor = deformation.field.mesh.region == Region.TUMOR
    if not tumor.any():
        raise InputError("cavity", "the field's mesh has no tumour", "leave the option out")
    data = updated.data.copy()
    data[(owner >= 0) & tumor[owner]] = value
    return Volume(data, updated.T_patient_voxel)


def _with_rim(mask: NDArray[np.bool_], grid: Grid) -> NDArray[np.bool_]:
    return np.asarray(ndimage.distance_transform_edt(~mask, sampling=grid.voxel_edges) <= _RIM)
