"""Rasterised meshes, forward and inverse maps, Jacobians: against VTK, analytic maps and each other."""

from __future__ import annotations

import numpy as np
import pytest
import pyvista as pv
from field_cases import SEMI_AXES, box_mesh, ellipsoid_mesh, smooth_field, split_box, tet_mesh
from scipy import ndimage
from scipy.spatial.transform import Rotation

from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.jacobian import jacobian_of_elements
from brainshift_ros.field.raster import draw, rasterise
from brainshift_ros.image.grid import Grid, trilinear
from brainshift_ros.mesh.locate import PointLocator

MESH = ellipsoid_mesh(10)


def oblique_grid(shape=(40, 36, 44), edges=(0.003, 0.0035, 0.003), shear=0.0, mirror=False):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [20, -15, 35], degrees=True).as_matrix() @ np.diag(edges)
    T[0, 1] += shear
    if mirror:
        T[:3, 0] *= -1.0
    T[:3, 3] = -T[:3, :3] @ ((np.array(shape) - 1) / 2.0)
    return Grid(shape, T)


def field_of(mesh, u):
    return DisplacementField(mesh, u, np.zeros(len(u)), {})


@pytest.mark.parametrize(
    "grid", [oblique_grid(), oblique_grid(mirror=True), oblique_grid(shear=0.001)], ids=["oblique", "mirror", "shear"]
)
def test_raster_finds_what_point_location_finds(grid):
    owner = rasterise(MESH.nodes, MESH.elements, grid)
    indices = np.moveaxis(np.indices(grid.shape), 0, -1)
    located = PointLocator(MESH).locate(grid.centres(indices).reshape(-1, 3))
    np.testing.assert_array_equal((owner >= 0).ravel(), located.inside)
    drawn = np.full((*grid.shape, 3), 7.0, np.float32)
    draw(MESH.nodes, MESH.elements, np.sin(40 * MESH.nodes), grid, drawn)
    values = drawn.reshape(-1, 3)
    expected = located.interpolate(MESH, np.sin(40 * MESH.nodes))
    np.testing.assert_allclose(values[located.inside], expected[located.inside], atol=1e-6)
    assert (values[~located.inside] == 7.0).all()


def test_raster_agrees_with_vtks_probe():
    grid = oblique_grid((30, 30, 30), (0.004, 0.004, 0.004))
    owner = rasterise(MESH.nodes, MESH.elements, grid)
    source = pv.UnstructuredGrid({pv.CellType.TETRA: MESH.elements.astype(np.int64)}, grid.to_voxels(MESH.nodes))
    source.cell_data["element"] = np.arange(len(MESH.elements))
    probed = pv.ImageData(dimensions=grid.shape).sample(source)
    shape = grid.shape[::-1]
    inside = probed["vtkValidPointMask"].reshape(shape).T.astype(bool)
    assert inside[owner >= 0].all()
    assert (inside & (owner < 0)).mean() < 1e-3  # VTK's tolerance is wider
    both = inside & (owner >= 0)
    same = owner == probed["element"].reshape(shape).T
    assert np.mean(same[both]) > 0.99  # the rest lie on faces


def test_voxels_on_faces_and_nodes_leave_no_gap():
    mesh = box_mesh((4, 4, 4), (0, 0, 0), (0.008, 0.008, 0.008))
    T = np.diag([0.001, 0.001, 0.001, 1.0])  # voxel centres fall on nodes, edges and faces
    assert (rasterise(mesh.nodes, mesh.elements, Grid((9, 9, 9), T)) >= 0).all()


def test_a_mesh_outside_the_grid_and_flat_elements_draw_nothing():
    mesh = box_mesh((1, 1, 1), (0, 0, 0), (0.01, 0.01, 0.01))
    far = Grid((5, 5, 5), np.array([[1e-3, 0, 0, 0.5], [0, 1e-3, 0, 0], [0, 0, 1e-3, 0], [0, 0, 0, 1.0]]))
    assert (rasterise(mesh.nodes, mesh.elements, far) == -1).all()
    flat = tet_mesh(mesh.nodes, np.array([[0, 1, 2, 2], [0, 0, 0, 0]]))
    assert (rasterise(flat.nodes, flat.elements, Grid((9, 9, 9), np.diag([0.001, 0.001, 0.001, 1.0]))) == -1).all()


@pytest.mark.parametrize("shape", [(6, 7, 8), (6, 1, 8), (1, 1, 1)])
def test_trilinear_agrees_with_scipy(shape):
    rng = np.random.default_rng(0)
    image = rng.normal(size=(*shape, 2)).astype(np.float32)
    voxels = rng.uniform(-2, 9, (300, 3))
    expected = [ndimage.map_coordinates(image[..., c], voxels.T, order=1, mode="nearest") for c in range(2)]
    np.testing.assert_allclose(trilinear(image, voxels), np.stack(expected, axis=1), atol=2e-6)


