"""Where the slices of a DICOM series lie: read from their headers, put in order, refused unless they make one even stack."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import T_LPS_RAS

#: Slices may miss their even spacing by this fraction of it, and their common direction by this cosine.
SPACING_TOLERANCE, DIRECTION_TOLERANCE = 0.05, 1e-3

_POSITION, _ORIENTATION, _PIXEL_SPACING = "0020|0032", "0020|0037", "0028|0030"
_FRAMES, _SAMPLES, _SOP_CLASS = "0028|0008", "0028|0002", "0008|0016"

#: Enhanced MR, enhanced MR colour: one file, whose slices' places are in nested sequences that SimpleITK does not show.
_ENHANCED = ("1.2.840.10008.5.1.4.1.1.4.1", "1.2.840.10008.5.1.4.1.1.4.3")

CONVERT = "convert it to NIfTI, for example with dcm2niix"


@dataclass(frozen=True)
class DicomSlice:
    """Where an image lies, in mm, LPS, as its header says; `directions` (2, 3) are those of its rows and columns."""

    file: str
    position: NDArray[np.float64]
    directions: NDArray[np.float64]
    spacing: tuple[float, float]
    size: tuple[int, ...]

    @property
    def normal(self) -> NDArray[np.float64]:
        """Direction in which slices are stacked."""
        return np.cross(*self.directions)


def read_slice(file: str) -> DicomSlice:
    """Read where one image lies; refuse what is not a single grey image with a place in the patient."""
    header = read_header(file)
    frames, samples = (tag_text(header, key) or "1" for key in (_FRAMES, _SAMPLES))
    if int(frames) > 1 or tag_text(header, _SOP_CLASS) in _ENHANCED:
        raise InputError(file, f"is a multi-frame (enhanced) DICOM image, frames: {int(frames)}", CONVERT)
    if int(samples) != 1:
        raise InputError(file, "is a colour image", "give the series with the MR itself, not a screenshot of it")
    position, directions, spacing = (_tag_numbers(header, key) for key in (_POSITION, _ORIENTATION, _PIXEL_SPACING))
    placed = len(position) == 3 and len(directions) == 6 and len(spacing) == 2
    if not placed or not np.isfinite([*position, *directions, *spacing]).all():
        problem = "does not say where it lies in the patient (image position, orientation or pixel spacing)"
        raise InputError(file, problem, "export the original series, not a secondary capture")
    # Pixel spacing is between rows, then between columns; rows run along the first direction.
    return DicomSlice(file, position, directions.reshape(2, 3), (spacing[1], spacing[0]), header.GetSize()[:2])


def in_order(folder: Path, slices: Sequence[DicomSlice]) -> list[DicomSlice]:
    """Sort along the common normal and refuse what is not one evenly spaced stack."""
    first = slices[0]
    for other in slices[1:]:
        if np.abs(other.directions - first.directions).max() > DIRECTION_TOLERANCE:
            raise InputError(folder, "its series mixes images of different orientations", "leave the localiser images out")
        if other.size != first.size or not np.allclose(other.spacing, first.spacing, rtol=1e-3):
            raise InputError(folder, "its series mixes images of different sizes", "give the images of one acquisition")
    if len(slices) < 2:
        raise InputError(folder, "its series holds a single image, not a volume", "give the folder with all its slices")
    ordered = sorted(slices, key=lambda item: float(item.position @ first.normal))
    height = np.array([item.position @ first.normal for item in ordered])
    gaps = np.diff(height)
    if gaps.min() < 1e-3:
        problem = f"its series holds several images at one place (position {height[np.argmin(gaps)]:.1f} mm)"
        raise InputError(folder, problem, "give one echo or time point, each image once")
    steps = gaps / gaps.min()
    if steps.max() > 1.0 + SPACING_TOLERANCE:
        if np.abs(steps - np.rint(steps)).max() > SPACING_TOLERANCE:
            problem = f"its slices are not evenly spaced: {gaps.min():.3g} to {gaps.max():.3g} mm"
            raise InputError(folder, problem, "resample it to even slices, or give another series")
        where = ", ".join(f"{height[k]:.1f} and {height[k + 1]:.1f} mm" for k in np.flatnonzero(steps > 1.5)[:3])
        problem = f"{int(np.rint(steps - 1.0).sum())} of its slices are missing, between {where}"
        raise InputError(folder, problem, "export the series again, with all its slices")
    return ordered


def stack_affine_mm(folder: Path, slices: Sequence[DicomSlice]) -> NDArray[np.float64]:
    """Voxel indices (column, row, slice) to RAS, mm (DICOM PS3.3, C.7.6.2.1.1)."""
    first, last = slices[0], slices[-1]
    step = (last.position - first.position) / (len(slices) - 1)
    if abs(float(step @ first.normal)) < (1.0 - DIRECTION_TOLERANCE) * float(np.linalg.norm(step)):
        raise InputError(folder, "its slices are shifted against each other (tilted gantry)", CONVERT)
    T_lps_voxel = np.eye(4)
    T_lps_voxel[:3, 0] = first.directions[0] * first.spacing[0]
    T_lps_voxel[:3, 1] = first.directions[1] * first.spacing[1]
    T_lps_voxel[:3, 2] = step
    T_lps_voxel[:3, 3] = first.position
    return T_LPS_RAS @ T_lps_voxel


def read_header(file: str) -> sitk.ImageFileReader:
    """Read the tags of one DICOM image, without its voxels."""
    reader = sitk.ImageFileReader()
    reader.SetImageIO("GDCMImageIO")
    reader.SetFileName(file)
    try:
        reader.ReadImageInformation()
    except RuntimeError as error:
        raise InputError(file, "its DICOM header cannot be read", "copy or export the file again") from error
    return reader


def tag_text(header: sitk.ImageFileReader, key: str) -> str:
    """Text of a tag such as ``0020|0011``; empty where it is missing."""
    return header.GetMetaData(key).strip("\0 ") if header.HasMetaDataKey(key) else ""


def _tag_numbers(header: sitk.ImageFileReader, key: str) -> NDArray[np.float64]:
    text = tag_text(header, key)
    try:
        return np.array([float(part) for part in text.split("\\")] if text else [])
    except ValueError:
        return np.array([])
