"""How the error of an interpolated displacement grows with the distance to the nearest measured feature (appendix E)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.correspondence.plane_spline import LEAST_POINTS, PlaneSpline, fit_spline

_CENTIMETRE_M = 1e-2
_SIDES, _SIDE_SHARES = 12, (0.08, 0.15, 0.25, 0.5)
_DISC_M = 6e-3

#: What holds without data, from simulated scans: floor, error at one centimetre (both lognormal), power (normal).
_PRIOR_FLOOR_M, _PRIOR_1CM_M, _PRIOR_POWER = 0.1e-3, 0.2e-3, 1.6
_PRIOR_SPREAD = (np.log(2.0), np.log(3.0), 0.5)
_PRIOR_CORRELATION_M = 8e-3
_POWERS = (0.5, 2.5)

_FREEDOM = 4.0  # of Student's t: a wrong point among the held-out ones must not decide
_ONE_SIGMA_OF_T = 1.142  # 68 % of t with 4 degrees of freedom lie within
_FEW = 10
_LEAST_PAIRS = 30
_LARGEST_SCORE = 2.5


@dataclass(frozen=True)
class ErrorGrowth:
    """Standard deviation of a component of the interpolation error over distance d: sqrt(floor^2 + (at_1cm (d/1cm)^power)^2).

    Attributes
    ----------
    floor_m, at_1cm_m
        Metres.
    power
        Between linear and quadratic as a rule.
    correlation_m
        Distance over which errors are alike: their correlation is exp(-distance / correlation_m).
    farthest_m
        Largest distance that the fit has seen; beyond it the curve is extrapolated. 0 without data.
    distances_m, errors_m
        Shapes (k,) and (k, 3): the held-out errors that it was fitted to.
    warnings
        What a person should know.
    """

    floor_m: float = _PRIOR_FLOOR_M
    at_1cm_m: float = _PRIOR_1CM_M
    power: float = _PRIOR_POWER
    correlation_m: float = _PRIOR_CORRELATION_M
    farthest_m: float = 0.0
    distances_m: NDArray[np.float64] | None = None
    errors_m: NDArray[np.float64] | None = None
    warnings: tuple[str, ...] = ()

    def sigma(self, distance_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the standard deviation of a component, metres, at distances from the nearest measured point."""
        return _curve(np.asarray(distance_m, dtype=np.float64), self.floor_m, self.at_1cm_m, self.power)


def fit_error_growth(
    measured: HomologousPoints, vessel_ids: NDArray[np.intp] | None = None, spline: PlaneSpline | None = None
) -> ErrorGrowth:
    """Fit the growth to points that were left out: whole vessels, discs, and sides of the craniotomy.

    Fewer features are simulated by leaving some out; what the spline of the others says there is compared with what was
    measured. Neighbours on a vessel would vouch for each other, so never single points, always whole groups are left out.

    Parameters
    ----------
    measured
        Homologous points.
    vessel_ids
        Shape (n,), which vessel each point lies on (-1: none); None if unknown.
    spline
        Of the points, if it is at hand.

    Returns
    -------
    ErrorGrowth
        Maximum a posteriori under Student's t, with priors from simulated scans that a few dozen errors outweigh.

    Raises
    ------
    InputError
        Fewer than four points, or points on a line.
    """
    spline = spline or fit_spline(measured)
    samples = [_predicted(measured, spline, held_out) for held_out in _held_out_sets(measured.points, spline, vessel_ids)]
    if not samples:
        return ErrorGrowth(warnings=(f"only {len(measured.points)} points: the growth of the error is a guess",))
    index, distance, error, known = (np.concatenate(columns) for columns in zip(*samples, strict=True))
    # A point that was left out ten times is still one point.
    weight = 1.0 / np.bincount(index, minlength=len(measured.points))[index]
    floor, at_1cm, power = _most_likely(distance, error, known, weight)
    correlation = _correlation_length(samples, measured.points, lambda d: _curve(d, floor, at_1cm, power))
    held_out = len(np.unique(index))
    few = held_out < _FEW
    return ErrorGrowth(
        floor_m=floor,
        at_1cm_m=at_1cm,
        power=power,
        correlation_m=correlation,
        farthest_m=float(distance.max()),
        distances_m=distance,
        errors_m=error,
        warnings=(f"only {held_out} points could be left out: the growth of the error is mostly a guess",) if few else (),
    )


