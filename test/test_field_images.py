"""Warped images and transform files against SimpleITK, for every axis orientation."""

from __future__ import annotations

import itertools

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from field_cases import ellipsoid_mesh, smooth_field
from scipy import ndimage
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.warp import resample_through, warp_image
from brainshift_ros.image.grid import Grid, trilinear
from brainshift_ros.image.io import write_volume
from brainshift_ros.image.itk import read_displacement_image, write_displacement_image
from brainshift_ros.image.volume import Volume

MESH = ellipsoid_mesh(8)
DEFORMATION = Deformation(smooth_field(MESH), spacing=0.004)
ORIENTATIONS = [(p, s) for p in itertools.permutations(range(3)) for s in itertools.product([1, -1], repeat=3)]
OBLIQUE = Rotation.from_euler("xyz", [20, -15, 35], degrees=True).as_matrix()


def oriented_grid(permutation, signs, rotation=None, shape=(18, 20, 22), edges=(0.009, 0.008, 0.007)):
    axes = np.zeros((3, 3))
    axes[list(permutation), range(3)] = np.array(signs) * edges
    if rotation is not None:
        axes = rotation @ axes
    T = np.eye(4)
    T[:3, :3] = axes
    T[:3, 3] = [0.002, -0.003, 0.001] - axes @ ((np.array(shape) - 1) / 2.0)
    return Grid(shape, T)


def centres(grid):
    return grid.centres(np.moveaxis(np.indices(grid.shape), 0, -1))


def blob(grid, at=(0.015, 0.02, 0.01), width=0.012):
    return np.exp(-((centres(grid) - at) ** 2).sum(axis=-1) / (2 * width**2))


def asymmetric_image(grid):
    image = 100 * blob(grid) + 60 * blob(grid, (-0.02, 0.0, 0.015), 0.008) + 30 * blob(grid, (0.0, -0.03, -0.01), 0.015)
    return Volume(image.astype(np.float32), grid.T_patient_voxel)


def read_transform(path):
    return sitk.DisplacementFieldTransform(sitk.Cast(sitk.ReadImage(str(path)), sitk.sitkVectorFloat64))


def moved_by(path, points):
    """Points of the patient frame, moved by ITK with a transform file."""
    transform, lps_mm = read_transform(path), np.array([-1000.0, -1000.0, 1000.0])
    return np.array([transform.TransformPoint(p) for p in (points * lps_mm).tolist()]) / lps_mm


def name_of(value):
    return "".join("+" if x == 1 else "-" if x == -1 else str(x) for x in value)


@pytest.mark.parametrize("rotation", [None, OBLIQUE], ids=["aligned", "oblique"])
@pytest.mark.parametrize(("permutation", "signs"), ORIENTATIONS, ids=name_of)
def test_simpleitk_resamples_to_the_same_image_with_our_file(tmp_path, permutation, signs, rotation):
    grid = oriented_grid(permutation, signs, rotation)
    image = asymmetric_image(grid)
    warped = warp_image(DEFORMATION, image)
    write_volume(tmp_path / "image.nii.gz", image)
    write_displacement_image(tmp_path / "transform.nii.gz", warped.inverse, warped.grid)
    moving = sitk.ReadImage(str(tmp_path / "image.nii.gz"))
    resampled = sitk.Resample(moving, moving, read_transform(tmp_path / "transform.nii.gz"), sitk.sitkLinear, 0.0)
    theirs = sitk.GetArrayFromImage(resampled).T
    np.testing.assert_allclose(warped.volume.data, theirs, atol=5e-3)
    assert np.abs(warped.volume.data - image.data).max() > 10.0, "the case must move something"


