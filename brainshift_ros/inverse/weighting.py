"""Measured points as a least-squares problem in which every row counts by how sure it is: (8.3) to (8.6)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from brainshift_ros.atlas.entry import WeightGroup
from brainshift_ros.inverse.problem import WeightProblem


def weighted_problem(
    M: NDArray[np.float64], displacements: NDArray[np.float64], noise: NDArray[np.float64], groups: Sequence[WeightGroup]
) -> WeightProblem:
    """Minimise ``(M a - u)^T W (M a - u)`` with ``W = Cov^-1`` (8.5), as an ordinary least-squares problem.

    Rows and displacements are whitened: multiplied by the inverse of a factor of the covariance, so that their errors have
    unit variance and no correlation. Components x, y and z of a point err alike and independently of each other.

    Parameters
    ----------
    M
        Shape (n, 3, m), the atlas at the points, metres per unit weight.
    displacements
        Shape (n, 3), metres.
    noise
        Standard deviation of a displacement component of each point, shape (n,), metres, positive; or the covariance of a
        component over the points, shape (n, n), metres squared, positive definite.
    groups
        As for :class:`WeightProblem`.

    Returns
    -------
    Problem of 3 n rows, three a point in the order of `M`; without correlation, rows 3 i to 3 i + 2 are those of point i.

    Raises
    ------
    ValueError
        Shapes do not match, a standard deviation is not positive, or the covariance is not positive definite.
    """
    n, _, m = M.shape
    if displacements.shape != (n, 3) or noise.shape not in ((n,), (n, n)):
        raise ValueError(f"M of shape {M.shape} does not match displacements {displacements.shape} and noise {noise.shape}")
    if noise.ndim == 1:
        if not (noise > 0.0).all():
            raise ValueError("standard deviations must be positive")
        A, b = M / noise[:, None, None], displacements / noise[:, None]
    else:
        try:
            factor = np.linalg.cholesky(noise)
        except np.linalg.LinAlgError as error:
            raise ValueError("the covariance is not positive definite") from error
        A = scipy.linalg.solve_triangular(factor, M.reshape(n, 3 * m), lower=True)
        b = scipy.linalg.solve_triangular(factor, displacements, lower=True)
    return WeightProblem(A.reshape(3 * n, m), b.reshape(3 * n), tuple(groups))
