"""Closest points, inside tests and rays on an octahedron, against its geometry in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.surface.queries import RayCaster, closest_points, inside
from brainshift_ros.surface.surface import Surface

SIZE = 0.05
OCTAHEDRON = Surface(
    SIZE * np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]),
    np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], dtype=np.int32),
)
POINTS = np.random.default_rng(0).uniform(-1.5 * SIZE, 1.5 * SIZE, (500, 3))


def test_inside_is_a_ball_of_the_taxicab_norm():
    assert np.array_equal(inside(OCTAHEDRON, POINTS), np.abs(POINTS).sum(axis=1) < SIZE)


def test_closest_points_lie_on_the_surface_and_no_sample_of_it_is_nearer():
    found = closest_points(OCTAHEDRON, POINTS)
    corners = OCTAHEDRON.vertices[OCTAHEDRON.faces[found.face]]
    assert np.einsum("nc,ncd->nd", found.barycentric, corners) == pytest.approx(found.position, abs=1e-12)
    assert np.abs(found.position).sum(axis=1) == pytest.approx(SIZE, abs=1e-12)
    assert np.linalg.norm(POINTS - found.position, axis=1) == pytest.approx(found.distance, abs=1e-12)
    samples = np.random.default_rng(1).dirichlet(np.ones(3), 4000)
    on_surface = np.concatenate([samples @ OCTAHEDRON.vertices[face] for face in OCTAHEDRON.faces])
    nearest = np.min(np.linalg.norm(POINTS[:40, None] - on_surface, axis=2), axis=1)
    assert (found.distance[:40] <= nearest + 1e-12).all()
    assert found.distance[:40] == pytest.approx(nearest, abs=0.05 * SIZE)


def test_rays_meet_the_surface_where_the_taxicab_norm_says():
    rng = np.random.default_rng(2)
    far = np.array([0.3, -0.2, 0.5])
    targets = rng.uniform(-1.0, 1.0, (6, 7, 3))
    targets *= 0.9 * SIZE / np.abs(targets).sum(axis=-1, keepdims=True)
    hits = RayCaster(OCTAHEDRON).cast(far, targets - far)
    assert hits.face.shape == (6, 7)
    met = far + hits.distance[..., None] * (targets - far)
    assert np.abs(met).sum(axis=-1) == pytest.approx(SIZE, rel=1e-4)
    assert (hits.distance < 1.0).all()
    corners = OCTAHEDRON.vertices[OCTAHEDRON.faces[hits.face]]
    assert np.einsum("ijc,ijcd->ijd", hits.barycentric, corners) == pytest.approx(met, abs=1e-6)


def test_a_ray_that_misses_says_so():
    hits = RayCaster(OCTAHEDRON).cast([[0.3, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    assert hits.face == -1
    assert np.isinf(hits.distance)
    assert np.isnan(hits.barycentric).all()
