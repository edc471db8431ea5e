"""Displacement transforms that ITK, SimpleITK, ANTs and 3D Slicer read: NIfTI vector images, LPS, millimetres.

ITK keeps space in LPS and asks a transform where each *output* point came from. So the file holds the inverse
displacement, with the signs of its first two components turned; its grid is stored as for any NIfTI, which ITK's reader
turns to LPS by itself.
"""

from __future__ import annotations

from pathlib import Path

import nibabel as nib
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.files import atomic_path, existing_file, writable_target
from brainshift_ros.geometry import T_LPS_RAS
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.io import NIFTI_SUFFIXES
from brainshift_ros.units import affine_m_to_mm, affine_mm_to_m, m_to_mm, mm_to_m

#: NIfTI intent: a vector at each voxel, the components along the fifth dimension.
_INTENT_VECTOR = 1007
#: Components are rounded to this fraction of a millimetre: the zero bits that this leaves make the file half as large and
#: quicker to write.
_STEPS_PER_MM = 1024.0

_RAS_TO_LPS = np.diag(T_LPS_RAS)[:3]


def write_displacement_image(path: str | Path, vectors: NDArray, grid: Grid) -> None:
    """Write a displacement per voxel as an ITK displacement field.

    Parameters
    ----------
    path
        ``.nii`` or ``.nii.gz``.
    vectors
        Shape (I, J, K, 3), metres, patient frame (RAS). Give ``Deformation.inverse_on(grid)`` for a transform that
        updates images by resampling, ``forward_on(grid)`` for one that moves points.
    grid
        Where the voxels lie. ITK cannot hold sheared grids.

    Raises
    ------
    InputError
        The grid is sheared, or the path cannot be written to or does not end in ``.nii`` or ``.nii.gz``.
    """
    path = writable_target(path, NIFTI_SUFFIXES)
    axes = grid.T_patient_voxel[:3, :3] / grid.voxel_edges
    if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-4:
        raise InputError(path, "the image's axes are not at right angles, which ITK cannot hold", "resample the image first")
    rounded_mm = np.rint(m_to_mm(vectors) * (_RAS_TO_LPS * _STEPS_PER_MM)) / _STEPS_PER_MM
    data = rounded_mm.astype(np.float32)[:, :, :, None, :]
    affine_mm = affine_m_to_mm(grid.T_patient_voxel)
    image = nib.Nifti1Image(data, affine_mm)
    image.header.set_intent(_INTENT_VECTOR)
    image.header.set_xyzt_units("mm")
    image.set_sform(affine_mm, code=1)
    image.set_qform(affine_mm, code=1)
    with atomic_path(path) as temporary:
        nib.save(image, temporary)


def read_displacement_image(path: str | Path) -> tuple[NDArray[np.float64], Grid]:
    """Read a displacement image of ITK's kind: vectors (I, J, K, 3) in metres, RAS, and their grid.

    Raises
    ------
    InputError
        Missing, or not a NIfTI image of 3-vectors.
    """
    path = existing_file(path, "displacement transform (NIfTI)")
    try:
        image = nib.Nifti1Image.from_filename(path)
        data = np.asarray(image.dataobj, dtype=np.float64)
    except (nib.filebasedimages.ImageFileError, OSError, EOFError, ValueError) as error:
        raise InputError(path, f"is not a readable NIfTI image ({error})", "give a displacement transform") from error
    if data.ndim != 5 or data.shape[3:] != (1, 3):
        raise InputError(path, f"has shape {data.shape}, not (I, J, K, 1, 3)", "give a displacement transform")
    i, j, k = data.shape[:3]
    return mm_to_m(data[:, :, :, 0] * _RAS_TO_LPS), Grid((i, j, k), affine_mm_to_m(image.affine))
