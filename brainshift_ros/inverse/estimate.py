"""From an atlas and a sparse measurement to the displacement of the whole brain."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from brainshift_ros import __version__
from brainshift_ros.atlas.entry import RETRACTION
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.h5 import digest
from brainshift_ros.inverse.appended import AppendedAtlas
from brainshift_ros.inverse.atlas_like import AtlasLike
from brainshift_ros.inverse.gathered import gather
from brainshift_ros.inverse.measurement import check_measurement
from brainshift_ros.inverse.mechanisms import mechanism_shares
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.inverse.prior import weight_prior
from brainshift_ros.inverse.robust import fit_robustly
from brainshift_ros.inverse.rows import rows_at_points
from brainshift_ros.inverse.shift_estimate import EntryWeight, ShiftEstimate
from brainshift_ros.inverse.span import AtlasSpan, atlas_span
from brainshift_ros.inverse.uncertainty import condition
from brainshift_ros.inverse.verdict import Fit, far_field, reasons_against, remarks
from brainshift_ros.mesh.locate import PointLocator


def estimate_shift(
    atlas: AtlasLike,
    measured: HomologousPoints,
    *,
    retraction: NDArray[np.float32] | None = None,
    options: InverseOptions | None = None,
    covariance: NDArray[np.float64] | None = None,
    locator: PointLocator | None = None,
    span: AtlasSpan | None = None,
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
    covariance
        Shape (n, n), metres squared: of a displacement component over the measured points, the W^-1 of (8.5), where
        neighbours err alike. It then stands in for their sigma.
    locator, span
        Locator of ``atlas.mesh`` and :func:`.span.atlas_span` of the atlas, if they are at hand: neither depends on the
        measurement, and making them takes most of a second.

    Raises
    ------
    InputError
        The measurement is malformed or does not touch the brain, the retraction is of another mesh, or the method is unknown.
    """
    options = options or InverseOptions()
    clock = _Clock()
    check_measurement(measured, covariance)
    whole = AppendedAtlas(atlas, retraction)
    locator = locator or PointLocator(atlas.mesh)
    clock.lap("locator")
    span = (span or atlas_span(atlas)).appended(retraction)
    clock.lap("span")
    rows = rows_at_points(whole, measured, locator=locator, max_outside_mm=options.max_outside_mm)
    clock.lap("rows")
    points, u = measured.points[rows.kept], measured.displacements[rows.kept]
    noise = measured.sigma[rows.kept] if covariance is None else covariance[np.ix_(rows.kept, rows.kept)]
    robust = fit_robustly(points, rows.M, u, noise, whole.groups, method=options.method, outlier_sigmas=options.outlier_sigmas)
    solution, used = robust.solution, robust.used
    clock.lap("solve")
    active = np.flatnonzero(solution.weights)
    displacement = whole.columns(active) @ solution.weights[active]
    if not np.isfinite(displacement).all():
        raise InputError(atlas.path, "its columns hold values that are not finite", "build the atlas again")
    clock.lap("field")
    brain = condition(
        gather(points[used], rows.M[used], u[used], _of(noise, used)), weight_prior(solution.weights.size, whole.groups)
    )
    std = brain.node_std(atlas.mesh.nodes, span, solution.weights)
    shares = mechanism_shares(_mechanisms(atlas, solution.weights.size), solution.weights, brain)
    weights = [
        replace(whole.describe(int(column), float(solution.weights[column])), std=float(deviation))
        for column, deviation in zip(active, brain.weight_std(active, solution.weights), strict=True)
    ]
    clock.lap("uncertainty")
    fit = Fit(
        offered=len(measured.points),
        points=points,
        measured=u,
        estimated=rows.M @ solution.weights,
        sigma=noise if noise.ndim == 1 else np.sqrt(np.diagonal(noise)),
        used=used,
        solution=solution,
        shares=shares,
        amplitudes=brain.amplitudes,
        field_error=float(np.sqrt(3.0 * np.mean(std**2))),
    )
    reasons = reasons_against(fit, options)
    parts = (measured.points, measured.displacements, measured.sigma)
    points_sha256 = digest(*parts) if covariance is None else digest(*parts, covariance)
    provenance = {
        "patient_id": atlas.patient_id,
        "atlas_id": atlas.atlas_id,
        "points_sha256": points_sha256,
        "method": options.method,
        "valid": not reasons,
        "reasons": list(reasons),
        "weights": {str(item.column): item.weight for item in weights},
        "resected_share": _resected_share(weights),
        "software": f"brainshift_ros {__version__}",
    }
    return ShiftEstimate(
        field=DisplacementField(atlas.mesh, displacement, std, provenance),
        reasons=reasons,
        warnings=rows.warnings + remarks(fit) + far_field(atlas.mesh.nodes, displacement, std, points[used]),
        weights=tuple(sorted(weights, key=lambda item: -abs(item.weight))),
        mechanisms=shares,
        solution=solution,
        points=points,
        measured=u,
        estimated=fit.estimated,
        used=used,
        points_offered=fit.offered,
        condition=_condition(robust.problem.A[:, active]),
        amplitudes=brain.amplitudes,
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


def _of(noise: NDArray[np.float64], used: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Select the standard deviations (k,), or the covariance (k, k), of the points in use."""
    return noise[used] if noise.ndim == 1 else noise[np.ix_(used, used)]


def _mechanisms(atlas: AtlasLike, columns: int) -> NDArray[np.str_]:
    """Mechanism of each column, shape (m,), those that were solved during surgery at the end."""
    own = [entry.mechanism for entry in atlas.entries]
    return np.array(own + [RETRACTION] * (columns - len(own)))


def _resected_share(weights: list[EntryWeight]) -> float:
    """Part of the weights that stands on entries without the tumour; 0 where there are none."""
    total = sum(abs(item.weight) for item in weights)
    return sum(abs(item.weight) for item in weights if item.resected) / total if total > 0.0 else 0.0


def _condition(columns: NDArray[np.float64]) -> float:
    """Condition number of the columns (rows, k) in use; infinite if they are dependent, 1 if there are none."""
    if columns.shape[1] == 0:
        return 1.0
    singular = np.linalg.svd(columns, compute_uv=False)
    independent = singular.size == columns.shape[1] and singular[-1] > singular[0] * np.finfo(float).eps * max(columns.shape)
    return float(singular[0] / singular[-1]) if independent else float("inf")
