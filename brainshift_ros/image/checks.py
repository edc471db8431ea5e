"""What kind of file an image is in, and what it must satisfy whatever that is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError

#: Edge lengths of a voxel, in mm, beyond which the affine cannot be in millimetres.
VOXEL_EDGE_RANGE_MM = (0.05, 20.0)


def check_voxels(source: object, data: NDArray) -> None:
    """Refuse voxels that are not finite, or all zero."""
    if not np.isfinite(data).all():
        count = int(np.count_nonzero(~np.isfinite(data)))
        raise InputError(source, f"{count} of {data.size} voxels are not finite", "replace NaN and infinity by numbers")
    if not data.any():
        raise InputError(source, "every voxel is zero", "give an image with the head in it")


def check_affine(source: object, affine_mm: NDArray[np.float64], remedy: str) -> None:
    """Refuse an affine in mm that is not finite, is singular, or whose voxels no head MR has."""
    if not np.isfinite(affine_mm).all():
        raise InputError(source, "its affine is not finite", remedy)
    edges = np.linalg.norm(affine_mm[:3, :3], axis=0)
    if edges.min() == 0.0 or abs(np.linalg.det(affine_mm[:3, :3] / edges)) < 1e-3:
        raise InputError(source, "its affine is singular: the voxel axes do not span space", remedy)
    low, high = VOXEL_EDGE_RANGE_MM
    if edges.min() < low or edges.max() > high:
        problem = f"its voxels measure {' x '.join(f'{e:.4g}' for e in edges)} mm, which no head MR has"
        raise InputError(source, problem, "the affine must be in millimetres; check the unit")


def is_dicom(path: Path) -> bool:
    """Tell by its preamble whether a file is DICOM."""
    try:
        with open(path, "rb") as stream:
            return stream.read(132)[128:] == b"DICM"
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "change its permissions") from error
