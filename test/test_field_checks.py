"""Checks of a map: Jacobians against SimpleITK and analytic maps, errors against maps whose errors are known."""

from __future__ import annotations

import json

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from field_cases import box_mesh, ellipsoid_mesh, smooth_field, split_box
from scipy.spatial.transform import Rotation

from brainshift_ros.field.checks import check_map
from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.jacobian import jacobian_of_cells
from brainshift_ros.image.grid import Grid

MESH = ellipsoid_mesh(8)


def field_of(mesh, u):
    return DisplacementField(mesh, u, np.zeros(len(u)), {})


def cube_grid(count, edge, rotation=None):
    T = np.eye(4)
    T[:3, :3] = edge * (np.eye(3) if rotation is None else rotation)
    T[:3, 3] = -T[:3, :3] @ np.full(3, (count - 1) / 2.0) + 1e-5  # no voxel centre on a sheet
    return Grid((count, count, count), T)


def checked(deformation, grid):
    inverse = deformation.inverse_on(grid)
    return check_map(deformation, inverse, grid, deformation.owner_now(grid))


def test_cells_of_an_affine_map_have_its_determinant_on_any_grid():
    A = np.array([[0.1, 0.3, -0.2], [0.0, -0.2, 0.4], [0.2, 0.1, 0.05]])
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [20, -15, 35], degrees=True).as_matrix() @ [
        [-0.002, 0.001, 0.0],
        [0.0, 0.003, 0.0],
        [0.0, 0.0, 0.004],
    ]
    grid = Grid((6, 7, 8), T)
    vectors = (grid.centres(np.moveaxis(np.indices(grid.shape), 0, -1)) @ A.T).astype(np.float32)
    np.testing.assert_allclose(jacobian_of_cells(vectors, grid), np.linalg.det(np.eye(3) + A), rtol=1e-4)


def test_cells_agree_with_simpleitk_on_a_smooth_map():
    grid = cube_grid(30, 0.002)
    x = grid.centres(np.moveaxis(np.indices(grid.shape), 0, -1))
    vectors = (0.004 * np.sin(40.0 * x @ np.array([[1, 0.5, 0], [0, 1, -0.5], [0.5, 0, 1.0]]))).astype(np.float32)
    # ITK's axes are the array's in reverse order, and its central differences sit at voxels rather than in cells.
    image = sitk.GetImageFromArray(np.ascontiguousarray(vectors.transpose(2, 1, 0, 3)), isVector=True)
    image.SetSpacing([0.002] * 3)
    theirs = sitk.GetArrayFromImage(sitk.DisplacementFieldJacobianDeterminant(image)).T
    in_cells = np.mean([theirs[a : 29 + a, b : 29 + b, c : 29 + c] for a in (0, 1) for b in (0, 1) for c in (0, 1)], axis=0)
    ours = jacobian_of_cells(vectors, grid)
    assert np.ptp(in_cells) > 0.4
    np.testing.assert_allclose(ours[2:-2, 2:-2, 2:-2], in_cells[2:-2, 2:-2, 2:-2], atol=0.05)


def test_a_fold_as_thin_as_a_voxel_is_seen():
    grid = cube_grid(9, 0.001)
    vectors = np.zeros((9, 9, 9, 3), np.float32)
    vectors[4, :, :, 0] = 0.0011  # this plane overtakes the next
    cells = jacobian_of_cells(vectors, grid)
    assert (cells[4] < 0.0).all()
    np.testing.assert_allclose(cells[[0, 1, 2, 6, 7]], 1.0, rtol=1e-5)


def test_a_smooth_shift_passes():
    field = smooth_field(MESH)
    checks = checked(Deformation(field), cube_grid(50, 0.003))
    assert checks.warnings == ()
    assert checks.largest_shift == pytest.approx(np.linalg.norm(field.displacement, axis=1).max())
    assert checks.folded_elements == checks.folded_cells == 0
    assert min(checks.jacobian_brain, checks.jacobian_around, checks.jacobian_image) > 0.3
    assert checks.inverse_brain.largest < 1e-6
    assert checks.inverse_around.p95 < 2e-4
    assert checks.sampling_brain.p95 < 5e-5
    assert checks.sampling_brain.mean < checks.sampling_sheets.mean < 1e-3
    text = json.dumps(checks.to_json(), allow_nan=False)
    assert json.loads(text)["sampling_error"]["brain"]["max_mm"] == pytest.approx(1e3 * checks.sampling_brain.largest)


def test_a_slip_is_exact_but_no_file_can_hold_it():
    mesh, left_nodes = split_box(n=3)
    u = np.zeros_like(mesh.nodes)
    u[:left_nodes, 1] = 0.006
    checks = checked(Deformation(field_of(mesh, u)), cube_grid(40, 0.003))
    assert checks.inverse_brain.largest < 1e-6  # at voxel centres
    assert checks.sampling_brain.largest < 1e-6  # between them, away from the sheet
    assert 1.5e-3 < checks.sampling_sheets.largest < 6e-3  # up to half the slip, and more at a corner
    assert checks.sampling_sheets.mean > 1e-4
    assert checks.jacobian_brain == pytest.approx(1.0)
    assert checks.folded_cells == checks.folded_cells_at_sheets
    assert checks.folded_cells_around == 0
    assert checks.warnings == ()


def test_a_shift_that_folds_the_brain_is_said():
    mesh = box_mesh((3, 3, 3), (-0.03, -0.03, -0.03), (0.03, 0.03, 0.03))
    u = np.zeros_like(mesh.nodes)
    u[np.argmin(np.linalg.norm(mesh.nodes - [0.01, 0.01, 0.01], axis=1))] = [-0.04, 0.0, 0.0]
    checks = checked(Deformation(field_of(mesh, u)), cube_grid(20, 0.006))
    assert checks.folded_elements > 0
    assert checks.jacobian_brain < 0.0
    assert checks.jacobian_around > 0.0
    assert f"turns {checks.folded_elements} of the mesh's 162 elements inside out" in checks.warnings[0]


def test_an_image_beside_the_brain_has_nothing_to_check():
    far = cube_grid(6, 0.003)
    far.T_patient_voxel[:3, 3] += 0.5
    checks = checked(Deformation(smooth_field(MESH)), far)
    assert checks.inverse_brain.largest == checks.inverse_around.largest == checks.sampling_brain.largest == 0.0
    assert checks.jacobian_image == pytest.approx(1.0)
