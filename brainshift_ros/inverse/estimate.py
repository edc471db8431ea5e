"""From an atlas and a sparse measurement to the displacement of the whole brain."""

from __future__ import annotations

from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from brainshift_ros import __version__
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.h5 import digest
from brainshift_ros.inverse.accuracy import angular_error_deg, shift_correction_percent
from brainshift_ros.inverse.appended import AppendedAtlas
from brainshift_ros.inverse.atlas_like import AtlasLike
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.inverse.robust import RobustFit, fit_robustly
from brainshift_ros.inverse.rows import rows_at_points
from brainshift_ros.inverse.shift_estimate import EntryWeight, ShiftEstimate
from brainshift_ros.inverse.uncertainty import node_std, reduced_chi_square, weight_covariance
from brainshift_ros.inverse.verdict import Fit, reasons_against, remarks
from brainshift_ros.mesh.locate import PointLocator


def estimate_shift(
    atlas: AtlasLike,
    measured: HomologousPoints,
    *,
    retraction: NDArray[np.float32] | None = None,
    options: InverseOptions | None = None,
    locator: PointLocator | None = None,
) -> ShiftEstimate:
    """Estimate the shift of the whole brain from a sparse measurement: (3.9), with retraction (6.3), weighted (8.3).

    Parameters
    ----------
    atlas
        The patient's atlas; only the rows at the points and the columns with non-zero weights are read.
    measured
        Homologous points in the patient frame.
    retraction
        Shape (k, N, 3), metres: columns solved during surgery, a group of their own with the sum limit 1.
    options
        Settings; the defaults if None.
    locator
        Locator of ``atlas.mesh``, if one is at hand: building it takes most of a second.

    Raises
    ------
    InputError
        The measurement is malformed or does not touch the brain, the retraction is of another mesh, or the method is unknown.
    """
    options = options or InverseOptions()
    clock = _Clock()
    _check_measurement(measured)
    whole = AppendedAtlas(atlas, retraction)
    locator = locator or PointLocator(atlas.mesh)
    clock.lap("locator")
    rows = rows_at_points(whole, measured, locator=locator, max_outside_mm=options.max_outside_mm)
    clock.lap("rows")
    u, sigma = measured.displacements[rows.kept], measured.sigma[rows.kept]
    robust = fit_robustly(rows.M, u, sigma, whole.groups, method=options.method, outlier_sigmas=options.outlier_sigmas)
    solution = robust.solution
    fit = Fit(
        offered=len(measured.points),
        on_brain=rows.kept.size,
        used=robust.used,
        points=measured.points[rows.kept],
        measured=u,
        estimated=rows.M @ solution.weights,
        sigma=sigma,
        solution=solution,
    )
    clock.lap("solve")
    active = np.flatnonzero(solution.weights)
    displacement, std = _field(whole, active, robust, fit)
    clock.lap("field")
    reasons = reasons_against(fit, options)
    weights = [whole.describe(int(column), float(solution.weights[column])) for column in active]
    points_sha256 = digest(measured.points, measured.displacements, measured.sigma)
    provenance = {
        "patient_id": atlas.patient_id,
        "atlas_id": atlas.atlas_id,
        "points_sha256": points_sha256,
        "method": options.method,
        "valid": not reasons,
        "reasons": list(reasons),
        "weights": {str(item.column): item.weight for item in weights},
        "software": f"brainshift_ros {__version__}",
    }
    return ShiftEstimate(
        field=DisplacementField(atlas.mesh, displacement, std, provenance),
        valid=not reasons,
        reasons=reasons,
        warnings=rows.warnings + remarks(fit),
        weights=tuple(sorted(weights, key=lambda item: -abs(item.weight))),
        mechanism_sums=_sums(weights),
        solution=solution,
        points=fit.points,
        measured=fit.measured,
        estimated=fit.estimated,
        used=fit.used,
        points_offered=fit.offered,
        residual_mean=float(np.mean(fit.residuals)),
        residual_rms=float(np.sqrt(np.mean(fit.residuals**2))),
        correction_percent=shift_correction_percent(u[fit.used], fit.estimated[fit.used]),
        angular_error_deg=angular_error_deg(u[fit.used], fit.estimated[fit.used]),
        condition=_condition(robust.problem.A[:, active]),
        atlas_id=atlas.atlas_id,
        patient_id=atlas.patient_id,
        points_sha256=points_sha256,
        retraction_sha256=None if retraction is None else digest(np.asarray(retraction)),
        times_s=clock.total(),
    )


class _Clock:
    """Seconds between laps, by name."""

    def __init__(self) -> None:
        self._start = self._last = perf_counter()
        self.laps: dict[str, float] = {}

    def lap(self, name: str) -> None:
        now = perf_counter()
        self.laps[name] = now - self._last
        self._last = now

    def total(self) -> dict[str, float]:
        return {**self.laps, "total": perf_counter() - self._start}


def _check_measurement(measured: HomologousPoints) -> None:
    source = "homologous points"
    n = len(measured.points)
    if n == 0:
        raise InputError(source, "there are none", "measure at least a few points on the exposed cortex")
    for name, array, shape in (
        ("points", measured.points, (n, 3)),
        ("displacements", measured.displacements, (n, 3)),
        ("sigma", measured.sigma, (n,)),
    ):
        if array.shape != shape:
            raise InputError(source, f"{name} has shape {array.shape}, not {shape}", "give one row per point")
        if not np.isfinite(array).all():
            raise InputError(source, f"{name} holds values that are not finite", "remove these points")
    if not (measured.sigma > 0.0).all():
        raise InputError(source, f"a sigma is {measured.sigma.min():g} m", "sigma must be positive")


def _field(
    atlas: AppendedAtlas, active: NDArray[np.int64], robust: RobustFit, fit: Fit
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Displacement (N, 3) and its standard deviation (N,) from the columns with non-zero weights."""
    solution, problem = robust.solution, robust.problem
    columns = atlas.columns(active)
    displacement = columns @ solution.weights[active]
    if not np.isfinite(displacement).all():
        raise InputError(atlas.path, "its columns hold values that are not finite", "build the atlas again")
    # A saturated sum takes a degree of freedom away.
    parameters = max(active.size - len(solution.saturated), 0)
    chi_square = reduced_chi_square(solution.residual_norm, problem.b.size, parameters)
    covariance = weight_covariance(problem, active, solution.saturated, max(1.0, chi_square))
    unexplained = max(chi_square - 1.0, 0.0) * float(np.mean(fit.sigma[fit.used] ** 2))
    std = node_std(atlas.mesh.nodes, columns, covariance, displacement, fit.points[fit.used], fit.mean_shift, unexplained)
    return displacement, std


def _sums(weights: list[EntryWeight]) -> dict[str, float]:
    sums: dict[str, float] = {}
    for item in weights:
        sums[item.mechanism] = sums.get(item.mechanism, 0.0) + item.weight
    return sums


def _condition(columns: NDArray[np.float64]) -> float:
    """Condition number of the columns (rows, k) in use; infinite if they are dependent, 1 if there are none."""
    if columns.shape[1] == 0:
        return 1.0
    singular = np.linalg.svd(columns, compute_uv=False)
    independent = singular.size == columns.shape[1] and singular[-1] > singular[0] * np.finfo(float).eps * max(columns.shape)
    return float(singular[0] / singular[-1]) if independent else float("inf")