_Sample = tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def _curve(distance: NDArray[np.float64], floor: float, at_1cm: float, power: float) -> NDArray[np.float64]:
    return np.hypot(floor, at_1cm * (distance / _CENTIMETRE_M) ** power)


def _held_out_sets(
    points: NDArray[np.float64], spline: PlaneSpline, vessel_ids: NDArray[np.intp] | None
) -> list[NDArray[np.bool_]]:
    """Masks (n,) of what is left out together."""
    sets = [] if vessel_ids is None else [vessel_ids == vessel for vessel in np.unique(vessel_ids[vessel_ids >= 0])]
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    sets += list(apart < _DISC_M)
    for angle in np.arange(_SIDES) * 2 * np.pi / _SIDES:
        along = spline.xy @ [np.cos(angle), np.sin(angle)]
        sets += [along > np.quantile(along, 1.0 - share) for share in _SIDE_SHARES]
    least = max(LEAST_POINTS + 2, len(points) // 3)
    unique = {mask.tobytes(): mask for mask in sets if mask.any() and (~mask).sum() >= least}
    return [mask for mask in unique.values() if np.linalg.cond(spline.xy[~mask] - spline.xy[~mask].mean(axis=0)) < 20.0]


def _predicted(measured: HomologousPoints, spline: PlaneSpline, held_out: NDArray[np.bool_]) -> _Sample:
    """Index, distance to the nearest point left, error (k, 3), and the part of its deviation that measuring explains."""
    rest = ~held_out
    weights = spline.without(held_out).weights(measured.points[held_out])
    error = weights @ measured.displacements[rest] - measured.displacements[held_out]
    distance = cKDTree(measured.points[rest]).query(measured.points[held_out])[0]
    known = np.sqrt(measured.sigma[held_out] ** 2 + weights**2 @ measured.sigma[rest] ** 2)
    return np.flatnonzero(held_out), distance, error, known


def _most_likely(
    distance: NDArray[np.float64], error: NDArray[np.float64], known: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[float, float, float]:
    prior = np.array([np.log(_PRIOR_FLOOR_M), np.log(_PRIOR_1CM_M), _PRIOR_POWER])

    def cost(parameters: NDArray[np.float64]) -> float:
        floor, at_1cm = np.exp(parameters[:2])
        power = np.clip(parameters[2], *_POWERS)
        total = np.hypot(_curve(distance, floor, at_1cm, power), known) / _ONE_SIGMA_OF_T
        surprise = 0.5 * (_FREEDOM + 1.0) * np.log1p((error / total[:, None]) ** 2 / _FREEDOM) + np.log(total)[:, None]
        return float((weight[:, None] * surprise).sum() + 0.5 * (((parameters - prior) / _PRIOR_SPREAD) ** 2).sum())

    found = minimize(cost, prior, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-4})
    return float(np.exp(found.x[0])), float(np.exp(found.x[1])), float(np.clip(found.x[2], *_POWERS))


def _correlation_length(
    samples: list[_Sample], points: NDArray[np.float64], curve: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> float:
    """Length whose exponential fits the products of errors, in standard deviations, of points that were left out together."""
    apart, product, ceiling = [], [], []
    for index, distance, error, known in samples:
        if len(index) < 2:
            continue
        grown = curve(distance)
        total = np.hypot(grown, known)
        score = np.clip(error / total[:, None], -_LARGEST_SCORE, _LARGEST_SCORE)
        i, j = np.triu_indices(len(index), 1)
        apart.append(np.linalg.norm(points[index[i]] - points[index[j]], axis=1))
        product.append((score[i] * score[j]).mean(axis=1))
        ceiling.append((grown / total)[i] * (grown / total)[j])
    if sum(map(len, apart)) < _LEAST_PAIRS:
        return _PRIOR_CORRELATION_M
    d, z, c = (np.concatenate(part) for part in (apart, product, ceiling))
    lengths = np.geomspace(1e-3, 50e-3, 40)
    misfit = [np.mean((z - c * np.exp(-d / length)) ** 2) for length in lengths]
    return float(lengths[int(np.argmin(misfit))])
