"""DICOM series: the same voxels in the same places as SimpleITK, and one clear error for each fault."""

from __future__ import annotations

import shutil
from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from dicom_cases import image_of, write_series
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import T_LPS_RAS, transform_points
from brainshift_ros.image.dicom import dicom_series, read_dicom_series
from brainshift_ros.image.io import read_volume, write_volume
from brainshift_ros.units import m_to_mm

# Right-handed axis orders, as DICOM's slices are stacked along the cross product of row and column: sagittal, coronal, axial.
ORIENTATIONS = [
    matrix
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(matrix := np.eye(3)[:, list(order)] * signs) > 0
]


@pytest.fixture
def voxels() -> np.ndarray:
    return np.random.default_rng(0).integers(1, 900, (16, 12, 6)).astype(np.int16)


def assert_like_simpleitk(folder: Path) -> None:
    """Every corner voxel has the place and value that SimpleITK's own series reader gives it."""
    volume = read_volume(folder)
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(folder), reader.GetGDCMSeriesIDs(str(folder))[0]))
    itk = reader.Execute()
    assert volume.shape == itk.GetSize()
    for index in product(*((0, n - 1) for n in volume.shape)):
        place = transform_points(T_LPS_RAS, m_to_mm(transform_points(volume.T_patient_voxel, index)))
        np.testing.assert_allclose(place, itk.TransformIndexToPhysicalPoint(index), atol=1e-5)
        assert volume.data[index] == pytest.approx(itk[index])


@pytest.mark.parametrize("direction", ORIENTATIONS[::3])
def test_orientations_against_simpleitk(tmp_path: Path, voxels: np.ndarray, direction: np.ndarray) -> None:
    assert_like_simpleitk(write_series(tmp_path, image_of(voxels, direction)))


