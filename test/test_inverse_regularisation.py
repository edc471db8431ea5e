"""Tikhonov's factor chosen by generalised cross-validation and by the corner of the L-curve."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.inverse.methods import solve_weights
from brainshift_ros.inverse.problem import WeightProblem
from brainshift_ros.inverse.regularisation import Spectrum, gcv_factor, l_curve_curvature, l_curve_factor
from brainshift_ros.inverse.unconstrained import solve_tikhonov


def ill_posed(noise, seed=0, rows=60, columns=30, smallest=1e-6):
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(columns, columns)))[0]
    A = rng.normal(size=(rows, columns)) @ np.diag(np.logspace(0, np.log10(smallest), columns)) @ turn
    truth = turn.T @ rng.normal(size=columns)
    return WeightProblem(A, A @ truth + noise * rng.normal(size=rows)), truth


def test_the_curvature_is_that_of_the_curve():
    problem, _ = ill_posed(1e-2)
    spectrum = Spectrum.of(problem)
    factors = np.logspace(-10, 1, 400)
    weights = np.array([spectrum.weights(factor) for factor in factors])
    along = np.log(factors) / 2.0
    x = np.log(np.linalg.norm(weights @ problem.A.T - problem.b, axis=1))
    y = np.log(np.linalg.norm(weights, axis=1))
    dx, dy = np.gradient(x, along), np.gradient(y, along)
    expected = (dx * np.gradient(dy, along) - np.gradient(dx, along) * dy) / (dx**2 + dy**2) ** 1.5
    np.testing.assert_allclose(l_curve_curvature(spectrum, factors)[5:-5], expected[5:-5], atol=0.02)


@pytest.mark.parametrize(("choose", "slack"), [(gcv_factor, 1.5), (l_curve_factor, 3.0)])
@pytest.mark.parametrize("noise", [1e-1, 1e-2, 1e-3])
def test_the_automatic_choice_is_near_the_best(choose, slack, noise):
    found, best = [], []
    for seed in range(6):
        problem, truth = ill_posed(noise, seed)
        spectrum = Spectrum.of(problem)
        errors = [np.linalg.norm(problem.A @ (spectrum.weights(factor) - truth)) for factor in spectrum.candidates]
        found.append(np.linalg.norm(problem.A @ (spectrum.weights(choose(spectrum)) - truth)))
        best.append(min(errors))
    assert np.mean(found) < slack * np.mean(best)


def test_gcv_is_leave_one_out_on_a_rotated_problem():
    # Golub, Heath and Wahba: for a circulant problem every point has the same leverage, and GCV is exactly leave-one-out.
    rng = np.random.default_rng(3)
    n = 12
    A = np.array([np.roll(np.exp(-np.arange(n) / 2.0), k) for k in range(n)])
    problem = WeightProblem(A, A @ rng.normal(size=n) + 0.1 * rng.normal(size=n))
    spectrum = Spectrum.of(problem)

    def left_out(factor):
        errors = []
        for row in range(n):
            rest = np.arange(n) != row
            gram = A[rest].T @ A[rest] + factor * np.eye(n)
            errors.append(problem.b[row] - A[row] @ np.linalg.solve(gram, A[rest].T @ problem.b[rest]))
        return np.sum(np.square(errors))

    factors = spectrum.candidates[100:]
    assert gcv_factor(spectrum) == pytest.approx(factors[np.argmin([left_out(factor) for factor in factors])])


def test_the_corner_of_an_exact_fit_is_harmless():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(9, 20))
    for b in (A @ rng.uniform(size=20), np.zeros(9)):
        for method in ("tikhonov_gcv", "tikhonov_l_curve"):
            solution = solve_weights(WeightProblem(A, b), method)
            assert np.isfinite(solution.weights).all()
            assert solution.residual_norm <= np.linalg.norm(b)


@pytest.mark.parametrize("A", [np.zeros((4, 3)), np.ones((4, 3)), np.full((1, 1), 1e-200)])
def test_columns_without_content_are_harmless(A):
    problem = WeightProblem(A, np.arange(1.0, len(A) + 1.0))
    for method in ("least_squares", "tikhonov", "tikhonov_gcv", "tikhonov_l_curve"):
        assert np.isfinite(solve_weights(problem, method).weights).all()


def test_the_automatic_choices_are_3_7_with_their_factor():
    problem, _ = ill_posed(1e-2)
    for method in ("tikhonov_gcv", "tikhonov_l_curve"):
        automatic = solve_weights(problem, method)
        given = solve_tikhonov(problem, automatic.regularisation / np.trace(problem.A.T @ problem.A))
        np.testing.assert_allclose(automatic.weights, given.weights, rtol=1e-9)
        assert automatic.kkt_residual < 1e-13
