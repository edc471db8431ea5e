"""Reading images: 48 axis orientations and oblique against SimpleITK; every fault is one clear error."""

from __future__ import annotations

from itertools import permutations, product
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import T_LPS_RAS, transform_points
from brainshift_ros.image.io import read_volume, write_volume
from brainshift_ros.image.resample import resample, sample
from brainshift_ros.image.volume import Volume
from brainshift_ros.simulation.synthetic_grid import reoriented
from brainshift_ros.units import affine_mm_to_m, m_to_mm, mm_to_m

ORIENTATIONS = [(p, s) for p in permutations(range(3)) for s in product((1, -1), repeat=3)]


def affine_mm(order: tuple[int, ...], signs: tuple[int, ...], turn: Rotation | None = None) -> np.ndarray:
    affine = np.eye(4)
    affine[:3, :3] = np.eye(3)[:, list(order)] * signs * [0.9, 1.1, 1.5]
    if turn is not None:
        affine[:3, :3] = turn.as_matrix() @ affine[:3, :3]
    affine[:3, 3] = [-31.0, 17.0, 8.5]
    return affine


def saved(path: Path, data: np.ndarray, affine: np.ndarray) -> Path:
    nib.save(nib.Nifti1Image(data, affine), path)
    return path


@pytest.mark.parametrize("turn", [None, Rotation.from_euler("xyz", [11, -23, 37], degrees=True)], ids=["straight", "oblique"])
def test_landmark_lies_where_simpleitk_puts_it(tmp_path: Path, turn: Rotation | None) -> None:
    rng = np.random.default_rng(0)
    for order, signs in ORIENTATIONS:
        data = rng.uniform(1, 2, (7, 8, 9)).astype(np.float32)
        index = tuple(int(i) for i in rng.integers(0, data.shape))
        data[index] = 100.0
        path = saved(tmp_path / "t1.nii", data, affine_mm(order, signs, turn))

        volume = read_volume(path)
        found = np.unravel_index(np.argmax(volume.data), volume.shape)
        itk = sitk.ReadImage(str(path))
        assert itk[index] == 100.0
        expected_lps = itk.TransformIndexToPhysicalPoint(index)

        point_lps_mm = transform_points(T_LPS_RAS, m_to_mm(transform_points(volume.T_patient_voxel, found)))
        np.testing.assert_allclose(point_lps_mm, expected_lps, atol=1e-4)


@settings(max_examples=30, deadline=None)
@given(
    order=st.permutations(range(3)),
    signs=st.tuples(*[st.sampled_from([1, -1])] * 3),
    angles=st.tuples(*[st.floats(-180.0, 180.0)] * 3),
    point_mm=st.tuples(*[st.floats(-4.0, 4.0)] * 3),
)
def test_storage_does_not_change_what_lies_where(order: list[int], signs: tuple, angles: tuple, point_mm: tuple) -> None:
    """However the axes are permuted and flipped, left-right included, a point of the patient has one value."""
    T = affine_mm((0, 1, 2), (1, 1, 1), Rotation.from_euler("xyz", angles, degrees=True))
    volume = Volume(np.random.default_rng(0).uniform(size=(12, 12, 12)), affine_mm_to_m(T))
    point = transform_points(volume.T_patient_voxel, [5.5, 5.5, 5.5]) + mm_to_m(point_mm)
    other = reoriented(volume, order, signs)
    assert sample(other, point) == pytest.approx(sample(volume, point), abs=1e-9)
    on_grid = resample(other, volume, "nearest")
    np.testing.assert_array_equal(on_grid.data, volume.data)


