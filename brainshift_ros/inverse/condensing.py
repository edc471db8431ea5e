"""Fewer rows for a problem of many more rows than columns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.linalg

from brainshift_ros.inverse.problem import WeightProblem


def condensed(problem: WeightProblem) -> WeightProblem | None:
    """Return a problem of almost the same minimisers and at most m rows, by a pivoted Cholesky factor of the Gram matrix.

    Forming ``A^T A`` takes a quarter of the time of a QR factorisation of A, but it knows the columns to half the digits
    only: directions in which they differ by less are cut off, which leaves KKT residuals up to 1e-9 on a real atlas. Who needs
    more starts from the condensed problem's answer and ends on the original rows.

    Returns
    -------
    None if condensing would not pay.
    """
    A, b = problem.A, problem.b
    rows, columns = A.shape
    if rows <= 2 * columns or not A.any():
        return None
    factor, pivots, rank, _ = scipy.linalg.lapack.dpstrf(A.T @ A)  # upper R with P^T A^T A P = R^T R
    order = pivots - 1
    R = np.zeros((rank, columns))
    R[:, order] = np.triu(factor)[:rank]
    right = scipy.linalg.solve_triangular(factor[:rank, :rank], (A.T @ b)[order[:rank]], trans="T")
    return replace(problem, A=R, b=right)
