"""Direct solvers against dense algebra, and their failures."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics import solvers
from brainshift_ros.mechanics.many import ManySolver
from brainshift_ros.mechanics.pardiso import Pardiso, PardisoError

SOLVERS = ("pardiso", "scipy")


@pytest.fixture(scope="module")
def spd():
    a = sp.random(150, 150, 0.03, random_state=0)
    return (a @ a.T + sp.eye(150)).tocsr()


@pytest.mark.parametrize("solver", SOLVERS)
def test_many_right_hand_sides(spd, solver):
    rhs = np.random.default_rng(0).normal(size=(150, 7))
    factorization = solvers.factorize(spd, solver)
    assert factorization.name == solver
    np.testing.assert_allclose(factorization.solve(rhs), np.linalg.solve(spd.toarray(), rhs), atol=1e-11)
    # The memory order of the block must not matter.
    np.testing.assert_array_equal(factorization.solve(np.asfortranarray(rhs)), factorization.solve(rhs))


@pytest.mark.parametrize("solver", SOLVERS)
def test_schur_complement_and_both_substitutions(spd, solver):
    rng = np.random.default_rng(1)
    retained = np.zeros(150, bool)
    retained[rng.choice(150, 20, replace=False)] = True
    dense, inner = spd.toarray(), ~retained
    coupling = dense[np.ix_(retained, inner)]
    expected = dense[np.ix_(retained, retained)] - coupling @ np.linalg.solve(dense[np.ix_(inner, inner)], coupling.T)
    condensation = solvers.condense(spd, retained, solver)
    np.testing.assert_allclose(condensation.schur, expected, atol=1e-12)
    rhs = rng.normal(size=(150, 3))
    work = condensation.forward(rhs)
    work[retained] = np.linalg.solve(expected, work[retained])
    np.testing.assert_allclose(condensation.backward(work), np.linalg.solve(dense, rhs), atol=1e-11)


@pytest.mark.parametrize("solver", SOLVERS)
def test_cases_with_different_constraints_share_one_factorisation(spd, solver, monkeypatch):
    monkeypatch.setattr("brainshift_ros.mechanics.many.BLOCK", 4)  # several blocks
    rng = np.random.default_rng(2)
    sets = np.zeros((3, 150), bool)
    sets[:, :10] = True
    sets[0, 20:40] = sets[1, 30:60] = True
    set_of_case = [0, 1, 2, 2, 0, 1, 0, 2, 1]
    rhs = rng.normal(size=(150, len(set_of_case)))
    many = ManySolver(spd, sets, solver)
    assert many.variable_count == 40
    seen = {}
    for cases, solution, residual in many.solve(set_of_case, lambda cases: rhs[:, cases]):
        assert residual < 1e-12
        seen.update({case: solution[:, k] for k, case in enumerate(cases)})
    assert sorted(seen) == list(range(len(set_of_case)))
    for case, chosen in enumerate(set_of_case):
        free = ~sets[chosen]
        expected = np.zeros(150)
        expected[free] = np.linalg.solve(spd.toarray()[np.ix_(free, free)], rhs[free, case])
        np.testing.assert_allclose(seen[case], expected, atol=1e-11)


def test_one_constraint_set_needs_no_condensation(spd):
    sets = np.zeros((1, 150), bool)
    sets[0, :5] = True
    rhs = np.ones((150, 2))
    many = ManySolver(spd, sets, "scipy")
    ((_, solution, _),) = many.solve([0, 0], lambda cases: rhs)
    assert many.variable_count == 0
    np.testing.assert_allclose(solution[5:], np.linalg.solve(spd.toarray()[5:, 5:], rhs[5:]), atol=1e-11)


def test_indefinite_matrix_is_refused_by_pardiso():
    with pytest.raises(PardisoError, match="not positive definite"):
        Pardiso(sp.diags([1.0, -1.0, 1.0]).tocsr())


def test_singular_matrix_is_refused_by_superlu():
    with pytest.raises(ArithmeticError, match="singular"):
        solvers.factorize(sp.csr_matrix(np.ones((3, 3))), "scipy")


@pytest.mark.parametrize("residual", [1e-3, np.nan])
def test_bad_residual_is_refused(residual):
    with pytest.raises(ArithmeticError, match="residual"):
        solvers.assert_residual(residual, "scipy")


def test_residual_is_relative_and_counts_only_equations():
    matrix = sp.eye(3).tocsr()
    rhs, solution = np.array([[2.0], [0.0], [5.0]]), np.array([[1.0], [0.0], [0.0]])
    assert solvers.relative_residual(matrix, solution, rhs, np.array([[True], [True], [False]])) == pytest.approx(0.5)


def test_without_mkl_auto_is_scipy_and_pardiso_is_an_input_error(monkeypatch, spd):
    def missing():
        raise OSError("libmkl_rt.so: cannot open shared object file")

    monkeypatch.setattr(solvers, "load_mkl", missing)
    assert solvers.factorize(spd, "auto").name == "scipy"
    with pytest.raises(InputError, match="MKL cannot be loaded"):
        solvers.factorize(spd, "pardiso")


def test_unknown_solver_is_refused(spd):
    with pytest.raises(InputError, match="unknown solver 'umfpack'"):
        solvers.factorize(spd, "umfpack")