@pytest.mark.parametrize(
    ("permutation", "signs", "rotation"),
    [*((permutation, signs, None) for permutation, signs in ORIENTATIONS), ((1, 2, 0), (-1, 1, -1), OBLIQUE)],
    ids=lambda value: "" if value is None else "oblique" if value is OBLIQUE else name_of(value),
)
def test_simpleitk_moves_points_as_we_do(tmp_path, permutation, signs, rotation):
    grid = oriented_grid(permutation, signs, rotation, shape=(17, 18, 19), edges=(0.003, 0.003, 0.003))
    points = np.random.default_rng(0).uniform(-0.012, 0.012, (30, 3))
    now = points + DEFORMATION.forward_at(points)
    inverse = DEFORMATION.inverse_on(grid)
    write_displacement_image(tmp_path / "inverse.nii", inverse, grid)
    back = moved_by(tmp_path / "inverse.nii", now)
    np.testing.assert_allclose(back, now + trilinear(inverse, grid.to_voxels(now)), atol=2e-6)  # the file holds 1 um steps
    assert np.linalg.norm(back - points, axis=1).max() < 5e-5  # and the exact map, which its voxels sample


def test_the_forward_transform_moves_points_too(tmp_path):
    grid = oriented_grid((1, 2, 0), (-1, 1, -1), OBLIQUE, shape=(25, 25, 25), edges=(0.003, 0.003, 0.003))
    points = np.random.default_rng(0).uniform(-0.018, 0.018, (50, 3))
    write_displacement_image(tmp_path / "forward.nii", DEFORMATION.forward_on(grid), grid)
    error = moved_by(tmp_path / "forward.nii", points) - points - DEFORMATION.forward_at(points)
    assert np.linalg.norm(error, axis=1).max() < 5e-5


def test_scipy_resamples_to_the_same_image():
    # ITK makes our images, so another interpolator has to agree as well.
    image = asymmetric_image(oriented_grid((0, 1, 2), (-1, 1, 1)))
    target = oriented_grid((2, 1, 0), (1, -1, 1), OBLIQUE, shape=(25, 24, 23), edges=(0.006, 0.006, 0.006))
    warped = warp_image(DEFORMATION, image, grid=target)
    voxels = Grid.of(image).to_voxels(centres(target) + warped.inverse)
    theirs = ndimage.map_coordinates(image.data, np.moveaxis(voxels, -1, 0), order=1, mode="nearest")
    inside = ((voxels > 0) & (voxels < np.array(image.shape) - 1)).all(axis=-1)
    np.testing.assert_allclose(warped.volume.data[inside], theirs[inside], atol=1e-3)
    assert inside.mean() > 0.3


@pytest.mark.parametrize(
    ("shift_mm", "letters"), [((-6.0, 0.0, 0.0), "left"), ((0.0, -6.0, 0.0), "posterior"), ((0.0, 0.0, 6.0), "superior")]
)
def test_a_blob_moves_with_the_tissue(shift_mm, letters):
    shift = np.array(shift_mm) / 1000
    field = DisplacementField(MESH, np.tile(shift, (len(MESH.nodes), 1)), np.zeros(len(MESH.nodes)), {})
    grid = oriented_grid((2, 0, 1), (1, -1, -1), OBLIQUE, shape=(44, 46, 48), edges=(0.003, 0.003, 0.003))
    image = Volume(blob(grid, (0.005, 0.0, 0.005), 0.006).astype(np.float32), grid.T_patient_voxel)
    warped = warp_image(Deformation(field, spacing=0.004), image).volume

    def centroid(volume):
        return (centres(grid) * volume.data[..., None]).sum(axis=(0, 1, 2)) / volume.data.sum()

    np.testing.assert_allclose(centroid(warped) - centroid(image), shift, atol=5e-5, err_msg=letters)


def test_an_image_lands_on_any_grid_as_simpleitk_says(tmp_path):
    image = asymmetric_image(oriented_grid((0, 1, 2), (-1, 1, 1)))
    target = oriented_grid((2, 1, 0), (1, -1, 1), OBLIQUE, shape=(25, 24, 23), edges=(0.006, 0.006, 0.006))
    warped = warp_image(DEFORMATION, image, grid=target)
    assert warped.volume.shape == target.shape
    write_volume(tmp_path / "image.nii.gz", image)
    write_volume(tmp_path / "target.nii.gz", Volume(np.ones(target.shape, np.float32), target.T_patient_voxel))
    write_displacement_image(tmp_path / "t.nii.gz", warped.inverse, target)
    moving, reference = sitk.ReadImage(str(tmp_path / "image.nii.gz")), sitk.ReadImage(str(tmp_path / "target.nii.gz"))
    theirs = sitk.Resample(moving, reference, read_transform(tmp_path / "t.nii.gz"), sitk.sitkLinear, 0.0)
    np.testing.assert_allclose(warped.volume.data, sitk.GetArrayFromImage(theirs).T, atol=5e-3)


