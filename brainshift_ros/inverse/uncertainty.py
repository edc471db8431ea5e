"""Standard deviation of the estimated displacement at every node.

Two parts, added in quadrature, each of a displacement *component*:

- *Noise*: the covariance of the weights in use, propagated through their columns. The data term is scaled up by the
  reduced chi-square where the residuals exceed the stated sigma; a prior of variance 1/12 (a weight that may be anything
  between 0 and 1) bounds what the data do not determine, such as the split between duplicate columns.
- *Model*: the part of the residual that noise does not explain, everywhere; and a fraction of the shift that grows with
  the distance to the nearest measured point, since a model that fits at the craniotomy is less sure elsewhere.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from brainshift_ros.inverse.problem import WeightProblem

#: Variance of a weight about which nothing is known but that it lies between 0 and 1.
_PRIOR_VARIANCE = 1.0 / 12.0

#: Far from all points a component of the field is taken to be wrong by this fraction of the local shift. Deep targets are
#: corrected by about three quarters in such models, so an error of |u| / 4, which is |u| / 4 / sqrt(3) a component.
_FAR_FRACTION = 0.25 / np.sqrt(3.0)

#: The local shift is not trusted to be smaller than this fraction of the measured one.
_LEAST_SHIFT = 0.2

#: Distance over which the model's error grows to its far value, metres.
_GROWTH_LENGTH = 0.03


def weight_covariance(
    problem: WeightProblem, active: NDArray[np.int64], saturated: tuple[str, ...], variance_scale: float
) -> NDArray[np.float64]:
    """Covariance of the weights of the active columns, with saturated sums kept fixed.

    Parameters
    ----------
    problem
        The weighted problem.
    active
        Shape (k,), columns with non-zero weights.
    saturated
        Names of the groups whose sum is at its limit.
    variance_scale
        Factor on the variance of the data (1 if residuals are as large as sigma says).

    Returns
    -------
    Shape (k, k), dimensionless.
    """
    sums = [np.isin(active, group.columns).astype(np.float64) for group in problem.groups if group.name in saturated]
    Z = scipy.linalg.null_space(np.array(sums)) if sums else np.eye(active.size)
    A = problem.A[:, active] @ Z
    information = A.T @ A / variance_scale + np.eye(Z.shape[1]) / _PRIOR_VARIANCE
    return Z @ np.linalg.solve(information, Z.T)


def reduced_chi_square(residual_norm: float, rows: int, parameters: int) -> float:
    """``||r||^2`` per degree of freedom, of residuals divided by their sigma; at least one degree is left."""
    return residual_norm**2 / max(rows - parameters, 1)


def node_std(
    nodes: NDArray[np.float64],
    columns: NDArray,
    covariance: NDArray[np.float64],
    displacement: NDArray[np.float64],
    measured_points: NDArray[np.float64],
    measured_shift: float,
    model_variance: float,
) -> NDArray[np.float64]:
    """Estimate the standard deviation of a component of the field at each node.

    Parameters
    ----------
    nodes
        Shape (N, 3), metres.
    columns
        Shape (N, 3, k), the active columns, metres per unit weight.
    covariance
        Shape (k, k), of their weights.
    displacement
        Shape (N, 3), the estimated field, metres.
    measured_points
        Shape (n, 3), the points in use, metres.
    measured_shift
        Mean length of the measured displacements, metres.
    model_variance
        Variance of a residual component that noise does not explain, m^2.

    Returns
    -------
    Shape (N,), metres.
    """
    values, vectors = np.linalg.eigh(covariance)
    spread = columns @ (vectors * np.sqrt(np.maximum(values, 0.0))).astype(columns.dtype)
    noise = np.mean(np.sum(spread.astype(np.float64) ** 2, axis=2), axis=1)
    distance, _ = cKDTree(measured_points).query(nodes)
    shift = np.maximum(np.linalg.norm(displacement, axis=1), _LEAST_SHIFT * measured_shift)
    growing = _FAR_FRACTION * shift * (1.0 - np.exp(-distance / _GROWTH_LENGTH))
    return np.sqrt(noise + model_variance + growing**2)
