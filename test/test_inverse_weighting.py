"""Whitened rows: (8.3) to (8.5)."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.inverse.methods import solve_weights
from brainshift_ros.inverse.weighting import weighted_problem

RNG = np.random.default_rng(0)
M = RNG.normal(size=(7, 3, 4))
U = RNG.normal(size=(7, 3))
SIGMA = RNG.uniform(0.5, 2.0, 7)
FACTOR = RNG.normal(size=(7, 7))
COVARIANCE = FACTOR @ FACTOR.T + 0.1 * np.eye(7)


def test_weighted_least_squares_is_equation_8_4():
    W = np.kron(np.linalg.inv(COVARIANCE), np.eye(3))
    A, b = M.reshape(21, 4), U.reshape(21)
    expected = np.linalg.solve(A.T @ W @ A, A.T @ W @ b)
    found = solve_weights(weighted_problem(M, U, COVARIANCE, ()), "least_squares")
    np.testing.assert_allclose(found.weights, expected, rtol=1e-10)
    residual = A @ expected - b
    assert found.residual_norm**2 == pytest.approx(residual @ W @ residual)


def test_a_diagonal_covariance_is_a_sigma_each():
    by_sigma = weighted_problem(M, U, SIGMA, ())
    by_covariance = weighted_problem(M, U, np.diag(SIGMA**2), ())
    np.testing.assert_allclose(by_covariance.A, by_sigma.A, rtol=1e-13)
    np.testing.assert_allclose(by_covariance.b, by_sigma.b, rtol=1e-13)
    np.testing.assert_array_equal(by_sigma.A[3:6], M[1] / SIGMA[1])


def test_two_points_that_err_together_count_as_one():
    # Both measure the same with the same error: alone, a second one would halve the variance.
    twice, there = np.repeat(M[:1], 2, axis=0), np.repeat(U[:1], 2, axis=0)
    together = weighted_problem(twice, there, np.array([[1.0, 1.0 - 1e-9], [1.0 - 1e-9, 1.0]]), ())
    once = weighted_problem(M[:1], U[:1], np.ones(1), ())
    np.testing.assert_allclose(together.A.T @ together.A, once.A.T @ once.A, rtol=1e-6)


@pytest.mark.parametrize(
    ("displacements", "noise", "match"),
    [
        (U[:6], SIGMA, "does not match"),
        (U, SIGMA[:6], "does not match"),
        (U, np.zeros(7), "positive"),
        (U, -COVARIANCE, "positive definite"),
    ],
)
def test_malformed_weights_are_refused(displacements, noise, match):
    with pytest.raises(ValueError, match=match):
        weighted_problem(M, displacements, noise, ())
