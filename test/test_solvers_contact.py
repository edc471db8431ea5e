"""One-sided contact against solvers from outside, at its degenerate ends, and on a mesh."""

from __future__ import annotations

import numpy as np
import osqp
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_cases import head, patient
from scipy.optimize import nnls

from brainshift_ros.mechanics.boundary import NodeKind
from brainshift_ros.mechanics.forward import solve_gravity, solve_system
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.solvers import contact
from brainshift_ros.solvers.contact import BlockPivoting, ContactProblem
from brainshift_ros.solvers.many import ManySolver

PATIENT = patient(head(6))
MATERIAL = material_of(PATIENT.tissue)
OBLIQUE = np.array([0.1, -0.5, -0.8])
SIDEWAYS = np.array([1.0, 0.2, -0.3])
CAP = 0.47  # no node lies just on the plane, where round-off decides


def stiffness_and_load(size, seed, condition=1e3):
    rng = np.random.default_rng(seed)
    axes, _ = np.linalg.qr(rng.normal(size=(size, size)))
    return axes @ np.diag(np.geomspace(1.0, condition, size)) @ axes.T, rng.normal(size=size) * 10.0 ** rng.uniform(-3, 3)


def by_nnls(stiffness, load):
    """Minimum over x <= 0 as a least squares problem: |L^T y + L^-1 g| over y = -x >= 0."""
    root = np.linalg.cholesky(stiffness)
    return -nnls(root.T, -np.linalg.solve(root, load), maxiter=50 * len(load))[0]


@given(st.integers(1, 40), st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_solution_equals_nonnegative_least_squares_from_any_guess(size, seed, guess_seed):
    stiffness, load = stiffness_and_load(size, seed)
    guess = np.random.default_rng(guess_seed).random(size) < 0.5
    state = ContactProblem(stiffness).solve(load, guess)
    expected = by_nnls(stiffness, load)
    scale = np.abs(np.linalg.solve(stiffness, load)).max()
    np.testing.assert_allclose(state.displacement, expected, atol=1e-9 * scale)
    assert np.all(state.displacement <= 1e-11 * scale)
    assert np.all(state.displacement[state.closed] == 0.0)


def test_solution_equals_osqp():
    stiffness, load = stiffness_and_load(30, 4, condition=50.0)
    solver = osqp.OSQP()
    below = (np.full(30, -np.inf), np.zeros(30))
    solver.setup(sp.csc_matrix(stiffness), -load, sp.eye(30, format="csc"), *below, eps_abs=1e-10, eps_rel=1e-10, verbose=False)
    state = ContactProblem(stiffness).solve(load, np.zeros(30, bool))
    assert 5 < state.closed.sum() < 25
    expected = solver.solve(raise_error=True).x
    np.testing.assert_allclose(state.displacement, expected, atol=1e-6 * np.abs(expected).max())


@given(st.integers(0, 2**32 - 1), st.floats(1e-12, 1e12))
@settings(max_examples=25, deadline=None)
def test_twice_the_load_is_twice_the_answer(seed, factor):
    stiffness, load = stiffness_and_load(12, seed)
    problem, guess = ContactProblem(stiffness), np.zeros(12, bool)
    once, scaled = problem.solve(load, guess), problem.solve(factor * load, guess)
    np.testing.assert_array_equal(scaled.closed, once.closed)
    np.testing.assert_allclose(scaled.displacement, factor * once.displacement, rtol=1e-9)


def test_degenerate_ends():
    stiffness = np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 2.0]])
    problem = ContactProblem(stiffness)
    for guess in (np.zeros(3, bool), np.ones(3, bool)):
        np.testing.assert_array_equal(problem.solve(np.zeros(3), guess).displacement, 0.0)
        all_closed = problem.solve(np.ones(3), guess)
        assert all_closed.closed.all()
        assert not all_closed.displacement.any()
        all_open = problem.solve(-np.ones(3), guess)
        assert not all_open.closed.any()
        np.testing.assert_allclose(all_open.displacement, np.linalg.solve(stiffness, -np.ones(3)))
        # A tie: the middle dof just touches, without force.
        tie = problem.solve(stiffness @ np.array([-1.0, 0.0, -1.0]), guess)
        np.testing.assert_allclose(tie.displacement, [-1.0, 0.0, -1.0], atol=1e-14)
    assert ContactProblem(np.array([[3.0]])).solve(np.array([-6.0]), np.array([True])).displacement == pytest.approx(-2.0)


def test_single_exchanges_end_where_block_exchanges_are_not_allowed(monkeypatch):
    monkeypatch.setattr(contact, "PATIENCE", 0)
    for seed in range(20):
        stiffness, load = stiffness_and_load(15, seed)
        state = ContactProblem(stiffness).solve(load, np.zeros(15, bool))
        np.testing.assert_allclose(state.displacement, by_nnls(stiffness, load), atol=1e-9 * np.abs(load).max())


