"""Finite strain: the law against closed forms, the tangent against differences, contact, and the limit of small loads."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_cases import box, head, plain
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.elasticity import lame_parameters
from brainshift_ros.mechanics.forward import solve_system
from brainshift_ros.mechanics.materials import Material
from brainshift_ros.mechanics.space import space_of
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.simulation import neo_hookean
from brainshift_ros.simulation.contact_newton import NoEquilibriumError, Supports, Wall, at_rest, equilibrium
from brainshift_ros.simulation.finite_strain import solve_finite_strain
from brainshift_ros.simulation.hyperelastic import HyperelasticBody
from brainshift_ros.simulation.skull_gap import SkullGap
from brainshift_ros.surface.surface import Surface

E, NU = 2100.0, 0.45
SIDE = 0.05


def material(count, youngs_modulus=E):
    return Material(np.full(count, youngs_modulus), np.full(count, NU), np.full(count, 1000.0))


def cube(element, growth=1.0, counts=(2, 2, 2), jiggle=0.2):
    nodes, elements = box(counts, (SIDE, SIDE, SIDE), jiggle)
    space = space_of(plain(nodes, elements), element)
    return HyperelasticBody(space.basis, material(len(elements)), np.full(len(elements), growth)), space.points


def lame():
    lam, mu = lame_parameters(np.array(E), np.array(NU))
    return lam, mu


gradients = st.integers(0, 10_000).map(lambda seed: np.eye(3) + 0.25 * np.random.default_rng(seed).uniform(-1, 1, (3, 3)))


@given(gradients, st.floats(0.7, 1.4))
@settings(max_examples=25, deadline=None)
def test_stress_and_tangent_are_derivatives_of_the_energy(F, growth):
    law = (*lame(), np.array(growth))
    h = 1e-6
    P, A = neo_hookean.first_piola(F, *law), neo_hookean.tangent(F, *law)
    for i, j in np.ndindex(3, 3):
        step = np.zeros((3, 3))
        step[i, j] = h
        slope = (neo_hookean.energy(F + step, *law) - neo_hookean.energy(F - step, *law)) / (2 * h)
        assert P[i, j] == pytest.approx(slope, rel=1e-5, abs=1e-3)
        curvature = (neo_hookean.first_piola(F + step, *law) - neo_hookean.first_piola(F - step, *law)) / (2 * h)
        assert A[..., i, j] == pytest.approx(curvature, rel=1e-5, abs=1e-2)


@given(gradients, st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_a_rotation_turns_the_stress_and_makes_none(F, seed):
    turn = Rotation.random(random_state=seed).as_matrix()
    law = (*lame(), np.array(1.0))
    assert neo_hookean.first_piola(turn @ F, *law) == pytest.approx(turn @ neo_hookean.first_piola(F, *law), abs=1e-8)
    assert neo_hookean.first_piola(turn, *law) == pytest.approx(np.zeros((3, 3)), abs=1e-10)


def test_the_small_strain_limit_is_hookes_law():
    lam, mu = lame()
    identity = np.eye(3)
    hooke = lam * np.einsum("iJ,kL->iJkL", identity, identity)
    hooke = hooke + mu * (np.einsum("ik,JL->iJkL", identity, identity) + np.einsum("iL,kJ->iJkL", identity, identity))
    assert neo_hookean.tangent(identity, lam, mu, np.array(1.0)) == pytest.approx(hooke, rel=1e-12)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_the_tangent_is_the_difference_of_the_forces_and_these_of_the_energy(element):
    body, points = cube(element)
    rng = np.random.default_rng(0)
    u = 0.1 * points @ rng.normal(size=(3, 3)) + 2e-4 * rng.normal(size=points.shape)
    assert body.smallest_jacobian(u) > 0.0
    d, h = rng.normal(size=points.shape), 1e-7
    frames = Rotation.random(len(points), random_state=1).as_matrix()
    tangent = body.tangent(u, frames)
    assert abs(tangent - tangent.T).max() <= 1e-12 * abs(tangent).max()
    local = np.einsum("nai,ni->na", frames, d).ravel()
    difference = (body.internal_force(u + h * d) - body.internal_force(u - h * d)) / (2 * h)
    assert tangent @ local == pytest.approx(
        np.einsum("nai,ni->na", frames, difference).ravel(), abs=1e-6 * abs(difference).max()
    )
    slope = (body.energy(u + h * d) - body.energy(u - h * d)) / (2 * h)
    assert np.sum(body.internal_force(u) * d) == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize("element", ["P1", "P2"])
@pytest.mark.parametrize("growth", [1.0, 0.8])
def test_patch_any_homogeneous_deformation_is_in_equilibrium_inside(element, growth):
    body, points = cube(element, growth)
    F = np.eye(3) + 0.3 * np.random.default_rng(2).uniform(-1, 1, (3, 3))
    force = body.internal_force(points @ F.T - points)
    inner = np.all((points > 1e-9) & (points < SIDE - 1e-9), axis=1)
    assert np.abs(force[~inner]).max() > 1e-3
    assert np.abs(force[inner]).max() < 1e-12 * E


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_free_tissue_grows_and_turns_without_force(element):
    growth = 0.7
    body, points = cube(element, growth)
    turn = Rotation.from_rotvec([0.5, 0.7, -0.3]).as_matrix()
    u = np.cbrt(growth) * points @ turn.T - points
    assert np.abs(body.internal_force(u)).max() < 1e-12 * E
    assert body.energy(u) == pytest.approx(0.0, abs=1e-12)


def uniaxial_stretch(stress):
    """Stretches along and across under a nominal stress, from the law written in principal stretches."""
    lam, mu = lame()

    def nominal(along, across):
        volume = along * across**2
        return [mu * s + (0.5 * lam * (volume**2 - 1.0) - mu) / s for s in (along, across)]

    def across(along):
        return brentq(lambda x: nominal(along, x)[1], 0.3, 3.0, xtol=1e-15)

    along = brentq(lambda x: nominal(x, across(x))[0] - stress, 0.3, 3.0, xtol=1e-15)
    return along, across(along)


@pytest.mark.parametrize("element", ["P1", "P2"])
@pytest.mark.parametrize("stress", [-250.0, 800.0])
def test_uniaxial_load_gives_the_closed_form(element, stress):
    body, points = cube(element)
    along, across = uniaxial_stretch(stress)
    F = np.diag([across, across, along])
    exact = points @ F.T - points
    # The traction as nodal forces: what the homogeneous state carries on its top.
    top = np.isclose(points[:, 2], SIDE)
    load = np.where(top[:, None], body.internal_force(exact) * [0.0, 0.0, 1.0], 0.0)
    assert load.sum() == pytest.approx(stress * SIDE**2, rel=1e-10)
    held = np.isclose(points, 0.0)
    supports = Supports(np.tile(np.eye(3), (len(points), 1, 1)), held, no_wall())
    state, history = equilibrium(body, load, supports, at_rest(len(points), supports.wall))
    assert state.u == pytest.approx(exact, abs=1e-6 * SIDE)
    assert history[-1].residual < 1e-6


class Floor:
    """A plane below: penetration is how far a node went down."""

    def __call__(self, u):
        return -u[:, 2], np.tile([0.0, 0.0, -1.0], (len(u), 1))

    def curvature(self, u):
        return np.zeros((len(u), 3, 3))


def no_wall():
    empty = np.zeros(0, dtype=np.intp)
    return Wall(empty, empty, Floor())


def floor_case(element):
    """A block held on one side above a floor, under its weight and a side load that lifts part of it."""
    nodes, elements = box((3, 3, 3), (SIDE, SIDE, SIDE), 0.2)
    space = space_of(plain(nodes, elements), element)
    points = space.points
    body = HyperelasticBody(space.basis, material(len(elements)), np.ones(len(elements)))
    weight = np.zeros_like(points)
    share = 9810.0 * SIDE**3 / len(points)
    weight[:] = [-0.8 * share, 0.0, -share]
    weight[points[:, 0] > 0.8 * SIDE, 2] += 2.0 * share
    held = np.repeat(np.isclose(points[:, :1], 0.0), 3, axis=1)
    nodes_on_floor = np.flatnonzero(np.isclose(points[:, 2], 0.0) & ~held[:, 0])
    frames = np.tile(np.eye(3), (len(points), 1, 1))
    frames[nodes_on_floor] = [[0, 0, -1], [1, 0, 0], [0, 1, 0]]
    return body, weight, Supports(frames, held, Wall(nodes_on_floor, np.zeros(len(nodes_on_floor), np.intp), Floor()))


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_contact_neither_crosses_nor_pulls(element):
    body, load, supports = floor_case(element)
    state, _ = equilibrium(body, load, supports, at_rest(len(load), supports.wall))
    height = state.u[supports.wall.nodes, 2]
    assert height.min() >= -1e-8
    assert state.force.min() >= 0.0
    assert np.abs(state.force * height).max() <= 1e-8 * state.force.max()
    assert (state.force > 0.0).any()
    assert (height > 1e-4).any()
    # The floor carries what the held side and the load do not: the free nodes are in balance.
    unbalanced = body.internal_force(state.u) - load
    unbalanced[supports.wall.nodes, 2] -= state.force
    assert np.abs(unbalanced[~supports.held.any(axis=1)]).max() <= 1e-6 * np.linalg.norm(load)


def test_without_an_equilibrium_newton_says_so():
    body, points = cube("P1")
    load = np.zeros_like(points)
    load[:, 2] = -1e4
    held = np.repeat(np.isclose(points[:, 2:], 0.0), 3, axis=1)
    supports = Supports(np.tile(np.eye(3), (len(points), 1, 1)), held, no_wall())
    with pytest.raises(NoEquilibriumError):
        equilibrium(body, load, supports, at_rest(len(points), supports.wall))


def test_the_gap_of_a_ball_follows_its_curvature():
    radius = 0.07
    mesh = head(12, radius, sheet=False)
    ball = Surface(mesh.nodes, mesh.facets["skull"])
    points = mesh.nodes[np.unique(mesh.facets["skull"])]
    normals = points / radius
    gap = SkullGap(ball, points, normals)
    value, gradient = gap(np.zeros_like(points))
    assert value == pytest.approx(np.zeros(len(points)), abs=1e-15)
    assert gradient == pytest.approx(normals, abs=1e-12)
    # Nodes that slide along the ball stay on it; in their tangent plane they would leave it by 0.7 mm.
    turn = Rotation.from_rotvec([0.0, 0.0, 0.01 / radius]).as_matrix()
    slid, gradient = gap(points @ turn.T - points)
    flat = np.einsum("ni,ni->n", normals, points @ turn.T - points)
    assert flat.min() < -0.69e-3
    assert np.abs(slid).max() < 0.25e-3
    assert np.sqrt(np.mean(slid**2)) < 0.1e-3
    assert np.einsum("ni,ni->n", gradient, points @ turn.T / radius).min() > 0.98
    u, d, h = points @ turn.T - points, np.array([0.3, -0.5, 0.8]), 1e-6
    difference = (gap(u + h * d)[1] - gap(u - h * d)[1]) / (2 * h)
    assert gap.curvature(u) @ d == pytest.approx(difference, abs=1e-4 / radius)


DOWN = np.array([0.2, -0.1, -0.97])


@pytest.mark.parametrize(("element", "cells", "resected"), [("P2", 4, False), ("P1", 6, True)])
def test_small_loads_give_linear_elasticity_to_second_order(element, cells, resected):
    mesh = head(cells)
    opening = np.zeros(len(mesh.nodes), dtype=bool)
    opening[np.unique(mesh.facets["skull"])] = True
    opening &= np.linalg.norm(mesh.nodes - 0.07 * np.array([0.6, 0.0, 0.8]), axis=1) < 0.03
    difference = []
    for stiffness in (40.0 * E, 80.0 * E):
        system = assemble_system(mesh, material(len(mesh.elements), stiffness), resected=resected, element=element)
        linear = solve_system(system, DOWN, 0.2, cap_level=0.4, skull="contact", opening=opening).displacement
        finite = solve_finite_strain(system, DOWN, 0.2, cap_level=0.4, opening=opening)
        assert (finite.contact_force > 0.0).any()
        assert (finite.gap > 0.0).any()
        difference.append(np.linalg.norm(finite.displacement - linear) / np.linalg.norm(linear))
    assert 0.0 < difference[0] < 0.02
    assert difference[0] / difference[1] == pytest.approx(2.0, rel=0.15)


def test_a_drug_shrinks_the_brain_by_its_volume_away_from_what_holds_it():
    mesh = head(6, sheet=False)
    system = assemble_system(mesh, material(len(mesh.elements)))
    outside = np.zeros(len(mesh.nodes), dtype=bool)
    outside[np.unique(mesh.facets["skull"])] = True
    # Fluid up to the top carries all weight, and the whole skull is open: only the fixed patch below makes stress.
    shrunk = solve_finite_strain(
        system, [0, 0, -1], 1.0, opening=outside, growth=np.full(len(mesh.elements), 0.9), load_steps=1
    )
    moved = mesh.nodes + shrunk.displacement
    after = np.linalg.det(moved[mesh.elements][:, 1:] - moved[mesh.elements][:, :1]) / 6.0
    upper = mesh.nodes[mesh.elements].mean(axis=1)[:, 2] > 0.0
    assert after[upper].sum() / mesh.volumes[upper].sum() == pytest.approx(0.9, abs=2e-3)
    assert shrunk.smallest_jacobian > 0.8


def test_growth_must_fit_the_mesh():
    mesh = head(4, sheet=False)
    system = assemble_system(mesh, material(len(mesh.elements)))
    for growth in (np.ones(3), np.zeros(len(mesh.elements))):
        with pytest.raises(InputError, match="growth"):
            solve_finite_strain(system, [0, 0, -1], 0.5, growth=growth)