def test_labels_stay_labels_and_integers_are_rounded():
    grid = oriented_grid((0, 1, 2), (1, 1, 1))
    labels = Volume((asymmetric_image(grid).data > 20).astype(np.uint8) * 5, grid.T_patient_voxel)
    for interpolation in ("nearest", "labels"):
        warped = warp_image(DEFORMATION, labels, interpolation=interpolation).volume.data
        assert warped.dtype == np.uint8
        assert set(np.unique(warped)) == {0, 5}
    intensities = asymmetric_image(grid)
    whole = Volume(intensities.data.astype(np.int16), grid.T_patient_voxel)
    linear = warp_image(DEFORMATION, whole).volume.data
    assert linear.dtype == np.int16
    exact = warp_image(DEFORMATION, Volume(whole.data.astype(np.float64), grid.T_patient_voxel)).volume.data
    np.testing.assert_array_equal(linear, np.rint(exact))  # ITK alone cuts the fractions off: half a level too dark


def test_edges_of_labels_are_smoother_than_those_of_the_nearest_voxel():
    grid = oriented_grid((0, 1, 2), (1, 1, 1), shape=(40, 40, 40), edges=(0.002, 0.002, 0.002))
    x = centres(grid)

    def ball(at):
        inside = np.linalg.norm(x - at, axis=-1) < 0.03
        return np.where(inside, np.where(x[..., 0] > at[0], 2, 1), 0).astype(np.uint8)

    shift = np.array([0.0009, -0.0007, 0.0006])
    still = np.broadcast_to(-shift, (*grid.shape, 3)).astype(np.float32)
    wrong = {
        interpolation: np.count_nonzero(
            resample_through(Volume(ball(0 * shift), grid.T_patient_voxel), still, grid, interpolation).data != ball(shift)
        )
        for interpolation in ("nearest", "labels")
    }
    assert wrong["labels"] < 0.6 * wrong["nearest"]


def test_labels_between_voxels_are_those_of_itk(tmp_path):
    grid = oriented_grid((1, 0, 2), (1, -1, 1), OBLIQUE)
    regions = np.random.default_rng(0).integers(0, 40, (6, 7, 8)).astype(np.int16)
    blocks = np.kron(regions, np.ones((3, 3, 3), np.int16))[: grid.shape[0], : grid.shape[1], : grid.shape[2]]
    labels = Volume(blocks, grid.T_patient_voxel)
    warped = warp_image(DEFORMATION, labels, interpolation="labels")
    write_volume(tmp_path / "labels.nii", labels)
    write_displacement_image(tmp_path / "t.nii", warped.inverse, grid)
    moving = sitk.ReadImage(str(tmp_path / "labels.nii"))
    theirs = sitk.Resample(moving, moving, read_transform(tmp_path / "t.nii"), sitk.sitkLabelLinear, 0.0)
    same = warped.volume.data == sitk.GetArrayFromImage(theirs).T
    assert (~same).mean() < 2e-3  # ties, and edges of the image
    assert np.mean(warped.volume.data != labels.data) > 0.03


@pytest.mark.parametrize("dtype", [np.bool_, np.uint8, np.int16, np.dtype(">i2"), np.uint16, np.int32, np.int64, np.float16,
                                   np.float32, np.float64])  # fmt: skip
@pytest.mark.parametrize("order", ["C", "F"])
def test_images_of_any_type_and_memory_layout_are_warped_alike(dtype, order):
    grid = oriented_grid((1, 0, 2), (1, -1, 1), OBLIQUE)
    data = (asymmetric_image(grid).data > 30).astype(dtype, order=order)
    inverse = np.full((*grid.shape, 3), 0.008, np.float32)
    warped = resample_through(Volume(data, grid.T_patient_voxel), inverse, grid, "nearest").data
    expected = resample_through(Volume(data.astype(np.float32), grid.T_patient_voxel), inverse, grid, "nearest").data
    assert warped.dtype == dtype
    np.testing.assert_array_equal(warped.astype(np.float32), expected)
    assert expected.any()