def test_left_right_flipped_files_give_the_same_image(tmp_path: Path) -> None:
    data = np.random.default_rng(0).uniform(1, 2, (5, 6, 7)).astype(np.float32)
    neurological = affine_mm((0, 1, 2), (1, 1, 1))
    radiological = neurological @ np.diag([-1.0, 1.0, 1.0, 1.0])
    radiological[:3, 3] += neurological[:3, 0] * 4
    one = read_volume(saved(tmp_path / "n.nii.gz", data, neurological))
    other = read_volume(saved(tmp_path / "r.nii.gz", data[::-1].copy(), radiological))
    assert np.linalg.det(other.T_patient_voxel) < 0.0 < np.linalg.det(one.T_patient_voxel)
    np.testing.assert_array_equal(resample(other, one, "nearest").data, one.data)


def test_written_file_is_read_alike_by_simpleitk(tmp_path: Path) -> None:
    affine = affine_mm((2, 0, 1), (1, -1, 1), Rotation.from_euler("xyz", [5, 6, 7], degrees=True))
    path = saved(tmp_path / "a.nii.gz", np.arange(1, 61, dtype=np.int16).reshape(3, 4, 5), affine)
    volume = read_volume(path)
    write_volume(tmp_path / "b.nii.gz", volume)
    again = read_volume(tmp_path / "b.nii.gz")
    np.testing.assert_array_equal(again.data, volume.data)
    np.testing.assert_allclose(again.T_patient_voxel, volume.T_patient_voxel, atol=1e-9)
    one, two = sitk.ReadImage(str(path)), sitk.ReadImage(str(tmp_path / "b.nii.gz"))
    np.testing.assert_allclose(
        two.TransformIndexToPhysicalPoint((2, 3, 4)), one.TransformIndexToPhysicalPoint((2, 3, 4)), atol=1e-4
    )


def test_metre_unit_in_the_header_is_honoured(tmp_path: Path) -> None:
    affine = np.diag([0.001, 0.001, 0.001, 1.0])
    image = nib.Nifti1Image(np.ones((4, 4, 4), np.float32), affine)
    image.header.set_xyzt_units("meter")
    nib.save(image, tmp_path / "m.nii")
    np.testing.assert_allclose(read_volume(tmp_path / "m.nii").T_patient_voxel, affine, rtol=1e-6)


def bad_files(folder: Path) -> dict[str, tuple[Path, str]]:
    ones, affine = np.ones((8, 8, 8), np.float32), np.eye(4)
    nan = ones.copy()
    nan[1, 2, 3] = np.nan
    text = folder / "text.nii.gz"
    text.write_text("no image")
    noise = np.random.default_rng(1).normal(size=(24, 24, 24)).astype(np.float32)
    cut = saved(folder / "cut.nii.gz", noise, affine)
    cut.write_bytes(cut.read_bytes()[:20_000])
    placeless = nib.Nifti1Image(ones, None)
    nib.save(placeless, folder / "placeless.nii.gz")
    singular = nib.Nifti1Image(ones, affine)
    singular.header.set_sform(np.diag([1.0, 1.0, 0.0, 1.0]), code=1)
    singular.header["qform_code"] = 0
    singular._affine = singular.header.get_sform()
    nib.save(singular, folder / "singular.nii.gz")
    mirrored = nib.Nifti1Image(ones, affine)
    mirrored.set_sform(np.diag([-1.0, 1.0, 1.0, 1.0]), code=1)
    mirrored.set_qform(affine, code=1)
    nib.save(mirrored, folder / "mirrored.nii.gz")
    colour = np.zeros((8, 8, 8), dtype=[("R", "u1"), ("G", "u1"), ("B", "u1")])
    header = bytearray(saved(folder / "plain.nii", ones, affine).read_bytes())
    header[70:72] = (9999).to_bytes(2, "little")  # a data type that does not exist
    (folder / "header.nii").write_bytes(header)
    return {
        "header": (folder / "header.nii", "is not a NIfTI image"),
        "missing": (folder / "nowhere.nii.gz", "no such file"),
        "folder": (folder, "holds no DICOM image"),
        "foreign": (text, "is not a NIfTI image"),
        "cut": (cut, "cut off"),
        "4-D": (saved(folder / "4d.nii.gz", np.ones((4, 4, 4, 3), np.float32), affine), "three dimensions"),
        "slice": (saved(folder / "slice.nii.gz", np.ones((8, 8, 1), np.float32), affine), "a single slice"),
        "placeless": (folder / "placeless.nii.gz", "neither a qform nor an sform"),
        "singular": (folder / "singular.nii.gz", "singular"),
        "zero": (saved(folder / "zero.nii.gz", 0 * ones, affine), "every voxel is zero"),
        "nan": (saved(folder / "nan.nii.gz", nan, affine), "1 of 512 voxels are not finite"),
        "mirrored": (folder / "mirrored.nii.gz", "qform and sform mirror each other"),
        "colour": (saved(folder / "colour.nii.gz", colour, affine), "not numbers"),
        "unit": (saved(folder / "unit.nii.gz", ones, np.diag([0.001, 0.001, 0.001, 1.0])), "which no head MR has"),
    }