@settings(max_examples=6, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(angles=st.tuples(*[st.floats(-180, 180)] * 3), spacing=st.tuples(*[st.floats(0.4, 5.0)] * 3))
def test_oblique_series_against_simpleitk(
    tmp_path: Path, voxels: np.ndarray, angles: tuple[float, ...], spacing: tuple[float, ...]
) -> None:
    direction = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    folder = tmp_path / "series"
    shutil.rmtree(folder, ignore_errors=True)
    image = image_of(voxels, direction, [round(edge, 4) for edge in spacing])
    assert_like_simpleitk(write_series(folder, image))


def test_series_and_its_nifti_are_one_image(tmp_path: Path, voxels: np.ndarray) -> None:
    volume = read_volume(write_series(tmp_path / "dicom", image_of(voxels, np.eye(3))))
    np.testing.assert_array_equal(volume.data, voxels)
    write_volume(tmp_path / "t1.nii.gz", volume)
    np.testing.assert_allclose(read_volume(tmp_path / "t1.nii.gz").T_patient_voxel, volume.T_patient_voxel, atol=1e-9)


def test_slope_and_intercept_of_each_slice_are_applied(tmp_path: Path, voxels: np.ndarray) -> None:
    written, slopes = [10, 20, 30, 40, 50, 60], [".5", "2.", ".1", "3.", "1.", "7."]
    folder = write_series(tmp_path, image_of(voxels, np.eye(3)), slopes=written, intercept=-7)
    for path in folder.iterdir():  # SimpleITK writes whole slopes only: others take their place in the files
        content = path.read_bytes()
        for old, new in zip(written, slopes, strict=True):
            tag = b"\x28\x00\x53\x10\x02\x00\x00\x00"
            content = content.replace(tag + b"%d" % old, tag + new.encode())
        path.write_bytes(content)
    stored = np.trunc((voxels + 7) / written)
    np.testing.assert_allclose(read_volume(folder).data, stored * [float(slope) for slope in slopes] - 7, atol=1e-4)


def test_several_series_are_named_and_one_can_be_chosen(tmp_path: Path, voxels: np.ndarray) -> None:
    write_series(tmp_path, image_of(voxels, np.eye(3)), number=3, description="T1 MPRAGE", names="a{}.dcm")
    write_series(tmp_path, image_of(voxels[:, :, :4], np.eye(3)), number=12, description="T2 FLAIR", names="b{}.dcm")
    with pytest.raises(InputError) as error:
        read_volume(tmp_path)
    assert '3 "T1 MPRAGE" (6 images); 12 "T2 FLAIR" (4 images)' in str(error.value)
    assert read_volume(tmp_path, series="12").shape == (16, 12, 4)
    uid = dicom_series(tmp_path)[0].uid
    np.testing.assert_array_equal(read_dicom_series(tmp_path, uid).data, voxels)
    with pytest.raises(InputError, match=r'no series 5, but 3 "T1 MPRAGE"'):
        read_volume(tmp_path, series="5")


def test_compressed_series_are_read(tmp_path: Path, voxels: np.ndarray) -> None:
    folder = compressed(write_series(tmp_path / "plain", image_of(voxels, np.eye(3))), tmp_path / "compressed")
    assert b"1.2.840.10008.1.2.4" in next(folder.iterdir()).read_bytes()
    np.testing.assert_array_equal(read_volume(folder).data, voxels)


def compressed(source: Path, target: Path) -> Path:
    target.mkdir()
    for path in source.iterdir():
        writer = sitk.ImageFileWriter()
        writer.KeepOriginalImageUIDOn()
        writer.UseCompressionOn()
        writer.SetFileName(str(target / path.name))
        writer.Execute(sitk.ReadImage(str(path)))
    return target


def faulty(fault: str, folder: Path, voxels: np.ndarray) -> Path:
    straight = image_of(voxels, np.eye(3))
    match fault:
        case "empty":
            folder.mkdir()
            (folder / "notes.txt").write_text("no image")
        case "subfolder":
            write_series(folder / "series7", straight)
        case "missing":
            write_series(folder, straight, leave_out=[2, 4])
        case "uneven":
            write_series(folder, straight, leave_out=[3])
            shifted = image_of(voxels, np.eye(3))
            shifted.SetOrigin((-31.0, 17.5, 8.25 + 0.6))
            write_series(folder, shifted, leave_out=[0, 1, 2, 4, 5], names="other{}.dcm", extra={"0020|000e": only_uid(folder)})
        case "double":
            write_series(folder, straight)
            write_series(folder, straight, leave_out=range(1, 6), names="other{}.dcm", extra={"0020|000e": only_uid(folder)})
        case "orientation":
            write_series(folder, straight)
            across = image_of(voxels, ORIENTATIONS[7])
            write_series(folder, across, leave_out=range(1, 6), names="other{}.dcm", extra={"0020|000e": only_uid(folder)})
        case "sizes":
            write_series(folder, straight, leave_out=[5])
            small = image_of(voxels[:5], np.eye(3))
            write_series(folder, small, leave_out=range(5), names="other{}.dcm", extra={"0020|000e": only_uid(folder)})
        case "single":
            write_series(folder, straight, leave_out=range(1, 6))
        case "gantry":
            write_series(folder, straight, tilt=0.3)
        case "multi-frame":
            folder.mkdir()
            straight.SetMetaData("0008|0060", "MR")
            sitk.WriteImage(straight, str(folder / "all.dcm"))
        case "colour":
            folder.mkdir()
            sitk.WriteImage(sitk.Compose([sitk.Cast(straight[:, :, 0], sitk.sitkUInt8)] * 3), str(folder / "shot.dcm"))
        case "placeless":
            write_series(folder, straight)
            for path in folder.iterdir():  # image position becomes a tag that means nothing
                path.write_bytes(path.read_bytes().replace(b"\x20\x00\x32\x00", b"\x20\x00\x31\x00"))
        case "damaged":
            write_series(folder, straight)
            path = min(folder.iterdir())
            path.write_bytes(path.read_bytes()[:-40])
        case "encoding":
            folder = compressed(write_series(folder / "plain", straight), folder / "compressed")
            for path in folder.iterdir():
                content = path.read_bytes()
                start = content.rfind(b"\xfe\xff\x00\xe0") + 12  # the last item: the code stream
                path.write_bytes(content[:start] + bytes(len(content) - start))
        case "zero":
            write_series(folder, image_of(0 * voxels, np.eye(3)))
    return folder


def only_uid(folder: Path) -> str:
    (series,) = dicom_series(folder)
    return series.uid


@pytest.mark.parametrize(
    ("fault", "text"),
    [
        ("empty", "holds no DICOM image"),
        ("subfolder", "give its subfolder series7"),
        ("missing", "2 of its slices are missing, between 9.8 and 12.8 mm, 12.8 and 15.8 mm"),
        ("uneven", "not evenly spaced: 0.9 to 2.1 mm"),
        ("double", "several images at one place"),
        ("orientation", "different orientations"),
        ("sizes", "different sizes"),
        ("single", "a single image"),
        ("gantry", "tilted gantry"),
        ("multi-frame", "multi-frame"),
        ("colour", "colour image"),
        ("placeless", "does not say where it lies"),
        ("damaged", "damaged DICOM file"),
        ("encoding", "cannot be decoded"),
        ("zero", "every voxel is zero"),
    ],
)
def test_fault_is_one_clear_error(
    tmp_path: Path, voxels: np.ndarray, capfd: pytest.CaptureFixture[str], fault: str, text: str
) -> None:
    folder = faulty(fault, tmp_path / "series", voxels)
    capfd.readouterr()
    with pytest.raises(InputError) as error:
        read_volume(folder)
    assert text in str(error.value)
    assert str(folder) in str(error.value)
    if fault != "encoding":  # the JPEG 2000 library prints by itself
        assert capfd.readouterr() == ("", "")


def test_other_files_beside_the_series_are_passed_over(tmp_path: Path, voxels: np.ndarray) -> None:
    write_series(tmp_path, image_of(voxels, np.eye(3)))
    (tmp_path / "README.txt").write_text("export of the case")
    (tmp_path / "DICOMDIR").write_bytes(bytes(128) + b"DICM" + bytes(100))
    (tmp_path / "empty").mkdir()
    np.testing.assert_array_equal(read_volume(tmp_path).data, voxels)


def test_one_file_of_a_series_is_not_taken_for_the_head(tmp_path: Path, voxels: np.ndarray) -> None:
    path = min(write_series(tmp_path, image_of(voxels, np.eye(3))).iterdir())
    with pytest.raises(InputError, match="give the folder that holds the series"):
        read_volume(path)
