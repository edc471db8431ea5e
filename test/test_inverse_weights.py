"""Weights: the exact active set against SciPy and OSQP, the conditions of optimality, and the unconstrained methods."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from brainshift_ros.atlas.entry import WeightGroup
from brainshift_ros.errors import InputError
from brainshift_ros.inverse.methods import METHODS, solve_weights
from brainshift_ros.inverse.problem import WeightProblem, group_sums, kkt_residual
from brainshift_ros.inverse.unconstrained import solve_tikhonov


@st.composite
def problems(draw):
    """Problems of all shapes, with duplicate, nearly duplicate, zero and collinear columns, and one or two sums."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rows, columns = draw(st.integers(1, 30)), draw(st.integers(1, 50))
    A = rng.normal(size=(rows, columns)) * 10.0 ** draw(st.integers(-3, 3))
    rank = draw(st.integers(1, 8))
    if draw(st.booleans()):
        A = rng.normal(size=(rows, rank)) @ rng.normal(size=(rank, columns)) + 1e-3 * A
    if columns > 4 and draw(st.booleans()):
        A[:, 1] = A[:, 0]
        A[:, 2] = A[:, 0] * (1.0 + 1e-13)
        A[:, 3] = 2.0 * A[:, 0]
        A[:, 4] = 0.0
    truth = np.zeros(columns)
    chosen = rng.choice(columns, min(4, columns), replace=False)
    truth[chosen] = rng.uniform(0.0, 1.0, chosen.size)
    b = draw(st.sampled_from([0.3, 1.0, 3.0, -1.0])) * (A @ truth)
    b = b + draw(st.sampled_from([0.0, 0.1])) * np.abs(b).mean() * rng.normal(size=rows)
    cut = draw(st.integers(0, columns))
    groups = tuple(
        WeightGroup(name, tuple(range(*ends)), limit)
        for name, ends, limit in (("gravity", (0, cut), 1.0), ("retraction", (cut, columns), draw(st.sampled_from([0.5, 1.0]))))
        if ends[0] < ends[1]
    )
    return WeightProblem(A, b, groups)


@settings(max_examples=100, deadline=None)
@given(problems())
def test_the_active_set_is_exact(problem):
    solution = solve_weights(problem)
    assert solution.converged
    assert solution.kkt_residual < 1e-12
    assert (solution.weights >= 0.0).all()
    assert (group_sums(solution.weights, problem.groups) <= problem.limits * (1 + 1e-12)).all()


@settings(max_examples=60, deadline=None)
@given(problems())
def test_no_other_solver_finds_less(problem):
    ours = solve_weights(problem)
    theirs = solve_weights(problem, "nnls")
    scale = np.linalg.norm(problem.b) + 1e-300
    # Their sums are penalised rather than held, so they may cheat by their own violation.
    assert ours.residual_norm / scale <= theirs.residual_norm / scale + 1e-5
    assert theirs.kkt_residual < 1e-3


@settings(max_examples=10, deadline=None)
@given(problems())
def test_osqp_agrees(problem):
    ours, theirs = solve_weights(problem), solve_weights(problem, "osqp")
    if theirs.converged:
        assert ours.residual_norm == pytest.approx(theirs.residual_norm, abs=2e-3 * np.linalg.norm(problem.b))


def test_agrees_with_sequential_quadratic_programming():
    rng = np.random.default_rng(5)
    A, b = rng.normal(size=(12, 6)), 3.0 * rng.normal(size=12)
    problem = WeightProblem(A, b, (WeightGroup("gravity", (0, 1, 2, 3)), WeightGroup("retraction", (4, 5), 0.7)))
    limits = [{"type": "ineq", "fun": lambda a, g=g: g.sum_limit - a[list(g.columns)].sum()} for g in problem.groups]
    reference = minimize(
        lambda a: np.sum((A @ a - b) ** 2), np.zeros(6), method="SLSQP", bounds=[(0, None)] * 6, constraints=limits,
        options={"ftol": 1e-14, "maxiter": 500},
    )  # fmt: skip
    np.testing.assert_allclose(solve_weights(problem).weights, reference.x, atol=1e-6)


def test_by_hand():
    # Nearest point of the simplex {a >= 0, sum <= 1} to (1, 0.5) is (0.75, 0.25); to (-1, 0.5) it is (0, 0.5).
    group = (WeightGroup("gravity", (0, 1)),)
    corner = solve_weights(WeightProblem(np.eye(2), np.array([1.0, 0.5]), group))
    np.testing.assert_allclose(corner.weights, [0.75, 0.25], atol=1e-15)
    assert corner.saturated == ("gravity",)
    inner = solve_weights(WeightProblem(np.eye(2), np.array([-1.0, 0.5]), group))
    np.testing.assert_allclose(inner.weights, [0.0, 0.5], atol=1e-15)
    assert inner.saturated == ()


def test_many_rows_are_condensed_without_loss():
    rng = np.random.default_rng(2)
    A = rng.normal(size=(900, 40)) @ np.diag(10.0 ** rng.uniform(-2, 0, 40))
    A[:, 7] = A[:, 3]
    problem = WeightProblem(A, A @ np.full(40, 0.02) + 0.1 * rng.normal(size=900), (WeightGroup("gravity", tuple(range(40))),))
    solution = solve_weights(problem)
    assert solution.kkt_residual < 1e-14
    assert solution.residual_norm == pytest.approx(solve_weights(problem, "nnls").residual_norm, rel=1e-9)


