"""Point location against SciPy's Delaunay search, VTK's closest points and analytic cases."""

from __future__ import annotations

import numpy as np
import pytest
import pyvista as pv
from field_cases import box_mesh, ellipsoid_mesh, split_box, tet_mesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.mesh.nearest import boundary_faces, nearest_on_triangles


def delaunay_mesh(seed, count=60):
    triangulation = Delaunay(np.random.default_rng(seed).uniform(-0.05, 0.05, (count, 3)))
    mesh = tet_mesh(triangulation.points, triangulation.simplices)
    return triangulation, mesh


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_agrees_with_scipys_delaunay_search(seed):
    triangulation, mesh = delaunay_mesh(seed)
    points = np.random.default_rng(seed + 1).uniform(-0.06, 0.06, (300, 3))
    located = PointLocator(mesh).locate(points)
    expected = triangulation.find_simplex(points)
    np.testing.assert_array_equal(located.inside, expected >= 0)
    np.testing.assert_array_equal(located.element, expected)
    np.testing.assert_allclose(located.interpolate(mesh, mesh.nodes)[located.inside], points[located.inside], atol=1e-12)


def test_every_node_edge_and_face_centre_is_inside():
    mesh = ellipsoid_mesh(6)
    faces = mesh.elements[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3)
    points = np.concatenate([mesh.nodes, mesh.nodes[faces].mean(axis=1), mesh.nodes[faces[:, :2]].mean(axis=1)])
    located = PointLocator(mesh).locate(points)
    assert located.inside.all()
    assert (located.barycentric >= 0.0).all()
    np.testing.assert_allclose(located.interpolate(mesh, mesh.nodes), points, atol=1e-10)


def test_a_point_beside_a_split_sheet_lies_on_its_own_side():
    mesh, left_nodes = split_box()
    side = np.where(np.arange(len(mesh.nodes)) < left_nodes, -1.0, 1.0)  # jumps across the sheet
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.039, 0.039, (400, 3))
    points[:, 0] = rng.choice([-1.0, 1.0], 400) * rng.choice([1e-3, 1e-6, 1e-9], 400)
    located = PointLocator(mesh).locate(points)
    assert located.inside.all()
    np.testing.assert_allclose(located.interpolate(mesh, side), np.sign(points[:, 0]))


def test_outside_points_go_to_vtks_closest_surface_point():
    mesh = ellipsoid_mesh(8)
    faces, _ = boundary_faces(mesh.elements)
    surface = pv.PolyData.from_regular_faces(mesh.nodes, faces)
    points = np.random.default_rng(3).normal(size=(200, 3)) * 0.06
    located = PointLocator(mesh).locate(points, max_outside_m=1.0)
    outside = ~located.inside
    assert outside.sum() > 50
    _, closest = surface.find_closest_cell(points[outside], return_closest_point=True)
    distance = np.linalg.norm(points[outside] - closest, axis=1)
    np.testing.assert_allclose(located.distance_m[outside], distance, atol=1e-9)
    np.testing.assert_allclose(located.interpolate(mesh, mesh.nodes)[outside], closest, atol=1e-7)
    assert (located.distance_m[located.inside] == 0.0).all()


def test_the_limit_decides_what_is_found():
    mesh = box_mesh((2, 2, 2), (0, 0, 0), (0.02, 0.02, 0.02))
    points = np.array(
        [[0.01, 0.01, 0.023], [0.01, 0.01, 0.03], [0.025, 0.025, 0.025], [np.nan, 0.01, 0.01], [0.01, np.inf, 0.0]]
    )
    located = PointLocator(mesh).locate(points, max_outside_m=0.005)
    np.testing.assert_array_equal(located.found, [True, False, False, False, False])
    np.testing.assert_allclose(located.distance_m[:3], [0.003, 0.01, np.sqrt(3) * 0.005])
    assert np.isnan(located.interpolate(mesh, mesh.nodes)[1:]).all()
    assert not PointLocator(mesh).locate(points).found.any()


def test_boundary_faces_close_the_mesh_outward():
    mesh = ellipsoid_mesh(6)
    faces, owner = boundary_faces(mesh.elements)
    x = mesh.nodes[faces]
    # Divergence theorem: the surface's signed volume is the sum of the elements' volumes.
    enclosed = np.einsum("na,na->", x[:, 0], np.cross(x[:, 1], x[:, 2])) / 6.0
    assert enclosed == pytest.approx(mesh.volumes.sum(), rel=1e-12)
    assert all(set(face) < set(mesh.elements[e]) for face, e in zip(faces, owner, strict=True))


def test_both_sides_of_a_split_sheet_are_boundary():
    mesh, _ = split_box(n=2)
    faces, _ = boundary_faces(mesh.elements)
    on_sheet = np.isclose(mesh.nodes[faces][..., 0], 0.0).all(axis=1)
    assert on_sheet.sum() == 2 * 2 * (2 * 2)


def test_flat_elements_hold_nothing():
    mesh = box_mesh((1, 1, 1), (0, 0, 0), (0.01, 0.01, 0.01))
    flat = tet_mesh(mesh.nodes, np.concatenate([mesh.elements, mesh.elements[:1, [0, 1, 2, 2]]]))
    located = PointLocator(flat).locate(np.random.default_rng(0).uniform(0, 0.01, (100, 3)))
    assert located.inside.all()
    assert (located.element < len(mesh.elements)).all()


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_nearest_on_triangles_beats_every_sample_of_the_triangle(seed):
    rng = np.random.default_rng(seed)
    point, triangle = rng.normal(size=(1, 3)), rng.normal(size=(1, 3, 3))
    nearest = nearest_on_triangles(point, triangle)
    weights = rng.dirichlet([1.0, 1.0, 1.0], 500)
    sampled = np.linalg.norm(point - weights @ triangle[0], axis=1).min()
    assert np.linalg.norm(point - nearest) <= sampled + 1e-12
    # It lies on the triangle: its barycentric coordinates are non-negative and rebuild it.
    coordinates, residual, *_ = np.linalg.lstsq(np.vstack([triangle[0].T, np.ones(3)]), np.append(nearest[0], 1.0), rcond=None)
    assert coordinates.min() > -1e-9
    assert residual.size == 0 or residual[0] < 1e-18
