"""One case at the scanner: a first scan that is registered, later scans that yield homologous points."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.correspondence.tracking import FirstView, Tracking, TrackingOptions, prepare_first, track
from brainshift_ros.correspondence.vessels import VesselTree, trace_vessels
from brainshift_ros.geometry import transform_points
from brainshift_ros.graph import PATIENT_FRAME
from brainshift_ros.registration.checks import check_scan
from brainshift_ros.registration.register import RegistrationOptions, RegistrationResult, check_pose, register_scan
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.registration.target import CortexTarget, prepare_target
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm


@dataclass(frozen=True)
class LrsOptions:
    """Settings of a session."""

    registration: RegistrationOptions = field(default_factory=RegistrationOptions)
    tracking: TrackingOptions = field(default_factory=TrackingOptions)


@dataclass(frozen=True)
class LrsUpdate:
    """What one scan (or pose) brought.

    Attributes
    ----------
    registration
        The session's registration: new with a first scan, the same with later ones; None while no pose is known.
    registered
        The scan in the patient frame; None unless the registration is accepted.
    homologous
        Points, displacements and standard deviations from the first to this scan, patient frame; None for a first scan.
    vessels
        Vessels of a first scan; None for later ones, which are not traced.
    warnings
        What a person should know.
    diagnostics
        Figures and words by name.
    times_s
        Seconds by stage.
    """

    registration: RegistrationResult | None = None
    registered: OrganisedScan | None = None
    homologous: HomologousPoints | None = None
    vessels: VesselTree | None = None
    warnings: tuple[str, ...] = ()
    diagnostics: Mapping[str, float | str] = field(default_factory=dict)
    times_s: Mapping[str, float] = field(default_factory=dict)


class LrsSession:
    """State of one case; :meth:`reset` starts the next.

    Parameters
    ----------
    cortex
        The patient's cortical surface; its registration target is prepared here, once.
    options
        Settings.

    Notes
    -----
    Until a registration is accepted, every scan is taken as a first scan: a refused one does not block a better one, and a
    new pose tries the newest refused scan again. Once accepted, scans are later scans until :meth:`reset`.
    """

    def __init__(self, cortex: Surface | CortexTarget, options: LrsOptions | None = None) -> None:
        self._options = options or LrsOptions()
        self._target = cortex if isinstance(cortex, CortexTarget) else prepare_target(cortex)
        self.reset()

    def reset(self) -> None:
        """Forget pose, scans and registration; the patient stays."""
        self._initial: NDArray[np.float64] | None = None
        self._registration: RegistrationResult | None = None
        self._first: FirstView | None = None
        self._pending: OrganisedScan | None = None
        self._later_scans = 0

    def set_initial_pose(self, T_patient_tracker: NDArray[np.float64]) -> LrsUpdate | None:
        """Give the start of the registration.

        Returns
        -------
        LrsUpdate or None
            The outcome of a first scan that waited for this pose, or was refused with another one; None when there is none.

        Raises
        ------
        InputError
            When it is not a rigid transform in metres.
        """
        self._initial = check_pose(T_patient_tracker)
        if self._first is None and self._pending is not None:
            return self._add_first(self._pending)
        return None

    def add_scan(self, scan: OrganisedScan) -> LrsUpdate:
        """Register a first scan, or find the first scan's points in a later one.

        Raises
        ------
        InputError
            When the scan is unusable; the session goes on as if it had not come.
        """
        check_scan(scan)
        if self._first is not None and self._registration is not None:
            return self._add_later(scan, self._first, self._registration)
        self._pending = scan
        if self._initial is None:
            return LrsUpdate(
                warnings=("the scan waits for an initial pose",),
                diagnostics={"state": "waiting for an initial pose"},
            )
        return self._add_first(scan)

    def _add_first(self, scan: OrganisedScan) -> LrsUpdate:
        result = register_scan(scan, self._target, self._initial, self._options.registration)
        diagnostics: dict[str, float | str] = {
            "state": "registered" if result.accepted else "registration refused",
            "registration_inlier_fraction": result.inlier_fraction,
            "registration_rms_mm": float(m_to_mm(result.rms_m)),
            "registration_condition": result.condition,
            "registration_area_cm2": result.evidence.area_m2 * 1e4,
            "registration_relief_ratio": result.evidence.relief_ratio,
            "registration_rivals": float(result.evidence.rivals),
            "registration_iterations": float(result.iterations),
        }
        times = {f"registration_{stage}": seconds for stage, seconds in result.times_s.items()}
        # Where nothing matched, RMS and conditioning do not exist: nothing that is not finite leaves the session.
        diagnostics = {name: value for name, value in diagnostics.items() if isinstance(value, str) or np.isfinite(value)}
        if not result.accepted:
            diagnostics["reasons"] = "; ".join(result.reasons)
            refused = tuple(f"registration refused: {reason}" for reason in result.reasons)
            return LrsUpdate(registration=result, warnings=refused, diagnostics=diagnostics, times_s=times)
        diagnostics["registration_predicted_tre_mm"] = float(m_to_mm(result.predicted_tre_m(result.pivot)))
        clock = time.perf_counter()
        first = prepare_first(scan, result.cortex_mask, self._options.tracking)
        times["candidates"] = time.perf_counter() - clock
        clock = time.perf_counter()
        vessels = trace_vessels(scan, result.cortex_mask)
        times["vessels"] = time.perf_counter() - clock
        diagnostics |= {
            "vessel_length_mm": float(m_to_mm(vessels.length_m)),
            "vessel_branch_points": float(len(vessels.branch_points)),
            "candidates": float(len(first.candidates)),
        }
        self._registration, self._first, self._pending = result, first, None
        return LrsUpdate(
            registration=result,
            registered=_in_patient(scan, result),
            vessels=vessels,
            warnings=result.warnings,
            diagnostics=diagnostics,
            times_s=times,
        )

    def _add_later(self, scan: OrganisedScan, first: FirstView, registration: RegistrationResult) -> LrsUpdate:
        tracking = track(first, scan, self._options.tracking)
        self._later_scans += 1
        homologous = _to_patient(tracking, registration)
        length_mm = m_to_mm(np.linalg.norm(homologous.displacements, axis=1))
        diagnostics: dict[str, float | str] = {
            "state": "tracking",
            "later_scans": float(self._later_scans),
            **tracking.diagnostics,
        }
        diagnostics["homologous_points"] = float(len(homologous.points))
        if len(length_mm):
            diagnostics |= {
                "shift_mm_mean": float(length_mm.mean()),
                "shift_mm_max": float(length_mm.max()),
                "sigma_mm_median": float(np.median(m_to_mm(homologous.sigma))),
            }
        return LrsUpdate(
            registration=registration,
            registered=_in_patient(scan, registration),
            homologous=homologous,
            warnings=tracking.warnings,
            diagnostics=diagnostics,
            times_s=tracking.times_s,
        )


def _in_patient(scan: OrganisedScan, registration: RegistrationResult) -> OrganisedScan:
    points = transform_points(registration.T_patient_tracker, scan.points)
    return OrganisedScan(points.astype(np.float32), scan.rgb, PATIENT_FRAME, scan.stamp_ns)


def _to_patient(tracking: Tracking, registration: RegistrationResult) -> HomologousPoints:
    """Rotate displacements; the registration's uncertain rotation adds to each standard deviation."""
    T = registration.T_patient_tracker
    displacements = tracking.points.displacements @ T[:3, :3].T
    turn_variance = float(np.trace(registration.covariance[:3, :3])) / 3.0
    added = turn_variance * np.sum(displacements**2, axis=1) * 2.0 / 3.0
    return HomologousPoints(
        points=transform_points(T, tracking.points.points),
        displacements=displacements,
        sigma=np.sqrt(tracking.points.sigma**2 + added),
    )
