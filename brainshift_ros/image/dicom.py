"""Read a folder with one DICOM series: checked slice by slice, so that a gap or a mixture is never read as a head."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import SimpleITK as sitk  # noqa: N813
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.image.checks import check_affine, check_voxels, is_dicom
from brainshift_ros.image.dicom_slices import CONVERT, in_order, read_header, read_slice, stack_affine_mm, tag_text
from brainshift_ros.image.volume import Volume
from brainshift_ros.units import affine_mm_to_m

_SERIES_NUMBER, _SERIES_DESCRIPTION = "0020|0011", "0008|103e"


@dataclass(frozen=True)
class DicomSeries:
    """One series in a folder: its unique id, number, description and files."""

    uid: str
    number: str
    description: str
    files: tuple[str, ...]

    def __str__(self) -> str:
        return f'{self.number or "?"} "{self.description}" ({len(self.files)} images)'


def read_dicom_series(folder: str | Path, series: str | None = None) -> Volume:
    """Read the DICOM series in a folder.

    Parameters
    ----------
    folder
        Its files are searched, not its subfolders. Files that are not DICOM are passed over.
    series
        Number or unique id of the series to read, where the folder holds several.

    Returns
    -------
    Volume
        float32 with rescale slope and intercept applied; the affine in metres, RAS+ (DICOM itself is LPS+).

    Raises
    ------
    InputError
        No DICOM image, several series and none chosen, no such series, multi-frame or colour images, images without a
        position, of different orientations or sizes, several at one place, slices missing or unevenly spaced, an encoding
        that cannot be read, voxels that are not finite, or all zero.
    """
    folder = Path(folder)
    with _quiet():
        chosen = _chosen(folder, dicom_series(folder), series)
        _check_whole(folder, chosen)
        slices = in_order(folder, [read_slice(file) for file in chosen.files])
        affine_mm = stack_affine_mm(folder, slices)
        data = _read_voxels(folder, [item.file for item in slices])
    check_affine(folder, affine_mm, CONVERT)
    check_voxels(folder, data)
    return Volume(data, affine_mm_to_m(affine_mm))


def dicom_series(folder: Path) -> tuple[DicomSeries, ...]:
    """List the series in a folder, in the order of their numbers."""
    found = []
    for uid in sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder)):
        files = _files(folder, uid)
        try:
            header = read_header(files[0])
        except InputError:  # a series without images: a structured report, a presentation state
            continue
        found.append(DicomSeries(uid, tag_text(header, _SERIES_NUMBER), tag_text(header, _SERIES_DESCRIPTION), files))
    return tuple(sorted(found, key=lambda item: (item.number.zfill(8), item.uid)))


def _chosen(folder: Path, found: Sequence[DicomSeries], wanted: str | None) -> DicomSeries:
    if not found:
        below = [child.name for child in sorted(folder.iterdir()) if child.is_dir() and dicom_series(child)]
        remedy = f"give its subfolder {below[0]}" if below else "give a folder with one DICOM series, or a NIfTI file"
        raise InputError(folder, "holds no DICOM image", remedy)
    names = "; ".join(str(item) for item in found)
    matching = [item for item in found if wanted in (None, item.number, item.uid)]
    if not matching:
        raise InputError(folder, f"holds no series {wanted}, but {names}", "choose one of these by its number")
    if len(matching) > 1:
        problem = f"holds {len(matching)} series: {'; '.join(str(item) for item in matching)}"
        raise InputError(folder, problem, "give a folder with the T1 alone, or choose a series by its number or unique id")
    return matching[0]


def _check_whole(folder: Path, chosen: DicomSeries) -> None:
    """Refuse a folder with a DICOM file that GDCM passes over as damaged: it may be the first or last slice."""
    listed = {file for uid in sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder)) for file in _files(folder, uid)}
    for path in sorted(folder.iterdir()):
        if path.is_file() and is_dicom(path) and path.name.upper() != "DICOMDIR" and str(path) not in listed:
            raise InputError(path, "is a damaged DICOM file", f"copy series {chosen} again")


def _files(folder: Path, uid: str) -> tuple[str, ...]:
    return tuple(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), uid))


def _read_voxels(folder: Path, files: list[str]) -> NDArray[np.float32]:
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(files)
    # Slopes may differ from slice to slice, and would be cut to integers in the type of the first.
    reader.SetOutputPixelType(sitk.sitkFloat32)
    try:
        image = reader.Execute()
    except RuntimeError as error:
        raise InputError(folder, f"its images cannot be decoded ({_reason(error)})", CONVERT) from error
    return np.ascontiguousarray(sitk.GetArrayFromImage(image).T)


def _reason(error: RuntimeError) -> str:
    """Take the last sentence of an ITK message, which says why; what comes before says where in ITK."""
    return str(error).strip().splitlines()[-1].split("): ")[-1]


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep ITK from printing about files that are not DICOM: what matters is raised."""
    before = sitk.ProcessObject.GetGlobalWarningDisplay()
    sitk.ProcessObject.SetGlobalWarningDisplay(False)
    try:
        yield
    finally:
        sitk.ProcessObject.SetGlobalWarningDisplay(before)
