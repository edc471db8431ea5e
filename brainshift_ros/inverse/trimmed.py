"""Half of the points that agree best with each other: least trimmed squares (Rousseeuw and Van Driessen 1999).

A least-squares fit is drawn to wrong points, the more so if they stand together and agree, and then hides them. So fits are
started from many small samples, some of which hold no wrong point; each is refined by concentration steps, which refit to the
half with the smallest residuals. A fit to four points of an atlas of hundreds of columns needs a prior: it is the Gaussian one
of :mod:`.prior` and :mod:`.discrepancy`, under which a fit is a few products of small matrices, done for all samples at once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.entry import WeightGroup
from brainshift_ros.inverse.discrepancy import TYPICAL_ERROR, correlation
from brainshift_ros.inverse.prior import weight_prior

#: Samples and points in each: of 45 % wrong points all samples hold one with a probability below 1 %.
_SAMPLES, _SAMPLE_SIZE = 64, 4

#: Concentration steps of all samples, and of the best few until they stand.
_FIRST_STEPS, _BEST, _MORE_STEPS = 2, 8, 10

#: Of more points a random part this large is looked at: what agrees there, all the others are then judged by.
_MOST_POINTS = 96

#: Patterns of the prior that hold less than this fraction of its variance are left out.
_NEGLIGIBLE = 1e-5


def agreeing_half(
    points: NDArray[np.float64],
    M: NDArray[np.float64],
    displacements: NDArray[np.float64],
    sigma: NDArray[np.float64],
    groups: Sequence[WeightGroup],
) -> NDArray[np.bool_]:
    """Find the half of the points, and one more, whose residuals to a fit of their own are smallest.

    Parameters
    ----------
    points, displacements
        Shape (n, 3), metres.
    M
        Shape (n, 3, m), the atlas at the points.
    sigma
        Shape (n,), standard deviation of a displacement component, metres.
    groups
        Of the columns.

    Returns
    -------
    Shape (n,), True for more than half of the points, or of 96 of them if they are more.
    """
    rng = np.random.default_rng(0)
    part = np.sort(rng.choice(len(points), min(len(points), _MOST_POINTS), replace=False))
    n = len(part)
    half = n // 2 + 1
    features, unexpected = _features(points[part], M[part], displacements[part], sigma[part], groups)
    size = min(_SAMPLE_SIZE, half)
    chosen = np.zeros((_SAMPLES, n), dtype=bool)
    np.put_along_axis(chosen, rng.random((_SAMPLES, n)).argsort(axis=1)[:, :size], True, axis=1)
    for _ in range(_FIRST_STEPS):
        chosen, score = _concentrate(features, unexpected, chosen, half)
    chosen = chosen[np.argsort(score, kind="stable")[:_BEST]]
    for _ in range(_MORE_STEPS):
        before = chosen
        chosen, score = _concentrate(features, unexpected, chosen, half)
        if np.array_equal(before, chosen):
            break
    agreeing = np.zeros(len(points), dtype=bool)
    agreeing[part[chosen[int(np.argmin(score))]]] = True
    return agreeing


def _features(
    points: NDArray[np.float64],
    M: NDArray[np.float64],
    displacements: NDArray[np.float64],
    sigma: NDArray[np.float64],
    groups: Sequence[WeightGroup],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Patterns (n, 3, k) of coefficients of unit prior variance, and the unexpected displacement (n, 3), both in sigmas."""
    n, _, m = M.shape
    prior = weight_prior(m, groups)
    rows = M.reshape(3 * n, m)
    shift = float(np.median(np.linalg.norm(displacements, axis=1)))
    discrepancy = (TYPICAL_ERROR * shift) ** 2 / 3.0 * correlation(points, points)
    covariance = rows @ prior.covariance_times(rows.T) + np.kron(discrepancy, np.eye(3))
    in_sigmas = np.repeat(1.0 / sigma, 3)
    values, vectors = np.linalg.eigh(covariance * np.outer(in_sigmas, in_sigmas))
    kept = values > _NEGLIGIBLE * values[-1]
    patterns = vectors[:, kept] * np.sqrt(values[kept])
    unexpected = (displacements - M @ prior.mean) / sigma[:, None]
    return patterns.reshape(n, 3, -1), unexpected


def _concentrate(
    features: NDArray[np.float64], unexpected: NDArray[np.float64], chosen: NDArray[np.bool_], half: int
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Fit to the chosen points (s, n), and choose those with the smallest residuals; also the sums of their squares, (s,)."""
    k = features.shape[2]
    squares = np.einsum("nck,ncl->nkl", features, features).reshape(len(features), -1)
    information = (chosen @ squares).reshape(-1, k, k) + np.eye(k)
    right = chosen @ np.einsum("nck,nc->nk", features, unexpected)
    coefficients = np.linalg.solve(information, right[:, :, None])[:, :, 0]
    residual = unexpected.reshape(-1) - coefficients @ features.reshape(-1, k).T
    length = np.linalg.norm(residual.reshape(len(chosen), -1, 3), axis=2)
    best = np.argsort(length, axis=1, kind="stable")[:, :half]
    chosen = np.zeros_like(chosen)
    np.put_along_axis(chosen, best, True, axis=1)
    return chosen, np.sum(np.take_along_axis(length, best, axis=1) ** 2, axis=1) + np.sum(coefficients**2, axis=1)