FORMAT_FAULTS = ["header", "missing", "folder", "foreign", "cut", "4-D", "slice", "zero", "nan", "colour"]
AFFINE_FAULTS = ["placeless", "singular", "mirrored", "unit"]


@pytest.mark.parametrize("fault", FORMAT_FAULTS + AFFINE_FAULTS)
def test_fault_is_one_clear_error(tmp_path: Path, fault: str) -> None:
    path, text = bad_files(tmp_path)[fault]
    with pytest.raises(InputError) as error:
        read_volume(path)
    assert text in str(error.value)
    assert str(path) in str(error.value)
    assert error.value.remedy


@pytest.mark.parametrize(
    ("dtype", "stored"), [(np.int64, np.int32), (np.uint64, np.int32), (np.float16, np.float32), (np.bool_, np.uint8)]
)
def test_types_that_few_readers_know_are_stored_as_others(tmp_path: Path, dtype: type, stored: type) -> None:
    data = (np.arange(60).reshape(3, 4, 5) % 6).astype(dtype)
    write_volume(tmp_path / "labels.nii.gz", Volume(data, np.diag([0.001, 0.001, 0.001, 1.0])))
    back = sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / "labels.nii.gz"))).T
    assert back.dtype == stored
    np.testing.assert_array_equal(back, data.astype(stored))


def test_a_name_that_no_nifti_file_bears_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"does not end in \.nii or \.nii\.gz"):
        write_volume(tmp_path / "warped.nrrd", Volume(np.ones((3, 3, 3)), np.diag([0.001, 0.001, 0.001, 1.0])))
    assert not list(tmp_path.iterdir())


def test_linear_resampling_is_exact_for_a_linear_image() -> None:
    coefficients = np.array([3.0, -2.0, 5.0])
    T = np.diag([0.002, 0.002, 0.002, 1.0])
    data = transform_points(T, np.moveaxis(np.indices((12, 12, 12)), 0, -1)) @ coefficients
    T_fine = np.diag([-0.001, 0.001, 0.001, 1.0])
    T_fine[:3, 3] = [0.02, 0.003, 0.001]
    fine = resample(Volume(data, T), Volume(np.zeros((15, 16, 17)), T_fine), "linear")
    points = transform_points(T_fine, np.moveaxis(np.indices((15, 16, 17)), 0, -1))
    np.testing.assert_allclose(fine.data, points @ coefficients, atol=1e-6)
    np.testing.assert_allclose(sample(Volume(data, T), points), points @ coefficients, atol=1e-12)


def test_nearest_resampling_never_makes_new_labels() -> None:
    labels = Volume(np.random.default_rng(0).choice([0, 2, 5], (9, 9, 9)).astype(np.uint8), np.eye(4) * 0.003)
    turned = np.eye(4)
    turned[:3, :3] = 0.001 * Rotation.from_euler("z", 30, degrees=True).as_matrix()
    moved = resample(labels, Volume(np.zeros((20, 20, 20)), turned), "nearest")
    assert moved.data.dtype == np.uint8
    assert set(np.unique(moved.data)) <= {0, 2, 5}
