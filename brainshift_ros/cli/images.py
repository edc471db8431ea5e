"""What `patient` and `segment` read: the MR, and masks of one or several tumours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from brainshift_ros.errors import InputError
from brainshift_ros.files import sha256_of_file
from brainshift_ros.h5 import digest
from brainshift_ros.image.io import read_volume
from brainshift_ros.image.resample import resample
from brainshift_ros.image.volume import Volume
from brainshift_ros.mesh.patient import ImageReference


def read_tumors(paths: Sequence[Path], t1: Volume) -> Volume | None:
    """Read tumour masks, on any grids, as one mask on the grid of the T1; None without any.

    Raises
    ------
    InputError
        A mask marks no voxel of the T1.
    """
    union = np.zeros(t1.shape, dtype=np.uint8)
    for path in paths:
        mask = read_volume(path)
        on_grid = resample(Volume((mask.data > 0).astype(np.uint8), mask.T_patient_voxel), t1, "nearest").data > 0
        if not on_grid.any():
            problem = "marks no voxel of the T1: it lies outside, or is smaller than a voxel"
            raise InputError(path, problem, "draw the tumour on this T1, or leave the mask out")
        union[on_grid] = 1
    return Volume(union, t1.T_patient_voxel) if paths else None


def image_reference(t1: Volume, path: Path) -> ImageReference:
    """Describe the MR that a patient model is made from; a DICOM folder is known by its voxels."""
    identity = sha256_of_file(path) if path.is_file() else digest(t1.data, t1.T_patient_voxel)
    return ImageReference(path.name, identity, t1.shape, t1.T_patient_voxel)
