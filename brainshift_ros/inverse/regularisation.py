"""Automatic choice of the Tikhonov factor beta^2 of (3.7): generalised cross-validation and the L-curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.inverse.problem import WeightProblem

_TINY = float(np.finfo(np.float64).tiny)
_EPS = float(np.finfo(np.float64).eps)

#: Factors tried, in units of the largest singular value squared.
_CANDIDATES = np.logspace(-12, 2, 281)


@dataclass(frozen=True)
class Spectrum:
    """A problem in the basis of its singular vectors, in which every Tikhonov factor's answer is a few products.

    Attributes
    ----------
    singular
        Shape (k,), singular values of A, descending.
    right
        Shape (k, m), its right singular vectors.
    coefficients
        Shape (k,), b along the left singular vectors.
    outside
        Squared length of the part of b that no weights can fit.
    rows
        Of A.
    """

    singular: NDArray[np.float64]
    right: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    outside: float
    rows: int

    @classmethod
    def of(cls, problem: WeightProblem) -> Spectrum:
        """Decompose a problem."""
        U, singular, right = np.linalg.svd(problem.A, full_matrices=False)
        coefficients = U.T @ problem.b
        outside = problem.b - U @ coefficients
        return cls(singular, right, coefficients, float(outside @ outside), problem.b.size)

    @property
    def candidates(self) -> NDArray[np.float64]:
        """Factors worth a try."""
        return np.asarray(max(float(self.singular[0]), np.sqrt(_TINY) * 1e6) ** 2 * _CANDIDATES)

    def weights(self, factor: float) -> NDArray[np.float64]:
        """Shape (m,), minimiser of ``||A a - b||^2 + factor ||a||^2``."""
        return np.asarray((self.singular / (self.singular**2 + max(factor, _TINY)) * self.coefficients) @ self.right)


def gcv_factor(spectrum: Spectrum) -> float:
    """Factor that minimises generalised cross-validation (Golub, Heath, Wahba 1979)."""
    factors = spectrum.candidates
    damping = factors[:, None] / (spectrum.singular**2 + factors[:, None])
    residual = np.sum((damping * spectrum.coefficients) ** 2, axis=1) + spectrum.outside
    freedom = damping.sum(axis=1) + (spectrum.rows - spectrum.singular.size)
    return float(factors[np.argmin(residual / freedom**2)])


def l_curve_factor(spectrum: Spectrum) -> float:
    """Factor at the corner of the L-curve: of residual against weights, both norms in logarithms (Hansen 1992)."""
    factors = spectrum.candidates
    return float(factors[np.argmax(l_curve_curvature(spectrum, factors))])


def l_curve_curvature(spectrum: Spectrum, factors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Curvature of the L-curve, positive at its corner.

    Parameters
    ----------
    spectrum
        Of the problem.
    factors
        Shape (n,), positive Tikhonov factors beta^2.

    Returns
    -------
    curvature
        Shape (n,), of ``(log ||A a - b||, log ||a||)`` along beta, by Hansen's closed form (The L-curve and its use in the
        numerical treatment of inverse problems, 2001). Zero where either norm vanishes to round-off: an exact fit has no
        corner.
    """
    beta = np.sqrt(factors)
    passed = spectrum.singular**2 / (spectrum.singular**2 + factors[:, None])
    along = spectrum.coefficients / np.maximum(spectrum.singular, _TINY)
    eta = np.sum((passed * along) ** 2, axis=1)
    rho = np.sum(((1.0 - passed) * spectrum.coefficients) ** 2, axis=1) + spectrum.outside
    slope = -4.0 / beta * np.sum((1.0 - passed) * (passed * along) ** 2, axis=1)
    total = float(spectrum.coefficients @ spectrum.coefficients) + spectrum.outside
    meaningful = (eta > 0.0) & (slope < 0.0) & (rho > 100.0 * _EPS**2 * total)
    curvature = np.zeros(len(factors))
    eta, rho, slope, f, beta = (values[meaningful] for values in (eta, rho, slope, factors, beta))
    inner = f * slope * rho + 2.0 * beta * eta * rho + f**2 * eta * slope
    curvature[meaningful] = -2.0 * eta * rho / slope * inner / (f**2 * eta**2 + rho**2) ** 1.5
    return curvature