def test_a_sheared_image_is_warped_as_scipy_does():
    grid = oriented_grid((0, 1, 2), (1, 1, 1))
    grid.T_patient_voxel[0, 1] += 0.003
    image = asymmetric_image(grid)
    warped = warp_image(DEFORMATION, image)
    voxels = np.moveaxis(grid.to_voxels(centres(grid) + warped.inverse), -1, 0)
    theirs = ndimage.map_coordinates(image.data, voxels, order=1, mode="nearest")
    inner = (slice(2, -2),) * 3
    np.testing.assert_allclose(warped.volume.data[inner], theirs[inner], atol=1e-2)


def test_no_shift_changes_nothing():
    still = DisplacementField(MESH, np.zeros_like(MESH.nodes), np.zeros(len(MESH.nodes)), {})
    image = asymmetric_image(oriented_grid((1, 0, 2), (1, -1, 1), OBLIQUE))
    warped = warp_image(Deformation(still), image)
    np.testing.assert_allclose(warped.volume.data, image.data, rtol=1e-5)
    assert warped.warnings == ("the image shows nothing that moved",)


def test_what_lies_outside_the_image_is_zero():
    image = Volume(np.ones((4, 4, 4), np.float32), np.diag([0.01, 0.01, 0.01, 1.0]))
    inverse = np.zeros((4, 4, 4, 3), np.float32)
    inverse[..., 0] = 0.012
    out = resample_through(image, inverse, Grid.of(image)).data
    np.testing.assert_array_equal(out[:, 0, 0], [1.0, 1.0, 1.0, 0.0])
    nothing = Volume(np.zeros((4, 4, 4), np.int16), image.T_patient_voxel)
    assert not resample_through(nothing, inverse, Grid.of(image)).data.any()
    inverse[..., 0] = 1.0  # everything is now far beyond the grid
    assert not resample_through(image, inverse, Grid.of(image)).data.any()


def test_the_transform_file_is_what_itk_tools_expect(tmp_path):
    grid = oriented_grid((0, 1, 2), (-1, 1, 1), OBLIQUE)
    vectors = DEFORMATION.inverse_on(grid)
    write_displacement_image(tmp_path / "t.nii.gz", vectors, grid)
    image = nib.load(tmp_path / "t.nii.gz")
    assert image.shape == (*grid.shape, 1, 3)
    assert int(image.header["intent_code"]) == 1007
    assert image.header.get_xyzt_units()[0] == "mm"
    again, grid_again = read_displacement_image(tmp_path / "t.nii.gz")
    np.testing.assert_allclose(again, vectors, atol=5e-7)  # a thousandth of a millimetre is kept
    np.testing.assert_allclose(grid_again.T_patient_voxel, grid.T_patient_voxel, atol=1e-8)


def test_itk_cannot_hold_sheared_grids(tmp_path):
    grid = oriented_grid((0, 1, 2), (1, 1, 1))
    grid.T_patient_voxel[0, 1] += 0.002
    with pytest.raises(InputError, match="right angles"):
        write_displacement_image(tmp_path / "t.nii.gz", np.zeros((*grid.shape, 3)), grid)
    assert list(tmp_path.iterdir()) == []


def test_other_files_are_no_transforms(tmp_path):
    (tmp_path / "text.nii.gz").write_text("hello")
    with pytest.raises(InputError, match="not a readable NIfTI"):
        read_displacement_image(tmp_path / "text.nii.gz")
    write_volume(tmp_path / "scalar.nii.gz", Volume(np.ones((3, 3, 3), np.float32), np.diag([1e-3, 1e-3, 1e-3, 1.0])))
    with pytest.raises(InputError, match=r"not \(I, J, K, 1, 3\)"):
        read_displacement_image(tmp_path / "scalar.nii.gz")
