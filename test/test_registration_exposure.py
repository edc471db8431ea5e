"""What can be seen from outside, against exact rays; thinning, against its definition."""

from __future__ import annotations

import numpy as np
import pytest
from simulation_cases import mni_cortex
from skimage.measure import marching_cubes

from brainshift_ros.registration.exposure import covering_samples, open_fraction, sphere_directions
from brainshift_ros.registration.target import prepare_target
from brainshift_ros.registration.thinning import voxel_means
from brainshift_ros.surface.queries import RayCaster
from brainshift_ros.surface.surface import Surface


def ball(radius, cells=25):
    """Sphere around the origin with outward faces, and its normals."""
    grid = np.linspace(-1.1 * radius, 1.1 * radius, cells)
    step = grid[1] - grid[0]
    distance = radius - np.linalg.norm(np.stack(np.meshgrid(grid, grid, grid, indexing="ij")), axis=0)
    vertices, faces, _, _ = marching_cubes(distance, 0.0, spacing=(step, step, step))
    vertices -= 1.1 * radius
    faces = faces[:, ::-1]  # of a distance that is positive inside, scikit-image turns them inward
    return Surface(vertices, np.ascontiguousarray(faces, dtype=np.int32)), vertices / np.linalg.norm(
        vertices, axis=1, keepdims=True
    )


def traced_fraction(surface, points, normals, directions=24):
    """The same by exact rays (Embree)."""
    caster = RayCaster(surface)
    starts = points + 0.3e-3 * normals
    hidden = [np.isfinite(caster.cast(starts, d).distance) for d in sphere_directions(directions)]
    return 1.0 - np.mean(hidden, axis=0)


def test_a_convex_surface_is_open_to_half_of_all_directions():
    surface, normals = ball(0.06)
    fraction = open_fraction(surface, surface.vertices, normals, directions=100)
    assert fraction.mean() == pytest.approx(0.5 * (1 - 0.1), abs=0.02), "grazing directions do not count"
    assert fraction.min() > 0.35


def test_what_is_enclosed_is_hidden():
    outer, _ = ball(0.08)
    inner, normals = ball(0.04)
    both = Surface(
        np.concatenate([outer.vertices, inner.vertices]), np.concatenate([outer.faces, inner.faces + len(outer.vertices)])
    )
    assert not open_fraction(both, inner.vertices, normals).any()


def test_the_floor_of_a_pit_is_hidden_and_its_rim_is_not():
    """A floor between four walls 30 mm apart and 60 mm high."""
    square = [(-15e-3, -15e-3), (15e-3, -15e-3), (15e-3, 15e-3), (-15e-3, 15e-3)]
    vertices = np.array([(x, y, z) for z in (0.0, 0.06) for x, y in square])
    walls = [face for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)) for face in ([a, a + 4, b], [b, a + 4, b + 4])]
    pit = Surface(vertices, np.array([[0, 1, 2], [0, 2, 3], *walls], dtype=np.int32))
    asked, normals = np.array([[0.0, 0.0, 0.0], [15e-3, 0.0, 0.0595]]), np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
    floor, rim = open_fraction(pit, asked, normals, directions=400)
    assert floor < 0.04
    assert 0.2 < rim < 0.4


def test_it_agrees_with_exact_rays_on_a_real_cortex():
    """The gate's verdict on gyri and sulci: the same for nearly all points, and rather hidden than open where it differs."""
    surface = mni_cortex()
    corners = surface.vertices[surface.faces[::9]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = corners.mean(axis=1)
    exact = traced_fraction(surface, points, normals) >= 0.12
    found = open_fraction(surface, points, normals) >= 0.12
    assert 0.5 < exact.mean() < 0.95, "the case shall have both"
    assert (found == exact).mean() > 0.94
    assert (found & ~exact).mean() < 0.02


def test_samples_leave_no_gap_on_coarse_triangles():
    surface = Surface(np.array([[0.0, 0, 0], [0.02, 0, 0], [0, 0.013, 0]]), np.array([[0, 1, 2]], dtype=np.int32))
    samples = covering_samples(surface, 1.2e-3)
    rng = np.random.default_rng(0)
    weights = rng.dirichlet([1.0, 1.0, 1.0], size=500)
    inside = weights @ surface.vertices
    gap = np.linalg.norm(inside[:, None] - samples[None], axis=2).min(axis=1)
    assert gap.max() < 1.2e-3


def test_targets_lie_on_the_outside_with_outward_normals():
    outer, _ = ball(0.07, cells=60)
    target = prepare_target(outer)
    radius = np.linalg.norm(target.points, axis=1)
    np.testing.assert_allclose(radius, 0.07, atol=0.3e-3)
    outward = target.points / radius[:, None]
    assert np.einsum("ij,ij->i", target.normals, outward).min() > 0.95
    np.testing.assert_allclose(np.linalg.norm(target.normals, axis=1), 1.0)


def test_thinning_gives_the_mean_of_each_cell():
    rng = np.random.default_rng(1)
    points, values = rng.normal(0.0, 0.01, (500, 3)), rng.normal(size=(500, 2))
    thin, means = voxel_means(points, 4e-3, values)
    cells = {}
    for point, value in zip(points, values, strict=True):
        cells.setdefault(tuple(np.floor((point - points.min(axis=0)) / 4e-3)), []).append((*point, *value))
    expected = np.array([np.mean(cells[cell], axis=0) for cell in sorted(cells)])
    np.testing.assert_allclose(np.column_stack([thin, means]), expected)
    assert len(thin) < 400
