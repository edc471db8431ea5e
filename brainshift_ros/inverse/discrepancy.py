"""How a brain differs from all that its atlas can say: a Gaussian random field (Kennedy and O'Hagan 2001).

Its components are independent, of mean zero, correlated over a length, and as large as a fraction of the shift that the
atlas expects at a place. That fraction, and how much the stated sigma falls short, are learnt from the measurement itself, by
its marginal likelihood under priors centred on what is typical.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

#: Typical length of the discrepancy as a fraction of the local shift, and how far its logarithm spreads between brains.
#: With the other constants here tuned for the best predictive density on simulated brains of other mesh, stiffness and
#: orientation; study `uncertainty` reports on others.
TYPICAL_ERROR = 0.2
_ERROR_SPREAD = 0.5

#: Correlation length of the discrepancy, metres.
LENGTH = 0.15

#: The local shift is not trusted to be smaller than this fraction of the measured one.
_LEAST_SHIFT = 0.2

#: How far the logarithm of the true over the stated sigma spreads; it is never taken below the stated one.
_SIGMA_SPREAD = 0.5

_ERRORS = TYPICAL_ERROR * np.exp(np.linspace(-1.4, 1.4, 8))
_SIGMA_FACTORS = np.array([1.0, 1.5, 2.25, 3.5, 7.0, 20.0])

_LARGE = 1e100

#: Single or double precision.
Real = TypeVar("Real", np.float32, np.float64)


@dataclass(frozen=True)
class Amplitudes:
    """What the measurement says of the size of its errors.

    Attributes
    ----------
    error
        Length of the discrepancy as a fraction of the local shift.
    sigma_factor
        True over stated standard deviation of the points, at least 1.
    """

    error: float
    sigma_factor: float


def local_shift(expected: NDArray[np.float64], expected_at_points: NDArray[np.float64], measured: float) -> NDArray[np.float64]:
    """Size of the shift to be reckoned with at places.

    Parameters
    ----------
    expected, expected_at_points
        Root mean square shift of the atlas's columns at the places, and at the points, metres.
    measured
        Root mean square of the measured shift, metres.
    """
    usual = float(np.sqrt(np.mean(expected_at_points**2)))
    return measured * np.maximum(expected / usual if usual > 0.0 else 0.0 * expected, _LEAST_SHIFT)


def correlation(a: NDArray[Real], b: NDArray[Real]) -> NDArray[Real]:
    """Correlation (n, k) of the discrepancy between places (n, 3) and (k, 3): Matern, once differentiable (3/2).

    Of the same precision as the places: single is enough, and faster, for the nodes of a large mesh.
    """
    scaled = (a[:, None, 0] - b[:, 0]) ** 2
    for axis in (1, 2):
        scaled += (a[:, None, axis] - b[:, axis]) ** 2
    np.sqrt(scaled, out=scaled)
    scaled *= float(np.sqrt(3.0)) / LENGTH
    decay = np.exp(-scaled)
    scaled += 1.0
    scaled *= decay
    return scaled


def likely_amplitudes(
    residual: NDArray[np.float64],
    of_weights: NDArray[np.float64],
    of_noise: NDArray[np.float64],
    of_discrepancy: NDArray[np.float64],
) -> Amplitudes:
    """Posterior mean of the variances over a grid of amplitudes.

    Parameters
    ----------
    residual
        Shape (r,), measured less expected displacement.
    of_weights, of_noise, of_discrepancy
        Shape (r, r), its covariance from the weights' prior, the stated noise, and a discrepancy of fraction 1.
    """
    factor, error = (grid.ravel() for grid in np.meshgrid(_SIGMA_FACTORS, _ERRORS, indexing="ij"))
    covariance = of_weights + factor[:, None, None] ** 2 * of_noise + error[:, None, None] ** 2 * of_discrepancy
    # With the residual as one more row, the factor's last row is the residual made white: one call does both. The corner only
    # has to be large enough.
    size = len(residual)
    bordered = np.empty((len(factor), size + 1, size + 1))
    bordered[:, :size, :size] = covariance
    bordered[:, size, :size] = bordered[:, :size, size] = residual
    bordered[:, size, size] = _LARGE
    lower = np.linalg.cholesky(bordered)
    log_determinant = 2.0 * np.log(np.diagonal(lower, axis1=1, axis2=2)[:, :size]).sum(axis=1)
    log_density = -0.5 * (np.sum(lower[:, size, :size] ** 2, axis=1) + log_determinant)
    log_prior = (np.log(error / TYPICAL_ERROR) / _ERROR_SPREAD) ** 2 + (np.log(factor) / _SIGMA_SPREAD) ** 2
    log_posterior = log_density - 0.5 * log_prior
    weight = np.exp(log_posterior - log_posterior.max())
    weight /= weight.sum()
    return Amplitudes(float(np.sqrt(weight @ error**2)), float(np.sqrt(weight @ factor**2)))