def test_an_affine_map_inverts_exactly():
    # u(x) = (A - I) x + t on the mesh; inverse displacement at y is A^-1 (y - t) - y.
    A = np.eye(3) + np.array([[0.02, 0.05, 0.0], [-0.03, -0.04, 0.02], [0.0, 0.06, 0.03]])
    t = np.array([0.002, -0.004, 0.003])
    deformation = Deformation(field_of(MESH, MESH.nodes @ (A - np.eye(3)).T + t), spacing=0.004)
    grid = oblique_grid()
    inverse = deformation.inverse_on(grid)
    y = grid.centres(np.moveaxis(np.indices(grid.shape), 0, -1))
    expected = (y - t) @ np.linalg.inv(A).T - y
    now_in_brain = rasterise(deformation.deformed_nodes, MESH.elements, grid) >= 0
    np.testing.assert_allclose(inverse[now_in_brain], expected[now_in_brain], atol=1e-8)
    np.testing.assert_allclose(jacobian_of_elements(deformation.field), np.linalg.det(A), rtol=1e-9)
    inside = MESH.nodes[MESH.elements].mean(axis=1) @ A.T + t
    np.testing.assert_allclose(deformation.inverse_at(inside), (inside - t) @ np.linalg.inv(A).T - inside, atol=1e-15)


def test_forward_after_inverse_is_identity_inside_and_around():
    field = smooth_field(MESH)
    deformation = Deformation(field, spacing=0.003)
    grid = oblique_grid((60, 60, 60), (0.004, 0.004, 0.004))
    inverse = deformation.inverse_on(grid).reshape(-1, 3)
    y = grid.centres(np.moveaxis(np.indices(grid.shape), 0, -1)).reshape(-1, 3)
    x = y + inverse
    error = np.linalg.norm(x + deformation.forward_at(x) - y, axis=1)
    brain = rasterise(deformation.deformed_nodes, MESH.elements, grid).ravel() >= 0
    assert error[brain].max() < 1e-7
    assert error[~brain].max() < 5e-4  # the extension is interpolated between 3 mm voxels
    assert error[~brain].mean() < 3e-5
    exact = deformation.inverse_at(y)
    error = np.linalg.norm(exact + deformation.forward_at(y + exact), axis=1)
    assert error[brain].max() < 1e-12
    assert np.percentile(error[~brain], 99) < 1e-6  # but where the coarse surroundings and the mesh meet


def test_the_field_continues_smoothly_and_fades_without_folding():
    field = smooth_field(MESH, size=0.015)
    deformation = Deformation(field, spacing=0.003)
    ray = np.array([0.0, 1.0, 0.0]) * np.linspace(0.9, 1.0, 200)[:, None] * SEMI_AXES[1]
    beyond = np.array([0.0, 1.0, 0.0]) * np.linspace(1.0, 3.0, 400)[:, None] * SEMI_AXES[1]
    u = deformation.forward_at(np.concatenate([ray, beyond]))
    steps = np.linalg.norm(np.diff(u, axis=0), axis=1)
    assert steps[:199].max() < 1e-4
    assert steps.max() < 5e-4  # no jump where the mesh ends
    assert not u[-20:].any()
    far = deformation.forward_at(np.array([[0.4, 0.0, 0.0], [0.0, -0.5, 0.0]]))
    assert not far.any()


def test_a_slip_along_the_septum_stays_on_its_sides():
    mesh, left_nodes = split_box()
    u = np.zeros_like(mesh.nodes)
    u[:left_nodes, 1] = 0.004  # the left half slides forward, the right one stays
    deformation = Deformation(field_of(mesh, u), spacing=0.004)
    points = np.array([[-1e-4, 0.0, 0.0], [1e-4, 0.0, 0.0], [-0.02, 0.01, 0.01], [0.02, 0.01, 0.01]])
    np.testing.assert_allclose(deformation.forward_at(points)[:, 1], [0.004, 0.0, 0.004, 0.0], atol=1e-12)
    T = np.diag([0.001, 0.001, 0.001, 1.0])
    T[:3, 3] = [-0.0205, -0.02, -0.02]  # no voxel centre on the sheet itself
    grid = Grid((42, 41, 41), T)
    inverse = deformation.inverse_on(grid)
    np.testing.assert_allclose(inverse[:21, :, :, 1], -0.004, atol=1e-8)
    np.testing.assert_allclose(inverse[21:, :, :, 1], 0.0, atol=1e-8)


def test_folds_are_counted():
    mesh = box_mesh((3, 3, 3), (-0.03, -0.03, -0.03), (0.03, 0.03, 0.03))
    u = np.zeros_like(mesh.nodes)
    u[np.argmin(np.linalg.norm(mesh.nodes - [0.01, 0.01, 0.01], axis=1))] = [-0.04, 0.0, 0.0]
    ratio = jacobian_of_elements(field_of(mesh, u))
    assert 0 < np.count_nonzero(ratio <= 0.0) < len(ratio)
    assert np.nanmax(ratio) > 1.0


def test_the_map_does_not_depend_on_the_image_grid():
    deformation = Deformation(smooth_field(MESH), spacing=0.003)
    coarse = Grid((12, 12, 12), np.array([[0.012, 0, 0, -0.066], [0, 0.012, 0, -0.066], [0, 0, 0.012, -0.066], [0, 0, 0, 1.0]]))
    fine = Grid((23, 23, 23), coarse.T_patient_voxel @ np.diag([0.5, 0.5, 0.5, 1.0]))
    difference = np.linalg.norm(deformation.inverse_on(fine)[::2, ::2, ::2] - deformation.inverse_on(coarse), axis=-1)
    brain = rasterise(deformation.deformed_nodes, MESH.elements, coarse) >= 0
    assert difference[brain].max() < 1e-7
    assert difference[~brain].max() < 1e-4
