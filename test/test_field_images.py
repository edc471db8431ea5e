"""Warped images and transform files against SimpleITK, for every axis orientation."""

from __future__ import annotations

import itertools

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from field_cases import ellipsoid_mesh, smooth_field
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.warp import resample_through, warp_image, warp_surface
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.io import write_volume
from brainshift_ros.image.itk import read_displacement_image, write_displacement_image
from brainshift_ros.image.volume import Volume
from brainshift_ros.mesh.nearest import boundary_faces
from brainshift_ros.surface.surface import Surface

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


@pytest.mark.parametrize("rotation", [None, OBLIQUE], ids=["aligned", "oblique"])
@pytest.mark.parametrize(
    ("permutation", "signs"), ORIENTATIONS, ids=lambda v: "".join("+" if x == 1 else "-" if x == -1 else str(x) for x in v)
)
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


@pytest.mark.parametrize("rotation", [None, OBLIQUE], ids=["aligned", "oblique"])
def test_simpleitk_moves_points_as_we_do(tmp_path, rotation):
    grid = oriented_grid((1, 2, 0), (-1, 1, -1), rotation, shape=(60, 60, 60), edges=(0.003, 0.003, 0.003))
    points = np.random.default_rng(0).uniform(-0.025, 0.025, (50, 3))
    now = points + DEFORMATION.forward_at(points)
    lps_mm = np.array([-1000.0, -1000.0, 1000.0])
    write_displacement_image(tmp_path / "inverse.nii.gz", DEFORMATION.inverse_on(grid), grid)
    inverse = read_transform(tmp_path / "inverse.nii.gz")
    back = np.array([inverse.TransformPoint(p) for p in (now * lps_mm).tolist()]) / lps_mm
    np.testing.assert_allclose(back, points, atol=5e-5)
    write_displacement_image(tmp_path / "forward.nii.gz", DEFORMATION.forward_on(grid), grid)
    forward = read_transform(tmp_path / "forward.nii.gz")
    there = np.array([forward.TransformPoint(p) for p in (points * lps_mm).tolist()]) / lps_mm
    np.testing.assert_allclose(there, now, atol=5e-5)


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


def test_labels_stay_labels_and_integers_stay_integers():
    grid = oriented_grid((0, 1, 2), (1, 1, 1))
    labels = Volume((asymmetric_image(grid).data > 20).astype(np.uint8) * 5, grid.T_patient_voxel)
    warped = warp_image(DEFORMATION, labels, interpolation="nearest").volume.data
    assert warped.dtype == np.uint8
    assert set(np.unique(warped)) == {0, 5}
    intensities = Volume(asymmetric_image(grid).data.astype(np.int16), grid.T_patient_voxel)
    linear = warp_image(DEFORMATION, intensities).volume.data
    assert linear.dtype == np.int16
    assert len(np.unique(linear)) > 10


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


def test_surfaces_move_with_the_tissue():
    faces, _ = boundary_faces(MESH.elements)
    moved = warp_surface(DEFORMATION, Surface(MESH.nodes * 0.999, faces.astype(np.int32)))
    outer = np.unique(faces)
    np.testing.assert_allclose(moved.vertices[outer], DEFORMATION.deformed_nodes[outer], atol=2e-4)


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
