"""The field around the brain: it never folds, whatever the brain does, and its inverse always converges."""

from __future__ import annotations

import numpy as np
import pytest
from field_cases import SEMI_AXES, box_mesh, ellipsoid_mesh, smooth_field, split_box
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from brainshift_ros.field.coarse import sampled_coarsely
from brainshift_ros.field.deformation import Deformation
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.jacobian import jacobian_of_cells
from brainshift_ros.field.surroundings import LEAST_JACOBIAN, STEEPEST, Surroundings, limit_slope
from brainshift_ros.image.grid import Grid

SMALL = ellipsoid_mesh(4)


def field_of(mesh, u):
    return DisplacementField(mesh, u, np.zeros(len(u)), {})


@st.composite
def shifts(draw):
    """Anything from a smooth sag to noise that turns every element inside out, up to 30 mm."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    largest = draw(st.floats(1e-4, 0.03))
    waves = draw(st.sampled_from([5.0, 40.0, 400.0]))  # per metre: the last changes at every node
    phase, across = rng.uniform(0, 6, 3), rng.normal(size=(3, 3))
    u = np.sin(waves * SMALL.nodes @ across + phase)
    return field_of(SMALL, u * largest / np.linalg.norm(u, axis=1).max())


@settings(max_examples=15, deadline=None)
@given(shifts())
def test_no_shift_folds_the_surroundings(field):
    around = Surroundings(field, 0.008)
    u, edge = around.displacement, around.grid.voxel_edges[0]
    for axis in range(3):
        assert np.abs(np.diff(u, axis=axis)).max() <= STEEPEST * edge * (1 + 1e-4)
        assert not np.take(u, [0, -1], axis=axis).any()  # so it continues as zero without a jump
    assert jacobian_of_cells(u, around.grid).min() > LEAST_JACOBIAN - 1e-3
    y = np.random.default_rng(0).uniform(-0.12, 0.12, (200, 3))
    v = around.inverse(y)
    np.testing.assert_allclose(v, -around.forward(y + v), atol=2e-7)


@settings(max_examples=10, deadline=None)
@given(shifts())
def test_no_shift_folds_the_image_outside_the_brain(field):
    deformation = Deformation(field, spacing=0.008)
    grid = Grid((30, 32, 28), np.array([[0, -0.007, 0, 0.11], [0.0065, 0, 0, -0.1], [0, 0, 0.007, -0.1], [0, 0, 0, 1.0]]))
    inverse = deformation.inverse_on(grid)
    outside = ndimage.minimum_filter(deformation.owner_now(grid) < 0, size=2, origin=-1)[:-1, :-1, :-1]
    assert outside.sum() > 5000
    assert jacobian_of_cells(inverse, grid)[outside].min() > 0.0


def test_the_bound_on_the_jacobian_is_that_of_the_worst_gradient():
    worst = min(
        np.linalg.det(np.eye(3) + STEEPEST * (2.0 * (np.arange(512)[k] >> np.arange(9) & 1) - 1.0).reshape(3, 3))
        for k in range(512)  # a determinant is linear in each entry, so it is extremal at the corners
    )
    assert pytest.approx(worst) == LEAST_JACOBIAN


def test_a_field_within_the_limit_stays_as_it_is():
    x = np.linspace(0.0, 2.0, 12)
    field = np.stack(np.meshgrid(0.05 * np.sin(x), 0.04 * x**2, 0.1 - 0.05 * x, indexing="ij"), axis=-1).astype(np.float32)
    assert np.abs(np.diff(field, axis=1)).max() > 0.02
    np.testing.assert_allclose(limit_slope(field, 0.03), field, atol=1e-7)


def test_a_spike_and_a_step_become_ramps():
    spike = np.zeros((9, 9, 9, 1), np.float32)
    spike[4, 4, 4] = 2.0
    limited = limit_slope(spike, 0.5)[..., 0]
    steps = np.abs(np.indices(spike.shape[:3]) - 4).sum(axis=0)
    above, below = np.maximum(2.0 - 0.5 * steps, 0.0), np.where(steps == 0, 0.5, 0.0)
    np.testing.assert_allclose(limited, 0.5 * (above + below), atol=1e-6)
    step = np.zeros((20, 3, 3, 1), np.float32)
    step[10:] = 4.0
    along = limit_slope(step, 0.5)[:, 1, 1, 0]
    np.testing.assert_allclose(along, np.clip(2.0 + 0.25 * (np.arange(20) - 9.5), 0.0, 4.0), atol=0.15)
    assert np.diff(along).max() <= 0.5 + 1e-6


def test_it_meets_the_brain_and_fades_to_nothing():
    mesh = ellipsoid_mesh(8)
    field = smooth_field(mesh, size=0.012)
    around = Surroundings(field, 0.004)
    on_surface = np.linalg.norm(mesh.nodes / SEMI_AXES, axis=1) > 1.0 - 1e-9
    miss = np.linalg.norm(around.forward(mesh.nodes) - field.displacement, axis=1)[on_surface]
    assert miss.mean() < 3e-4
    reach = 4.0 * np.linalg.norm(field.displacement, axis=1).max()
    directions = np.random.default_rng(0).normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert not around.forward(directions * (SEMI_AXES.max() + reach + 0.01)).any()


def test_sides_that_slide_apart_are_joined_by_a_ramp():
    mesh, left_nodes = split_box()
    u = np.zeros_like(mesh.nodes)
    u[:left_nodes, 1] = 0.012
    around = Surroundings(field_of(mesh, u), 0.004)
    across = np.array([0.0, 0.0, 0.044]) + np.linspace(-0.04, 0.04, 41)[:, None] * [1.0, 0.0, 0.0]
    slid = around.forward(across)[:, 1]
    assert slid[0] > 0.009
    assert slid[-1] < 0.003
    assert np.abs(np.diff(slid)).max() <= STEEPEST * 0.002 * (1 + 1e-4)


def test_a_brain_smaller_than_a_voxel_moves_nothing():
    mesh = box_mesh((1, 1, 1), (0.0011, 0.0011, 0.0011), (0.0012, 0.0012, 0.0012))
    assert not Surroundings(field_of(mesh, np.full_like(mesh.nodes, 1e-3)), 0.02).displacement.any()


@pytest.mark.parametrize("shape", [(13, 11, 12), (12, 1, 10), (2, 3, 4)])
def test_a_linear_function_is_sampled_exactly_on_any_grid(shape):
    T = np.array([[0.002, 0.0003, 0, 0.1], [0, -0.0011, 0.0004, 0], [0.0005, 0, 0.004, -0.2], [0, 0, 0, 1.0]])
    grid = Grid(shape, T)
    A = np.random.default_rng(0).normal(size=(3, 3))
    taken = []

    def function(points):
        taken.append(len(points))
        return points @ A.T + 0.5

    sampled = sampled_coarsely(function, grid, 0.004)
    assert sampled.shape == (*shape, 3)
    np.testing.assert_allclose(sampled, grid.centres(np.moveaxis(np.indices(shape), 0, -1)) @ A.T + 0.5, atol=1e-6)
    assert sum(taken) < np.prod(shape)
