"""Gravity load by fluid level against the exact volume and first moment of the exposed part."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_cases import box, plain
from scipy.spatial import ConvexHull, HalfspaceIntersection

from brainshift_ros.mechanics.clipping import integrals_above, whole_integrals
from brainshift_ros.mechanics.heights import height_over_level
from brainshift_ros.mechanics.loads import TissueWeight
from brainshift_ros.mechanics.materials import GRAVITY
from brainshift_ros.mechanics.space import space_of

SIZE = np.array([0.1, 0.07, 0.05])
NODES, ELEMENTS = box((3, 2, 2), SIZE, jiggle=0.2)
VOLUME = plain(NODES, ELEMENTS).volumes
SPACES = {element: space_of(plain(NODES, ELEMENTS), element) for element in ("P1", "P2")}


def load(direction, level, density=1000.0, element="P1"):
    weight = TissueWeight(SPACES[element], VOLUME, np.full(len(ELEMENTS), density))
    return GRAVITY * weight.masses(height_over_level(NODES, direction, level)[:, None]) * direction


directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(max_examples=25, deadline=None)
@given(directions, st.floats(0.02, 0.98), st.sampled_from(["P1", "P2"]))
def test_total_is_the_weight_of_the_volume_above(direction, level, element):
    # Outside check: the box cut by the half-space, by scipy's half-space intersection and convex hull.
    down = np.array(direction) / np.linalg.norm(direction)
    height = -(NODES @ down)
    plane = height.min() + level * np.ptp(height)
    faces = [[*-axis, 0.0] for axis in np.eye(3)] + [[*axis, -s] for axis, s in zip(np.eye(3), SIZE, strict=True)]
    top = NODES[np.argmax(height)]
    inner = top + 1e-4 * (1.0 - level) * (SIZE / 2 - top)
    hull = ConvexHull(HalfspaceIntersection(np.array([*faces, [*down, plane]]), inner).intersections, qhull_options="QJ")
    expected = 1000.0 * GRAVITY * hull.volume * down
    np.testing.assert_allclose(
        load(down, level, element=element).sum(axis=0), expected, atol=1e-7 * 1000.0 * GRAVITY * SIZE.prod()
    )


@pytest.mark.parametrize("element", ["P1", "P2"])
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("level", [-0.5, 0.0, 0.3, 0.61, 1.0, 1.5])
def test_total_and_centre_of_weight_along_an_axis(axis, level, element):
    down = -np.eye(3)[axis]
    forces = load(down, level, element=element)[:, axis]
    level = min(max(level, 0.0), 1.0)  # fluid below or above the brain bares or covers all of it
    weight = 1000.0 * GRAVITY * SIZE.prod() * (1.0 - level)
    assert forces.sum() == pytest.approx(-weight, abs=1e-12)
    centre = SIZE / 2
    centre[axis] = SIZE[axis] * (1.0 + level) / 2
    np.testing.assert_allclose(forces @ SPACES[element].points, -weight * centre, atol=1e-13)


def test_under_water_tissue_weighs_its_excess_density():
    submerged = load(np.array([0.0, 0.0, -1.0]), 1.0, density=1040.0)
    assert submerged[:, 2].sum() == pytest.approx(-40.0 * GRAVITY * SIZE.prod(), rel=1e-12)
    assert np.all(load(np.array([0.0, 0.0, -1.0]), 1.0) == 0.0)


def test_second_moment_of_weight_along_an_axis():
    # Quadratic shape functions carry the second moment exactly: int z^2 over what is above.
    level = 0.43
    forces = load(np.array([0.0, 0.0, -1.0]), level, element="P2")[:, 2]
    height, base = SIZE[2], SIZE[0] * SIZE[1]
    expected = -1000.0 * GRAVITY * base * height**3 * (1.0 - level**3) / 3.0
    assert forces @ SPACES["P2"].points[:, 2] ** 2 == pytest.approx(expected, rel=1e-12)


def shape_functions(barycentric, order):
    """Linear or quadratic shape functions (s, 4 or 10) by their definition."""
    if order == 1:
        return barycentric
    pairs = [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
    middles = [4.0 * barycentric[:, i] * barycentric[:, j] for i, j in pairs]
    return np.concatenate([barycentric * (2.0 * barycentric - 1.0), np.stack(middles, axis=1)], axis=1)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("above", [0, 1, 2, 3, 4])
def test_integrals_of_one_cut_tetrahedron_by_sampling(above, order):
    rng = np.random.default_rng(above)
    height = np.where(np.arange(4) < above, 1.0, -1.0) * rng.uniform(0.2, 1.0, 4)
    height = rng.permutation(height)
    barycentric = rng.dirichlet(np.ones(4), 200_000)
    values = shape_functions(barycentric, order)
    expected = np.where((barycentric @ height > 0.0)[:, None], values, 0.0).mean(axis=0)
    np.testing.assert_allclose(integrals_above(height[None], np.ones(1), order)[0], expected, atol=2e-3)


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda h: min(map(abs, h)) > 1e-3), st.sampled_from([1, 2]))
def test_the_parts_above_and_below_make_the_whole(height, order):
    height = np.array([height])
    both = integrals_above(height, np.ones(1), order) + integrals_above(-height, np.ones(1), order)
    np.testing.assert_allclose(both, whole_integrals(np.ones(1), order), atol=1e-13)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_load_is_continuous_where_the_level_meets_nodes(element):
    down = np.array([0.0, 0.0, -1.0])
    below, above = (load(down, 0.5 + step, element=element) for step in (-1e-9, 1e-9))
    np.testing.assert_allclose(below, above, atol=1e-7)


def test_a_block_of_cases_equals_one_by_one():
    rng = np.random.default_rng(5)
    height = rng.normal(scale=0.03, size=(3, 1, 40)) * NODES.T[:, :, None]
    height = height.sum(axis=0) + rng.normal(scale=0.02, size=40)
    weight = TissueWeight(SPACES["P2"], VOLUME, np.full(len(ELEMENTS), 1040.0))
    one_by_one = np.stack([weight.masses(case[:, None])[:, 0] for case in height.T], axis=1)
    np.testing.assert_array_equal(weight.masses(height), one_by_one)
