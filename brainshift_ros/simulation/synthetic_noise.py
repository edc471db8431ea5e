"""Smooth random fields and dense grids from sparse ones: tensor products of one-dimensional splines."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline


def smooth_noise(rng: np.random.Generator, shape: Sequence[int], width: float) -> NDArray[np.float32]:
    """Gaussian random field: uniform cubic B-splines with independent coefficients `width` voxels apart.

    Mean 0 and standard deviation about 1; float32, of the given shape.
    """
    bases = [_uniform_basis(n, width) for n in shape]
    # The variance of a uniform cubic B-spline sum, averaged over the phase, is sum(integral of B^2) = 151/315 an axis.
    coefficients = rng.normal(size=[basis.shape[1] for basis in bases]) / (151.0 / 315.0) ** 1.5
    return tensor_product(bases, coefficients)


def interpolation_matrix(count: int, step: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes about `step` apart over indices 0 to count - 1, and the matrix of the cubic spline from nodes to indices."""
    nodes = np.linspace(0.0, count - 1.0, max(4, int(np.ceil((count - 1) / step)) + 1))
    return nodes, make_interp_spline(nodes, np.eye(len(nodes)), k=3)(np.arange(count))


def tensor_product(matrices: Sequence[NDArray], values: NDArray) -> NDArray[np.float32]:
    """Apply one matrix (n_fine, n_coarse) to each axis of `values`, in float32."""
    result = values.astype(np.float32)
    for axis, matrix in enumerate(matrices):
        result = np.moveaxis(np.tensordot(matrix.astype(np.float32), result, axes=(1, axis)), 0, axis)
    return np.ascontiguousarray(result)


def _uniform_basis(count: int, width: float) -> NDArray[np.float64]:
    x = np.arange(count) / width
    splines = int(np.ceil(x[-1])) + 3
    knots = np.arange(splines + 4) - 3.0
    return BSpline.design_matrix(x, knots, 3).toarray()
