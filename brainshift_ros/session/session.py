"""One case at the scanner: a first scan that is registered, later scans that yield homologous points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.dense import DenseField, interpolate
from brainshift_ros.correspondence.guides import Guides
from brainshift_ros.correspondence.guides_file import GuideMarks
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.correspondence.tracking import FirstView, Tracking, TrackingOptions, prepare_first, track
from brainshift_ros.errors import InputError
from brainshift_ros.geometry import transform_points
from brainshift_ros.graph import PATIENT_FRAME
from brainshift_ros.registration.checks import check_scan
from brainshift_ros.registration.fiducials import FiducialRegistration
from brainshift_ros.registration.options import RegistrationOptions
from brainshift_ros.registration.register import check_pose, register_scan
from brainshift_ros.registration.result import RegistrationResult
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.registration.search import SearchArea
from brainshift_ros.registration.target import CortexTarget, prepare_target
from brainshift_ros.registration.thinning import voxel_means
from brainshift_ros.session.report import Figures, registration_figures, tracking_figures
from brainshift_ros.surface.surface import Surface
from brainshift_ros.timing import timed
from brainshift_ros.units import m_to_mm, mm_to_m
from brainshift_ros.vessels.tracing import VesselTree, trace_vessels

_COMPARED_POINTS = 2000


@dataclass(frozen=True)
class LrsOptions:
    """Settings of a session.

    Attributes
    ----------
    registration, tracking
        Of its two halves.
    pose_disagreement_mm
        A pose that comes after the registration and lies farther from it than this, over the scanned cortex, is reported.
    """

    registration: RegistrationOptions = field(default_factory=RegistrationOptions)
    tracking: TrackingOptions = field(default_factory=TrackingOptions)
    pose_disagreement_mm: float = 10.0


@dataclass(frozen=True)
class LrsUpdate:
    """What one step of a session brought.

    Attributes
    ----------
    registration
        The session's registration: new with a first scan, the same with later ones; None while there is none.
    registered
        The scan in the patient frame; None unless the registration is accepted, or where the step placed no scan.
    homologous
        Points, displacements and standard deviations from the first to the later scan, patient frame; None where the step
        compared none.
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
    near
        Where the craniotomy is planned: a search without an initial pose stays there. None: anywhere on the exposed cortex.

    Notes
    -----
    Until a registration is accepted, every scan is taken as a first scan: a refused one does not block a better one, and a
    new pose tries the newest refused scan again. Once accepted, scans are later scans until :meth:`reset`, and no pose moves
    the registration. So a "later" scan that comes without a first is a first scan: it is registered, or refused with reasons,
    and never gives homologous points by itself.

    A scan is handled in two steps, so that its registered cloud need not wait for what is found in it: :meth:`place` and
    :meth:`compare`; :meth:`add_scan` does both.
    """

    def __init__(
        self, cortex: Surface | CortexTarget, options: LrsOptions | None = None, *, near: SearchArea | None = None
    ) -> None:
        self._options = options or LrsOptions()
        self._near = near
        self._target = cortex if isinstance(cortex, CortexTarget) else prepare_target(cortex)
        self.reset()

    def reset(self) -> None:
        """Forget pose, scans and registration; the patient stays."""
        self._initial: NDArray[np.float64] | None = None
        self._pending: OrganisedScan | None = None
        self._registration: RegistrationResult | None = None
        self._first_scan: OrganisedScan | None = None
        self._first_view: FirstView | None = None
        self._later_scan: OrganisedScan | None = None
        self._compared = False
        self._later_scans = 0
        self._measured: HomologousPoints | None = None

    def set_initial_pose(self, T_patient_tracker: NDArray[np.float64]) -> LrsUpdate | None:
        """Give the start of the registration.

        Returns
        -------
        LrsUpdate or None
            The outcome of a first scan that waited for this pose, or was refused with another one; None when there is none.
            Once a scan is registered the pose changes nothing, and the update says how far the two are apart.

        Raises
        ------
        InputError
            When it is not a rigid transform in metres.
        """
        pose = check_pose(T_patient_tracker)
        if self._registration is not None:
            return self._compare_pose(pose, "pose")
        self._initial = pose
        return None if self._pending is None else self._register(self._pending, pose)

    def set_fiducials(self, fiducials: FiducialRegistration) -> LrsUpdate:
        """Give the start of the registration as the registration of paired fiducials.

        Returns
        -------
        LrsUpdate
            As of :meth:`set_initial_pose`, and always the fiducials' own errors.
        """
        figures: Figures = {"fiducials": float(len(fiducials.residuals_m)), "fre_mm": float(m_to_mm(fiducials.fre_m))}
        target = self._near.center if self._near is not None else self._target.points.mean(axis=0)
        figures["fiducials_predicted_tre_mm"] = float(m_to_mm(fiducials.predicted_tre_m(target)))
        if self._registration is not None:
            update = self._compare_pose(fiducials.T_patient_tracker, "fiducials")
        else:
            update = self.set_initial_pose(fiducials.T_patient_tracker) or LrsUpdate()
        return replace(
            update,
            warnings=(*update.warnings, *fiducials.warnings),
            diagnostics={**update.diagnostics, **figures},
        )

    def search(self) -> LrsUpdate | None:
        """Register the scan that waits for a pose without one; None when no scan waits."""
        return None if self._pending is None else self._register(self._pending, None)

    def add_scan(self, scan: OrganisedScan) -> LrsUpdate:
        """Register a first scan, or find the first scan's points in a later one: :meth:`place`, then :meth:`compare`.

        Raises
        ------
        InputError
            As these two.
        """
        placed = self.place(scan)
        found = self.compare()
        if found is None:
            return placed
        return replace(
            placed,
            homologous=found.homologous,
            warnings=(*placed.warnings, *found.warnings),
            diagnostics={**placed.diagnostics, **found.diagnostics},
            times_s={**placed.times_s, **found.times_s},
        )

    def place(self, scan: OrganisedScan) -> LrsUpdate:
        """Bring a scan into the patient frame: register a first scan, move a later one by the registration.

        Raises
        ------
        InputError
            When the scan is unusable; the session goes on as if it had not come.
        """
        times: dict[str, float] = {}
        with timed(times, "check"):
            check_scan(scan)
        if self._registration is not None:
            with timed(times, "place"):
                registered = _in_patient(scan, self._registration)
            self._later_scan, self._compared = scan, False
            self._later_scans += 1
            return LrsUpdate(
                registration=self._registration,
                registered=registered,
                diagnostics={"state": "later scan placed", "later_scans": float(self._later_scans)},
                times_s=times,
            )
        self._pending = scan
        if self._initial is None:
            said = "waiting for an initial pose"
            return LrsUpdate(warnings=("the scan waits for an initial pose",), diagnostics={"state": said}, times_s=times)
        update = self._register(scan, self._initial)
        return replace(update, times_s={**times, **update.times_s})

    def compare(self) -> LrsUpdate | None:
        """Do what the newest scan still needs: prepare a first scan for comparison, find its points in a later one.

        Returns
        -------
        LrsUpdate or None
            None when there is nothing to do.

        Raises
        ------
        InputError
            When the first scan shows no vessels: then the next scan is taken as the first, from the same pose. When a later
            scan cannot be compared: guides may still help (:meth:`set_guides`).
        """
        if self._registration is None:
            return None
        times: dict[str, float] = {}
        figures: Figures = {}
        if self._first_view is None:
            self._first_view = self._prepared(times)
            figures["candidates"] = float(len(self._first_view.candidates))
        if self._later_scan is None or self._compared:
            return LrsUpdate(self._registration, diagnostics=figures, times_s=times) if times else None
        self._compared = True  # whatever comes of it, it would come again
        tracked = self._tracked(self._later_scan, None)
        return replace(tracked, diagnostics={**figures, **tracked.diagnostics}, times_s={**times, **tracked.times_s})

    def set_guides(self, marks: GuideMarks) -> LrsUpdate:
        """Find the first scan's points in the newest later scan again, guided by a person's marks.

        Raises
        ------
        InputError
            No later scan has come, or the marks do not fit the two scans.
        """
        if self._first_scan is None or self._later_scan is None:
            raise InputError("guides", "there is no later scan to guide", "send a first and a later scan before")
        if self._first_view is None:
            self._first_view = self._prepared({})
        guides = marks.guides(self._first_scan, self._later_scan)
        self._compared = True
        tracked = self._tracked(self._later_scan, guides)
        return replace(tracked, diagnostics={**tracked.diagnostics, "state": "tracked by guides"})

    def dense(self, spacing_m: float) -> DenseField:
        """Interpolate the newest homologous points over the cortex of the first scan (thesis appendix E).

        Parameters
        ----------
        spacing_m
            Distance between points of the field, metres.

        Raises
        ------
        InputError
            There are no homologous points yet, or too few.
        """
        if self._measured is None or self._first_scan is None or self._registration is None:
            raise InputError("dense field", "there are no homologous points yet", "send a first and a later scan before")
        if not spacing_m > 0.0:
            raise InputError("dense field", f"a spacing of {m_to_mm(spacing_m):g} mm", "give one above zero")
        cortex = self._first_scan.points[self._registration.cortex_mask & self._first_scan.seen].astype(np.float64)
        at = transform_points(self._registration.T_patient_tracker, voxel_means(cortex, spacing_m)[0])
        # Each point's sigma holds a component of the tracker's error, which is one and the same for all points of a scan.
        common_m = float(mm_to_m(self._options.tracking.tracker_mm)) * np.sqrt(2.0 / 3.0)
        return interpolate(self._measured, at, common_m=common_m)

    def vessels(self) -> VesselTree:
        """Trace the vessels of the first scan, for pictures: neither registration nor correspondence needs them.

        Raises
        ------
        InputError
            No scan is registered.
        """
        if self._first_scan is None or self._registration is None:
            raise InputError("vessels", "no scan is registered", "send a first scan that is accepted")
        return trace_vessels(self._first_scan, self._registration.cortex_mask)

    def _register(self, scan: OrganisedScan, initial: NDArray[np.float64] | None) -> LrsUpdate:
        result = register_scan(scan, self._target, initial, self._options.registration, near=self._near)
        figures = registration_figures(result)
        times = {f"registration_{stage}": seconds for stage, seconds in result.times_s.items()}
        if not result.accepted:
            refused = tuple(f"registration refused: {reason}" for reason in result.reasons)
            return LrsUpdate(registration=result, warnings=refused, diagnostics=figures, times_s=times)
        with timed(times, "place"):
            registered = _in_patient(scan, result)
        self._registration, self._first_scan, self._pending = result, scan, None
        return LrsUpdate(result, registered, warnings=result.warnings, diagnostics=figures, times_s=times)

    def _prepared(self, times: dict[str, float]) -> FirstView:
        assert self._first_scan is not None
        assert self._registration is not None
        try:
            with timed(times, "candidates"):
                return prepare_first(self._first_scan, self._registration.cortex_mask, self._options.tracking)
        except InputError:
            self._initial = self._registration.T_patient_tracker
            self._registration = self._first_scan = self._later_scan = None
            raise

    def _tracked(self, scan: OrganisedScan, guides: Guides | None) -> LrsUpdate:
        assert self._first_view is not None
        assert self._registration is not None
        tracking = track(self._first_view, scan, self._options.tracking, guides)
        self._measured = _to_patient(tracking, self._registration)
        return LrsUpdate(
            registration=self._registration,
            homologous=self._measured,
            warnings=tracking.warnings,
            diagnostics={"state": "tracked", **tracking_figures(self._measured, tracking.diagnostics)},
            times_s=tracking.times_s,
        )

    def _compare_pose(self, T_patient_tracker: NDArray[np.float64], what: str) -> LrsUpdate:
        """Tell how far a pose is from the registration, which it leaves alone."""
        assert self._first_scan is not None
        assert self._registration is not None
        cortex = self._first_scan.points[self._registration.cortex_mask].astype(np.float64)
        cortex = cortex[:: max(1, len(cortex) // _COMPARED_POINTS)]
        apart = transform_points(T_patient_tracker, cortex) - transform_points(self._registration.T_patient_tracker, cortex)
        apart_mm = float(m_to_mm(np.linalg.norm(apart, axis=1).mean()))
        warnings: tuple[str, ...] = ()
        if apart_mm > self._options.pose_disagreement_mm:
            kept = "the registration is kept; reset the case if the tracker's reference has moved"
            warnings = (f"the {what} disagrees with the registration by {apart_mm:.0f} mm: {kept}",)
        return LrsUpdate(self._registration, warnings=warnings, diagnostics={f"{what}_disagreement_mm": apart_mm})


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