def test_the_size_of_a_real_atlas():
    rng = np.random.default_rng(4)
    parameters = rng.normal(size=(720, 6))
    A = np.tanh(0.3 * parameters @ rng.normal(size=(6, 60))).T + 1e-3 * rng.normal(size=(60, 720))
    problem = WeightProblem(A, 1.2 * A[:, :3].mean(axis=1), (WeightGroup("gravity", tuple(range(720))),))
    solution = solve_weights(problem)
    assert solution.kkt_residual < 1e-12
    assert 1 <= np.count_nonzero(solution.weights) <= 61


@pytest.mark.parametrize("b", [np.zeros(3), np.full(3, 1e-300)])
def test_no_shift_gives_no_weights(b):
    solution = solve_weights(WeightProblem(np.eye(3), b, (WeightGroup("gravity", (0, 1, 2)),)))
    np.testing.assert_allclose(solution.weights, 0.0, atol=1e-290)
    assert np.isfinite(solution.kkt_residual)


def test_a_shift_against_every_column_gives_no_weights():
    solution = solve_weights(WeightProblem(np.abs(np.random.default_rng(0).normal(size=(5, 8))), -np.ones(5)))
    assert not solution.weights.any()
    assert solution.kkt_residual == 0.0


@pytest.mark.parametrize("rows", [2, 9])
def test_columns_of_zeros_get_no_weight(rows):
    solution = solve_weights(WeightProblem(np.zeros((rows, 3)), np.ones(rows), (WeightGroup("gravity", (0, 1, 2)),)))
    assert not solution.weights.any()
    assert solution.converged


def test_one_column():
    solution = solve_weights(WeightProblem(np.array([[2.0], [0.0]]), np.array([1.0, 5.0]), (WeightGroup("gravity", (0,)),)))
    np.testing.assert_allclose(solution.weights, [0.5])


@pytest.mark.parametrize("wrong", [[0.76, 0.25], [0.74, 0.25], [0.75, 0.30], [0.7, 0.2], [1.0, 0.0], [0.0, 0.0], [1.1, -0.1]])
def test_the_kkt_residual_sees_wrong_answers(wrong):
    problem = WeightProblem(np.eye(2), np.array([1.0, 0.5]), (WeightGroup("gravity", (0, 1)),))
    assert kkt_residual(problem, np.array([0.75, 0.25])) < 1e-15
    assert kkt_residual(problem, np.array(wrong)) > 1e-3


def test_least_squares_is_the_pseudo_inverse():
    rng = np.random.default_rng(1)
    problem = WeightProblem(rng.normal(size=(9, 20)), rng.normal(size=9))
    solution = solve_weights(problem, "least_squares")
    np.testing.assert_allclose(solution.weights, np.linalg.pinv(problem.A) @ problem.b, atol=1e-12)
    assert solution.kkt_residual < 1e-13


def test_tikhonov_is_equation_3_7():
    rng = np.random.default_rng(1)
    problem = WeightProblem(rng.normal(size=(9, 20)), rng.normal(size=9))
    solution = solve_tikhonov(problem, 0.01)
    beta_squared = 0.01 * np.trace(problem.A.T @ problem.A)
    expected = np.linalg.solve(problem.A.T @ problem.A + beta_squared * np.eye(20), problem.A.T @ problem.b)
    np.testing.assert_allclose(solution.weights, expected, atol=1e-12)
    assert solution.regularisation == pytest.approx(beta_squared)
    assert solution.kkt_residual < 1e-14
    with pytest.raises(ValueError, match="positive"):
        solve_tikhonov(problem, 0.0)


def test_gcv_beats_too_little_and_too_much_regularisation():
    rng = np.random.default_rng(7)
    errors = {"tikhonov_gcv": 0.0, "least_squares": 0.0, "too much": 0.0}
    for _ in range(20):
        A = rng.normal(size=(60, 30)) @ np.diag(np.logspace(0, -3, 30))
        truth = rng.normal(size=30)
        problem = WeightProblem(A, A @ truth + 0.05 * rng.normal(size=60))
        for name in errors:
            solution = solve_tikhonov(problem, 10.0) if name == "too much" else solve_weights(problem, name)
            errors[name] += float(np.sum((A @ (solution.weights - truth)) ** 2))
    assert errors["tikhonov_gcv"] < 0.8 * errors["least_squares"]
    assert errors["tikhonov_gcv"] < 0.8 * errors["too much"]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_fits_a_determined_problem(method):
    rng = np.random.default_rng(3)
    A = rng.normal(size=(30, 4))
    problem = WeightProblem(A, A @ [0.2, 0.1, 0.4, 0.2], (WeightGroup("gravity", (0, 1, 2, 3)),))
    solution = solve_weights(problem, method)
    assert solution.method == method
    np.testing.assert_allclose(solution.weights, [0.2, 0.1, 0.4, 0.2], atol=5e-3)


def test_an_unknown_method_is_named():
    with pytest.raises(InputError, match=r"'magic'.*constrained"):
        solve_weights(WeightProblem(np.eye(1), np.ones(1)), "magic")


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"b": np.ones(4)}, "does not match"),
        ({"A": np.ones((3, 0))}, "nothing to fit"),
        ({"A": np.array([[np.nan, 1.0], [0.0, 1.0], [1.0, 1.0]])}, "finite"),
        ({"groups": (WeightGroup("a", (0, 1)), WeightGroup("b", (1,)))}, "more than one group"),
        ({"groups": (WeightGroup("a", (2,)),)}, "outside 0..1"),
        ({"groups": (WeightGroup("a", (0,), 0.0),)}, "positive"),
    ],
)
def test_malformed_problems_are_refused(changes, match):
    problem = WeightProblem(np.ones((3, 2)), np.ones(3))
    with pytest.raises(ValueError, match=match):
        replace(problem, **changes)