def test_block_exchanges_give_way_to_single_ones_until_there_is_progress():
    pivoting, wrong = BlockPivoting(), np.array([3, 5, 8])
    exchanged = [len(pivoting.exchange(wrong)) for _ in range(contact.PATIENCE + 3)]
    assert exchanged == [3] * (contact.PATIENCE + 1) + [1, 1]
    np.testing.assert_array_equal(pivoting.exchange(wrong), [8])
    assert len(pivoting.exchange(wrong[:2])) == 2


def test_contact_that_finds_no_end_is_an_error(monkeypatch):
    monkeypatch.setattr(contact, "most_iterations", lambda count: 2)
    stiffness, load = stiffness_and_load(30, 4, condition=50.0)
    with pytest.raises(ArithmeticError, match="no set of closed dofs"):
        ContactProblem(stiffness).solve(load, np.zeros(30, bool))


def test_stiffness_that_is_not_positive_definite_is_refused():
    for stiffness in (np.array([[1.0, 2.0], [2.0, 1.0]]), np.ones((2, 2))):
        with pytest.raises(ArithmeticError, match="rigid motion"):
            ContactProblem(stiffness)


@pytest.fixture(scope="module")
def system():
    return assemble_system(PATIENT.mesh, MATERIAL, resected=True, solver="scipy")


def opening_of(mesh):
    skull = np.unique(mesh.facets["skull"])
    opening = np.zeros(len(mesh.nodes), bool)
    opening[skull[np.linalg.norm(mesh.nodes[skull] - [-0.01, 0.05, 0.05], axis=1) < 0.03]] = True
    return opening


@pytest.mark.parametrize("solver", ["pardiso", "scipy"])
def test_block_contact_equals_refactoring_each_set_of_closed_nodes(system, solver):
    opening = opening_of(PATIENT.mesh)
    directions = [OBLIQUE, SIDEWAYS, np.array([0.0, -1.0, 0.1])]
    cases = [(direction, level) for direction in directions for level in (0.2, 0.6)]
    masks = [system.held_and_one_sided(direction, CAP, opening) for direction in directions]
    held, one_sided = (np.array(each) for each in zip(*masks, strict=True))
    many = ManySolver(system.stiffness, held, one_sided, solver)
    loads = np.stack([system.gravity(*case) for case in cases], axis=1)
    block = many.solve_block(loads, np.repeat(np.arange(3), 2))
    fields = system.displacement(block.solution)
    solved, touched = system.submesh.node_of >= 0, 0
    for column, (direction, level) in enumerate(cases):
        alone = solve_system(system, direction, level, cap_level=CAP, skull="contact", opening=opening, solver=solver)
        np.testing.assert_allclose(fields[:, :, column], alone.displacement, atol=1e-11 * np.abs(alone.displacement).max())
        normals = block.solution[one_sided[column // 2], column]
        assert normals.max() <= 1e-12 * np.abs(normals).max()
        reaction = (system.stiffness @ block.solution[:, column] - loads[:, column])[block.closed[:, column]]
        assert np.all(reaction <= 1e-10 * np.abs(loads).max())
        touches = block.closed[:, column].reshape(-1, 3).any(axis=1)
        np.testing.assert_array_equal((alone.kinds == NodeKind.CONTACT)[solved], touches[system.submesh.node_of[solved]])
        touched += len(reaction)
    assert touched > 10
    assert block.iterations.min() >= 1
    # Closed dofs of the solution itself are the best guess.
    again = many.solve_block(loads, np.repeat(np.arange(3), 2), block.closed)
    np.testing.assert_array_equal(again.iterations, 1)
    np.testing.assert_allclose(again.solution, block.solution, atol=1e-12 * np.abs(block.solution).max())


def test_tissue_does_not_cross_the_skull_that_a_free_cap_lets_it_cross():
    cap = {"cap_level": 0.3, "solver": "scipy"}
    free = solve_gravity(PATIENT.mesh, MATERIAL, SIDEWAYS, 0.0, **cap)
    held = solve_gravity(PATIENT.mesh, MATERIAL, SIDEWAYS, 0.0, skull="contact", **cap)
    skull = np.setdiff1d(np.unique(PATIENT.mesh.facets["skull"]), np.unique(PATIENT.mesh.facets["falx"]))
    normal = PATIENT.mesh.nodes[skull] / np.linalg.norm(PATIENT.mesh.nodes[skull], axis=1)[:, None]
    outward = [np.einsum("nk,nk->n", solution.displacement[skull], normal) for solution in (free, held)]
    assert outward[0].max() > 1e-3
    # A node's discrete normal is not quite the sphere's.
    assert outward[1].max() < 0.1 * outward[0].max()
    assert (held.iterations, free.iterations) == (held.iterations, 1)
    assert held.iterations > 1
