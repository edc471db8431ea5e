"""Direct solvers against dense algebra, and their failures."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from threadpoolctl import threadpool_info

from brainshift_ros.errors import InputError
from brainshift_ros.solvers import direct
from brainshift_ros.solvers.many import ManySolver
from brainshift_ros.solvers.pardiso import Pardiso, PardisoError
from brainshift_ros.solvers.product import MklProduct, SciPyProduct
from brainshift_ros.solvers.threads import one_blas_thread

SOLVERS = ("pardiso", "scipy")


@pytest.fixture(scope="module")
def spd():
    a = sp.random(150, 150, 0.03, random_state=0)
    return (a @ a.T + sp.eye(150)).tocsr()


@pytest.mark.parametrize("solver", SOLVERS)
def test_many_right_hand_sides(spd, solver):
    rhs = np.random.default_rng(0).normal(size=(150, 7))
    factorization = direct.factorize(spd, solver)
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
    condensation = direct.condense(spd, retained, solver)
    np.testing.assert_allclose(condensation.schur, expected, atol=1e-12)
    rhs = rng.normal(size=(150, 3))
    work = condensation.forward(rhs)
    work[retained] = np.linalg.solve(expected, work[retained])
    np.testing.assert_allclose(condensation.backward(work), np.linalg.solve(dense, rhs), atol=1e-11)


@pytest.fixture(scope="module")
def saddle(spd):
    """Quasi-definite: what a body that holds a fluid gives."""
    coupling = sp.random(150, 40, 0.1, random_state=1)
    return sp.bmat([[spd, coupling], [coupling.T, -1e-2 * sp.eye(40)]]).tocsr()


@pytest.mark.parametrize("solver", SOLVERS)
def test_quasi_definite_matrix_is_solved_whole_and_condensed(saddle, solver):
    rng = np.random.default_rng(4)
    rhs, dense = rng.normal(size=(190, 5)), saddle.toarray()
    expected = np.linalg.solve(dense, rhs)
    np.testing.assert_allclose(direct.factorize(saddle, solver, definite=False).solve(rhs), expected, atol=1e-9)
    retained = np.zeros(190, bool)
    retained[rng.choice(190, 30, replace=False)] = True
    assert retained[:150].any()
    assert retained[150:].any()
    condensation = direct.condense(saddle, retained, solver, definite=False)
    work = condensation.forward(rhs)
    work[retained] = np.linalg.solve(condensation.schur, work[retained])
    np.testing.assert_allclose(condensation.backward(work), expected, atol=1e-9)


def test_equilibration_makes_all_rows_of_like_size(saddle):
    size = sp.diags(10.0 ** np.random.default_rng(0).uniform(-6, 6, 190))
    badly_scaled = (size @ saddle @ size).tocsr()
    weight = direct.equilibration(badly_scaled)
    largest = abs(sp.diags(weight) @ badly_scaled @ sp.diags(weight)).max(axis=1).toarray()
    assert np.all((largest > 0.5) & (largest < 2.0))
    empty_row = sp.diags([4.0, 0.0]).tocsr()
    np.testing.assert_allclose(direct.equilibration(empty_row), [0.5, 1.0])


@pytest.mark.parametrize("order", ["C", "F"])
def test_mkl_and_scipy_give_the_same_residual(order):
    rng = np.random.default_rng(1)
    matrix = sp.random(60, 60, 0.1, format="csr", random_state=2)
    x, b = (np.asarray(rng.normal(size=(60, 5)), order=order) for _ in range(2))
    for product in (MklProduct(matrix), SciPyProduct(matrix)):
        np.testing.assert_allclose(product.residual(x, b), matrix.toarray() @ x - b, atol=1e-13)
        assert product.residual(x[:, :0], b[:, :0]).shape == (60, 0)


def test_blas_threads_are_given_back():
    def threads():
        return {pool["filepath"]: pool["num_threads"] for pool in threadpool_info() if pool["internal_api"] == "openblas"}

    before = threads()
    with one_blas_thread():
        assert set(threads().values()) == {1}
    assert threads() == before


@pytest.mark.parametrize("solver", SOLVERS)
def test_cases_with_different_constraints_share_one_factorisation(spd, solver, monkeypatch):
    monkeypatch.setattr("brainshift_ros.solvers.many.BLOCK", 4)  # several blocks
    rng = np.random.default_rng(2)
    sets = np.zeros((3, 150), bool)
    sets[:, :10] = True
    sets[0, 20:40] = sets[1, 30:60] = True
    set_of_case = [0, 1, 2, 2, 0, 1, 0, 2, 1]
    rhs = rng.normal(size=(150, len(set_of_case)))
    many = ManySolver(spd, sets, solver=solver)
    assert many.variable_count == 40
    seen = {}
    for block in many.solve(set_of_case, lambda cases: rhs[:, cases]):
        assert block.residual < 1e-12
        seen.update({case: block.solution[:, k] for k, case in enumerate(block.cases)})
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
    many = ManySolver(spd, sets, solver="scipy")
    (block,) = many.solve([0, 0], lambda cases: rhs)
    assert many.variable_count == 0
    np.testing.assert_allclose(block.solution[5:], np.linalg.solve(spd.toarray()[5:, 5:], rhs[5:]), atol=1e-11)


def test_indefinite_matrix_is_refused_by_pardiso():
    with pytest.raises(PardisoError, match="not positive definite"):
        Pardiso(sp.diags([1.0, -1.0, 1.0]).tocsr())


def test_singular_matrix_is_refused_by_superlu():
    with pytest.raises(ArithmeticError, match="singular"):
        direct.factorize(sp.csr_matrix(np.ones((3, 3))), "scipy")


@pytest.mark.parametrize("residual", [1e-3, np.nan])
def test_bad_residual_is_refused(residual):
    with pytest.raises(ArithmeticError, match="residual"):
        direct.assert_residual(residual, "scipy")


def test_residual_is_relative_and_counts_only_equations():
    matrix = sp.eye(3).tocsr()
    rhs, solution = np.array([[2.0], [0.0], [5.0]]), np.array([[1.0], [0.0], [0.0]])
    assert direct.relative_residual(matrix, solution, rhs, np.array([[True], [True], [False]])) == pytest.approx(0.5)


def test_without_mkl_auto_is_scipy_and_pardiso_is_an_input_error(monkeypatch, spd):
    def missing():
        raise OSError("libmkl_rt.so: cannot open shared object file")

    monkeypatch.setattr(direct, "load_mkl", missing)
    assert direct.factorize(spd, "auto").name == "scipy"
    with pytest.raises(InputError, match="MKL cannot be loaded"):
        direct.factorize(spd, "pardiso")


def test_unknown_solver_is_refused(spd):
    with pytest.raises(InputError, match="unknown solver 'umfpack'"):
        direct.factorize(spd, "umfpack")
