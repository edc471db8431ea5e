"""Gravity load by fluid level against the exact volume and first moment of the exposed part."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_cases import box, plain
from scipy.spatial import ConvexHull, HalfspaceIntersection

from brainshift_ros.mechanics.clipping import shape_integrals_above
from brainshift_ros.mechanics.heights import height_over_level
from brainshift_ros.mechanics.loads import gravity_load
from brainshift_ros.mechanics.materials import GRAVITY, Material

SIZE = np.array([0.1, 0.07, 0.05])
NODES, ELEMENTS = box((3, 2, 2), SIZE, jiggle=0.2)
VOLUME = plain(NODES, ELEMENTS).volumes


def load(direction, level, density=1000.0):
    count = len(ELEMENTS)
    material = Material(np.full(count, 2100.0), np.full(count, 0.45), np.full(count, density))
    return gravity_load(ELEMENTS, VOLUME, material, direction, height_over_level(NODES, direction, level))


directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(max_examples=25, deadline=None)
@given(directions, st.floats(0.02, 0.98))
def test_total_is_the_weight_of_the_volume_above(direction, level):
    # Outside check: the box cut by the half-space, by scipy's half-space intersection and convex hull.
    down = np.array(direction) / np.linalg.norm(direction)
    height = -(NODES @ down)
    plane = height.min() + level * np.ptp(height)
    faces = [[*-axis, 0.0] for axis in np.eye(3)] + [[*axis, -s] for axis, s in zip(np.eye(3), SIZE, strict=True)]
    top = NODES[np.argmax(height)]
    inner = top + 1e-4 * (1.0 - level) * (SIZE / 2 - top)
    hull = ConvexHull(HalfspaceIntersection(np.array([*faces, [*down, plane]]), inner).intersections, qhull_options="QJ")
    expected = 1000.0 * GRAVITY * hull.volume * down
    np.testing.assert_allclose(load(down, level).sum(axis=0), expected, atol=1e-7 * 1000.0 * GRAVITY * SIZE.prod())


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("level", [0.0, 0.3, 0.61, 1.0])
def test_total_and_centre_of_weight_along_an_axis(axis, level):
    down = -np.eye(3)[axis]
    forces = load(down, level)[:, axis]
    weight = 1000.0 * GRAVITY * SIZE.prod() * (1.0 - level)
    assert forces.sum() == pytest.approx(-weight, abs=1e-12)
    centre = SIZE / 2
    centre[axis] = SIZE[axis] * (1.0 + level) / 2
    np.testing.assert_allclose(forces @ NODES, -weight * centre, atol=1e-13)


def test_under_water_tissue_weighs_its_excess_density():
    submerged = load(np.array([0.0, 0.0, -1.0]), 1.0, density=1040.0)
    assert submerged[:, 2].sum() == pytest.approx(-40.0 * GRAVITY * SIZE.prod(), rel=1e-12)
    assert np.all(load(np.array([0.0, 0.0, -1.0]), 1.0) == 0.0)


@pytest.mark.parametrize("above", [0, 1, 2, 3, 4])
def test_integrals_of_one_cut_tetrahedron_by_sampling(above):
    rng = np.random.default_rng(above)
    height = np.where(np.arange(4) < above, 1.0, -1.0) * rng.uniform(0.2, 1.0, 4)
    height = rng.permutation(height)
    barycentric = rng.dirichlet(np.ones(4), 200_000)
    expected = np.where((barycentric @ height > 0.0)[:, None], barycentric, 0.0).mean(axis=0)
    np.testing.assert_allclose(shape_integrals_above(height[None], np.ones(1))[0], expected, atol=2e-3)


def test_load_is_continuous_where_the_level_meets_nodes():
    down = np.array([0.0, 0.0, -1.0])
    np.testing.assert_allclose(load(down, 0.5 - 1e-9), load(down, 0.5 + 1e-9), atol=1e-7)
