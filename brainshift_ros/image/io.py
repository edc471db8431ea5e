"""Read an image, NIfTI or DICOM, and write NIfTI; here and in :mod:`.dicom` alone are files' axes and units interpreted."""

from __future__ import annotations

import zlib
from pathlib import Path

import nibabel as nib
import numpy as np
from nibabel.filebasedimages import ImageFileError
from nibabel.spatialimages import HeaderDataError
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.files import atomic_path, existing_file, writable_target
from brainshift_ros.image.checks import check_affine, check_voxels, is_dicom
from brainshift_ros.image.volume import Volume
from brainshift_ros.units import affine_m_to_mm, affine_mm_to_m

#: What NIfTI files that hold header and voxels together are called.
NIFTI_SUFFIXES = (".nii", ".nii.gz")

# NIfTI's spatial unit codes and how many millimetres one unit is; 0 (unknown) means millimetres in practice.
_MM_PER_UNIT = {0: 1.0, 1: 1000.0, 2: 1.0, 3: 0.001}


def read_volume(path: str | Path, series: str | None = None) -> Volume:
    """Read a 3-D image of any axis orientation and any affine, oblique ones included.

    Parameters
    ----------
    path
        ``.nii`` or ``.nii.gz``, or a folder with one DICOM series.
    series
        Number or unique id of the DICOM series, where the folder holds several.

    Returns
    -------
    Volume
        Voxel values with the file's scaling applied (integers stay integers), and the affine in metres, RAS+.

    Raises
    ------
    InputError
        Missing, not a NIfTI, cut off, not 3-D, without a qform or sform or with two that mirror each other, with a singular
        affine or an absurd voxel size, with non-finite voxels, or zero everywhere; for a folder, what
        :func:`~brainshift_ros.image.dicom.read_dicom_series` says.
    """
    if Path(path).is_dir():
        # Imported here: SimpleITK takes a while, and who reads NIfTI never needs it.
        from brainshift_ros.image.dicom import read_dicom_series

        return read_dicom_series(path, series)
    path = existing_file(path, "NIfTI image (.nii or .nii.gz)")
    if is_dicom(path):
        raise InputError(path, "is one DICOM image, not a volume", "give the folder that holds the series")
    try:
        image = nib.load(path)
    except (ImageFileError, HeaderDataError, OSError, EOFError, zlib.error, ValueError) as error:
        raise InputError(path, f"is not a NIfTI image ({error})", "give a .nii or .nii.gz file") from error
    if not isinstance(image, nib.Nifti1Image):
        raise InputError(path, f"is a {type(image).__name__}, not a NIfTI image", "convert it to .nii.gz")
    shape = image.shape
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) != 3 or min(shape) < 2:
        what = "not three dimensions" if len(shape) != 3 else "a single slice"
        raise InputError(path, f"has shape {image.shape}, {what}", "give one 3-D volume")
    T_patient_voxel = _affine_m(path, image)
    data = _voxels(path, image).reshape(shape)
    check_voxels(path, data)
    return Volume(data, T_patient_voxel)


def write_volume(path: str | Path, volume: Volume) -> None:
    """Write a volume as NIfTI in millimetres, qform and sform set alike; the file appears whole or not at all.

    Masks are written as uint8, 64-bit integers as int32 and half floats as float32: not all readers know the others.

    Raises
    ------
    InputError
        The path cannot be written to, or does not end in ``.nii`` or ``.nii.gz``.
    """
    path = writable_target(path, NIFTI_SUFFIXES)
    image = nib.Nifti1Image(_storable(volume.data), affine_m_to_mm(volume.T_patient_voxel))
    image.header.set_xyzt_units("mm", "sec")
    image.set_sform(image.affine, code="scanner")
    # The qform cannot hold shears; nibabel then stores the closest rotation, and readers prefer the sform.
    image.set_qform(image.affine, code="scanner", strip_shears=True)
    with atomic_path(path) as temporary:
        nib.save(image, temporary)


def _storable(data: NDArray) -> NDArray:
    if data.dtype == np.bool_:
        return data.astype(np.uint8)
    if data.dtype == np.float16:
        return data.astype(np.float32)
    if data.dtype.kind in "iu" and data.dtype.itemsize == 8:
        limits = np.iinfo(np.int32)
        fits = limits.min <= data.min(initial=0) and data.max(initial=0) <= limits.max
        return data.astype(np.int32 if fits else np.float64)
    return data


def _affine_m(path: Path, image: nib.Nifti1Image) -> NDArray[np.float64]:
    header = image.header
    if int(header["sform_code"]) == 0 and int(header["qform_code"]) == 0:
        problem = "has neither a qform nor an sform, so where its voxels lie in the head is unknown"
        raise InputError(path, problem, "export it again with its orientation, or set the sform")
    affine = np.array(image.affine, dtype=np.float64)
    affine[:3] *= _MM_PER_UNIT.get(int(header["xyzt_units"]) & 7, 1.0)
    check_affine(path, affine, "repair the qform or sform")
    if int(header["sform_code"]) > 0 and int(header["qform_code"]) > 0:
        sform, qform = (np.linalg.det(form[:3, :3]) for form in (header.get_sform(), header.get_qform()))
        if sform * qform < 0.0:
            problem = "its qform and sform mirror each other, so left and right are unknown"
            raise InputError(path, problem, "find out which is right and copy it to the other")
    return affine_mm_to_m(affine)


def _voxels(path: Path, image: nib.Nifti1Image) -> NDArray:
    try:
        data = np.asanyarray(image.dataobj)
    except (OSError, EOFError, zlib.error, ValueError, MemoryError) as error:
        raise InputError(path, f"is cut off or damaged ({error})", "copy or export the file again") from error
    if data.dtype.kind not in "uif":
        raise InputError(path, f"holds voxels of type {data.dtype}, not numbers", "give a scalar image")
    return np.array(data)
