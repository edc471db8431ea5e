"""Many solutions by one factorisation against dense algebra: statuses of dofs, memory orders, indefinite matrices, edges."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import nnls

from brainshift_ros.errors import InputError
from brainshift_ros.solvers import condensed
from brainshift_ros.solvers.condensed import CondensedSystem
from brainshift_ros.solvers.held import HeldSystem, SchurComplement
from brainshift_ros.solvers.many import ManySolver

SOLVERS = ("pardiso", "scipy")
DISPLACEMENTS, PRESSURES = 70, 30


def spd(size=DISPLACEMENTS, seed=0):
    a = sp.random(size, size, 0.05, random_state=seed)
    return (a @ a.T + 0.1 * sp.eye(size)).tocsr()


def saddle(compressibility=1e-2):
    """A quasi-definite matrix whose two kinds of rows differ in size as those of consolidation do."""
    coupling = sp.random(DISPLACEMENTS, PRESSURES, 0.1, random_state=1)
    whole = sp.bmat([[spd(), coupling], [coupling.T, -compressibility * sp.eye(PRESSURES)]])
    size = sp.diags(np.repeat([1e2, 1e-5], [DISPLACEMENTS, PRESSURES]))
    return (size @ whole @ size).tocsr()


def statuses(size, seed, sets=4):
    """Held dofs anywhere but among the first 20, one-sided ones among the displacements; the last set has none."""
    rng = np.random.default_rng(seed)
    held, one_sided = np.zeros((2, sets, size), bool)
    held[:, :4] = True
    for number in range(sets):
        held[number, rng.choice(np.arange(20, size), 12, replace=False)] = True
        one_sided[number, rng.choice(np.arange(20, DISPLACEMENTS), 25, replace=False)] = number < sets - 1
    return held, one_sided


def assert_solves(matrix, block, loads, held, one_sided, sets, tolerance=1e-9):
    """Equations, bounds and complementarity, each against what matters in its own row."""
    dense = matrix.toarray()
    for column, number in enumerate(sets):
        x = block.solution[:, column]
        reaction = dense @ x - loads[:, column]
        row_size = np.abs(dense) @ np.abs(x) + np.abs(loads[:, column])
        bounded = one_sided[number] & ~held[number]
        closed = block.closed[:, column]
        assert not x[held[number]].any()
        assert np.all(np.abs(reaction)[~held[number] & ~closed] <= tolerance * row_size.max())
        assert not np.any(closed & ~bounded)
        assert not x[closed].any()
        assert np.all(x[bounded] <= 1e-11 * np.abs(x[bounded]).max(initial=0.0))
        assert np.all(reaction[closed] <= 1e-10 * row_size[closed])


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("matrix", [spd(), saddle()], ids=["definite", "quasi-definite"])
def test_held_one_sided_and_free_dofs_in_one_block(matrix, solver):
    size = matrix.shape[0]
    held, one_sided = statuses(size, 3)
    many = ManySolver(matrix, held, one_sided, solver, definite=size == DISPLACEMENTS)
    sets = np.array([2, 0, 3, 1, 0, 2, 3])
    rng = np.random.default_rng(5)
    loads = rng.normal(size=(size, len(sets))) * np.abs(matrix.diagonal())[:, None]
    block = many.solve_block(loads, sets)
    assert_solves(matrix, block, loads, held, one_sided, sets)
    assert block.residual < 1e-10
    assert block.closed[:, [0, 1, 3]].any(axis=0).all()
    np.testing.assert_array_equal(block.iterations == 0, sets == 3)


@pytest.mark.parametrize("solver", SOLVERS)
def test_contact_beside_pressures_has_the_one_solution(solver):
    """Eliminating what is not one-sided from the saddle point leaves an SPD problem, which least squares solves as well."""
    matrix = saddle()
    held, one_sided = statuses(matrix.shape[0], 8, sets=2)
    load = np.random.default_rng(9).normal(size=(matrix.shape[0], 1)) * np.abs(matrix.diagonal())[:, None]
    many = ManySolver(matrix, held, one_sided, solver, definite=False)
    found = many.solve_block(load, [0]).solution[:, 0]
    bounded, rest = one_sided[0] & ~held[0], ~one_sided[0] & ~held[0]
    dense = matrix.toarray()
    follow = np.linalg.solve(dense[np.ix_(rest, rest)], np.column_stack([dense[np.ix_(rest, bounded)], load[rest]]))
    stiffness = dense[np.ix_(bounded, bounded)] - dense[np.ix_(bounded, rest)] @ follow[:, :-1]
    condensed_load = load[bounded, 0] - dense[np.ix_(bounded, rest)] @ follow[:, -1]
    root = np.linalg.cholesky(stiffness)
    expected = -nnls(root.T, -np.linalg.solve(root, condensed_load))[0]
    np.testing.assert_allclose(found[bounded], expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("solver", SOLVERS)
def test_refinement_mends_what_a_hardly_compressible_pore_fluid_costs(solver, monkeypatch):
    """The smaller C is in [[A, B], [B^T, -C]], the more digits its pivots cost; the matrix itself is not ill-conditioned."""
    matrix = saddle(compressibility=1e-8)
    held, one_sided = statuses(matrix.shape[0], 3)
    loads = np.random.default_rng(5).normal(size=(matrix.shape[0], 4)) * np.array([1e2, 1e-5])[np.arange(100) // 70, None]
    many = ManySolver(matrix, held, one_sided, solver, definite=False)
    block = many.solve_block(loads, np.arange(4))
    assert block.residual < 1e-10
    assert_solves(matrix, block, loads, held, one_sided, np.arange(4))
    if solver == "pardiso":  # SuperLU pivots further and may not need it
        monkeypatch.setattr("brainshift_ros.solvers.many.MOST_REFINEMENTS", 0)
        monkeypatch.setattr("brainshift_ros.solvers.direct.RESIDUAL_LIMIT", 1.0)
        assert many.solve_block(loads, np.arange(4)).residual > 10.0 * block.residual


@given(st.data())
@settings(max_examples=40, deadline=None)
def test_primal_and_dual_solve_any_set_of_held_dofs(data):
    size = data.draw(st.integers(1, 12))
    matrix = spd(size, data.draw(st.integers(0, 1000))).toarray()
    held = np.array(data.draw(st.lists(st.booleans(), min_size=size, max_size=size)))
    definite = data.draw(st.booleans())
    load = np.random.default_rng(0).normal(size=(size, 3))
    solution = HeldSystem(SchurComplement(matrix, definite), held).solve(load)
    expected = np.zeros_like(load)
    expected[~held] = np.linalg.solve(matrix[np.ix_(~held, ~held)], load[~held])
    np.testing.assert_allclose(solution, expected, atol=1e-10 * max(1.0, np.abs(expected).max()))


def test_floating_schur_complement_is_solved_where_constraints_hold_it():
    floating = np.array([[1.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
    schur = SchurComplement(floating, True)
    assert schur.inverse is None
    solution = HeldSystem(schur, np.array([True, False, False])).solve(np.ones((3, 1)))
    np.testing.assert_allclose(solution[:, 0], [0.0, 2.0, 3.0])
    with pytest.raises(ArithmeticError, match="rigid motion"):
        HeldSystem(schur, np.zeros(3, bool))


def test_sets_that_do_not_fit_the_cache_are_made_again(monkeypatch):
    matrix, (held, one_sided) = spd(), statuses(DISPLACEMENTS, 1)
    loads = np.random.default_rng(2).normal(size=(DISPLACEMENTS, 8))
    sets = np.tile(np.arange(4), 2)
    kept = CondensedSystem(matrix.toarray(), True, held, one_sided).solve(loads, sets)
    monkeypatch.setattr(condensed, "CACHE_BYTES", 1)
    system = CondensedSystem(matrix.toarray(), True, held, one_sided)
    for _ in range(2):
        for once, again in zip(kept[:2], system.solve(loads, sets), strict=False):
            np.testing.assert_allclose(again, once, atol=1e-12)


@pytest.mark.parametrize("solver", SOLVERS)
def test_memory_order_and_slices_of_loads_do_not_matter(solver):
    matrix, (held, one_sided) = spd(), statuses(DISPLACEMENTS, 6)
    wide = np.random.default_rng(7).normal(size=(DISPLACEMENTS, 12))
    sets = np.array([0, 1, 2, 3, 0, 1])
    many = ManySolver(matrix, held, one_sided, solver)
    expected = many.solve_block(np.ascontiguousarray(wide[:, ::2]), sets).solution
    for loads in (np.asfortranarray(wide[:, ::2]), wide[:, ::2], wide.T.copy().T[:, ::2]):
        np.testing.assert_allclose(many.solve_block(loads, sets).solution, expected, atol=1e-13)
    for column, number in enumerate(sets):
        alone = many.solve_block(wide[:, [2 * column]], [number]).solution
        np.testing.assert_allclose(alone[:, 0], expected[:, column], atol=1e-12)


@pytest.mark.parametrize("solver", SOLVERS)
def test_sets_that_are_equal_and_sets_that_hold_all_or_nothing(solver):
    matrix = spd()
    everything, nothing = np.ones(DISPLACEMENTS, bool), np.zeros(DISPLACEMENTS, bool)
    loads = np.random.default_rng(3).normal(size=(DISPLACEMENTS, 4))
    free = np.linalg.solve(matrix.toarray(), loads)
    for sets in ([everything], [nothing], [everything, nothing], [nothing, everything, nothing]):
        many = ManySolver(matrix, np.array(sets), solver=solver)
        for number, held in enumerate(sets):
            block = many.solve_block(loads, np.full(4, number))
            assert block.closed is None
            np.testing.assert_allclose(block.solution, np.where(held[:, None], 0.0, free), atol=1e-11)
    assert many.solve_block(loads[:, :0], np.zeros(0, int)).solution.shape == (DISPLACEMENTS, 0)


@pytest.mark.parametrize("solver", SOLVERS)
def test_zero_loads_touch_nothing(solver):
    held, one_sided = statuses(DISPLACEMENTS, 6)
    block = ManySolver(spd(), held, one_sided, solver).solve_block(np.zeros((DISPLACEMENTS, 2)), [0, 1])
    assert not block.solution.any()
    assert block.residual == 0.0


@pytest.mark.parametrize(("bad", "row"), list(itertools.product((np.nan, np.inf), (0, 10, 30))))
def test_loads_that_are_not_finite_are_refused(bad, row):
    held, one_sided = statuses(DISPLACEMENTS, 6)
    loads = np.ones((DISPLACEMENTS, 2))
    loads[row, 1] = bad
    with pytest.raises(InputError, match="not finite"):
        ManySolver(spd(), held, one_sided, "scipy").solve_block(loads, [0, 1])


@pytest.mark.parametrize("solver", SOLVERS)
def spring_chain(count):
    """Stiffness of free masses in a row, joined by springs: moving them all costs nothing."""
    ends = np.ones(count)
    ends[1:-1] = 2.0
    return sp.diags([-np.ones(count - 1), ends, -np.ones(count - 1)], [-1, 0, 1]).tocsr()


@pytest.mark.parametrize("solver", SOLVERS)
def test_body_that_nothing_holds_is_named(solver):
    chain = sp.block_diag([spring_chain(40), spring_chain(30)]).tocsr()
    held = np.zeros((2, 70), bool)
    held[:, 0] = True  # the first chain only
    loads = np.ones((70, 2))
    for sets in (held[:1], held | (np.arange(70) == [[3], [5]])):
        with pytest.raises(ArithmeticError, match="rigid motion"):
            ManySolver(chain, sets, solver=solver).solve_block(loads, np.arange(2) % len(sets))
    held[1, 50] = True  # held in one set, not in the other
    many = ManySolver(chain, held, solver=solver)
    assert many.solve_block(loads, [1, 1]).residual < 1e-12
    with pytest.raises(ArithmeticError, match="rigid motion"):
        many.solve_block(loads, [0, 1])
