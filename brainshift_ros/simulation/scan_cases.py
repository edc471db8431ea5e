"""Simulated cases of scanning through a craniotomy, by number: what registration and correspondence are judged on.

Every 36 numbers cover nine conditions (a third with a resection cavity, a third with instruments) times four classes of shift
evenly. Numbers 0 to 35 are for tuning; 36 to 71, on other brains, are held out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.geometry import invert_rigid, rigid, transform_points
from brainshift_ros.simulation.blood import BloodFilm
from brainshift_ros.simulation.cavity import Cavity
from brainshift_ros.simulation.scan_brains import brain
from brainshift_ros.simulation.scan_draws import (
    draw_cavity,
    draw_instruments,
    draw_lighting,
    draw_optics,
    draw_poses,
    draw_start,
    draw_tracker_error,
    draw_vessel_style,
)
from brainshift_ros.simulation.scan_plan import PLACES_MM, Severity, case_plan
from brainshift_ros.simulation.scan_shift import draw_shift
from brainshift_ros.simulation.scanner import Scanner, Seen, SimulatedScan, take_scan
from brainshift_ros.simulation.scene import SurgicalScene, make_scene
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import mm_to_m

_NEAR_CORTEX_M = 2e-3
_BETWEEN_SCANS_NS = 600_000_000_000


@dataclass(frozen=True)
class ScanCase:
    """A scene, its first scan, a later one after a known shift, and what registration starts from.

    Attributes
    ----------
    name, tags
        ``case_07`` and, e.g., ``{"cavity", "instruments", "frontal", "left", "shift 12-18 mm"}``.
    cortex
        The patient model's cortical surface: the scanned one with a segmentation error.
    scene
        What is scanned.
    T_patient_tracker
        The true transform.
    start
        4x4, T_patient_tracker within 15 degrees and 10 mm about the craniotomy.
    shift
        True displacement (n, 3) of points (n, 3), metres, patient frame.
    shift_peak_m
        Its greatest length over the opening.
    first, later
        The scans with their truth.
    cavity
        What was resected between them.
    """

    name: str
    tags: frozenset[str]
    cortex: Surface
    scene: SurgicalScene
    T_patient_tracker: NDArray[np.float64]
    start: NDArray[np.float64]
    shift: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    shift_peak_m: float
    first: SimulatedScan
    later: SimulatedScan
    cavity: Cavity | None

    def surface_targets(self) -> NDArray[np.float64]:
        """About 200 points of the cortex in the opening, shape (k, 3), patient frame, metres."""
        seen = self.first.current[self.first.label == Seen.CORTEX]
        return seen[:: max(1, len(seen) // 200)]

    def deep_targets(self) -> NDArray[np.float64]:
        """Points 15 to 50 mm below the opening, shape (12, 3), patient frame, metres: where a tumour may lie."""
        depth, x, y = np.meshgrid([15e-3, 30e-3, 50e-3], [-10e-3, 10e-3], [-10e-3, 10e-3], indexing="ij")
        local = np.stack([x, y, -depth], axis=-1).reshape(-1, 3)
        return transform_points(invert_rigid(self.scene.craniotomy.T_craniotomy_patient), local)

    def tre_m(self, T_patient_tracker: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Target registration errors of a transform on the cortex, shape (k,), and deep below it, shape (12,), metres."""
        error = T_patient_tracker @ invert_rigid(self.T_patient_tracker)
        on_surface, deep = (
            np.linalg.norm(transform_points(error, at) - at, axis=1) for at in (self.surface_targets(), self.deep_targets())
        )
        return on_surface, deep

    def point_residuals_m(self, points: HomologousPoints, T_patient_tracker: NDArray[np.float64]) -> NDArray[np.float64]:
        """Measured minus true displacement of each point, shape (n, 3), metres, patient frame.

        Parameters
        ----------
        points
            In the patient frame, through `T_patient_tracker`.
        T_patient_tracker
            The registration that brought them there: it is undone to find which tissue each point is.

        Returns
        -------
        residuals
            NaN where the point is no cortex, or cortex that is resected in the later scan.
        """
        to_truth = self.T_patient_tracker @ invert_rigid(self.first.T_error) @ invert_rigid(T_patient_tracker)
        at = transform_points(to_truth, points.points)
        residuals = points.displacements - self.shift(at)
        residuals[~self.is_lasting_cortex(at)] = np.nan
        return residuals

    def point_errors_m(self, points: HomologousPoints, T_patient_tracker: NDArray[np.float64]) -> NDArray[np.float64]:
        """Length of :meth:`point_residuals_m`, shape (n,), metres."""
        return np.asarray(np.linalg.norm(self.point_residuals_m(points, T_patient_tracker), axis=1))

    def is_lasting_cortex(self, at: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether points (n, 3), patient frame, lie on cortex of the first scan that is not resected afterwards."""
        if len(at) == 0:
            return np.zeros(0, dtype=bool)
        near = cKDTree(self.first.current[self.first.label == Seen.CORTEX]).query(at)[0] < _NEAR_CORTEX_M
        if self.cavity is not None:
            xy = transform_points(self.scene.craniotomy.T_craniotomy_patient, at)[:, :2]
            near &= self.cavity.beyond_rim_m(xy) >= 0.0
        return np.asarray(near)


def make_scan_case(number: int, *, scanner: Scanner | None = None, severity: Severity | None = None) -> ScanCase:
    """Make the case of a number, 0 and up; the same number gives the same case.

    Parameters
    ----------
    number
        Which one; numbers of one round of 36 share four brains.
    scanner
        Optics; the case changes distance, dropouts, and range noise.
    severity
        What to make worse.
    """
    plan, severity = case_plan(number), severity or Severity()
    rng = np.random.default_rng([number, 6])
    wrong = severity.segmentation_error_m
    true_cortex, model_cortex = brain(plan.brain) if wrong is None else brain(plan.brain, wrong)
    drawn_mm = float(rng.uniform(*plan.shift_mm))
    peak_mm = drawn_mm if severity.shift_mm is None else severity.shift_mm
    scene = make_scene(
        true_cortex,
        mm_to_m(PLACES_MM[plan.place] + rng.uniform(-6.0, 6.0, 3)),
        float(mm_to_m(rng.uniform(50.0, 80.0))),
        seed=int(rng.integers(2**31)),
        painted_margin_m=0.6 * float(mm_to_m(peak_mm)),
        vessel_style=draw_vessel_style(rng),
    )
    craniotomy = scene.craniotomy
    local = transform_points(craniotomy.T_craniotomy_patient, scene.cortex.vertices)
    crown = (np.hypot(local[:, 0], local[:, 1]) < craniotomy.radius_m) & (local[:, 2] > -0.03)
    shift = draw_shift(craniotomy, scene.cortex.vertices[crown], float(mm_to_m(peak_mm)), rng)
    cavity = draw_cavity(craniotomy, rng) if plan.cavity else None
    T_patient_tracker = rigid(Rotation.random(rng=rng), rng.normal(0.0, 0.7, 3))
    optics = severity.worsened(draw_optics(scanner or Scanner(), rng))
    poses = draw_poses(craniotomy, optics, rng)
    later_scene = BloodFilm(severity.blood_share, seed=number).over(scene) if severity.blood_share > 0 else scene
    hands = [
        draw_instruments(craniotomy, local[crown], None, None, rng) if plan.instruments and rng.uniform() < 0.5 else (),
        draw_instruments(craniotomy, local[crown], shift, cavity, rng) if plan.instruments else (),
    ]
    scans = [
        take_scan(
            seen,
            T_patient_tracker,
            pose,
            seed=int(rng.integers(2**31)),
            displacement=moved,
            scanner=optics,
            stamp_ns=stamp_ns,
            lighting=draw_lighting(craniotomy, rng),
            instruments=instruments,
            cavity=hole,
            T_error=draw_tracker_error(transform_points(invert_rigid(T_patient_tracker), craniotomy.center), rng),
        )
        for seen, pose, moved, stamp_ns, instruments, hole in zip(
            (scene, later_scene), poses, (None, shift), (0, _BETWEEN_SCANS_NS), hands, (None, cavity), strict=True
        )
    ]
    return ScanCase(
        name=f"case_{number:02d}",
        tags=plan.tags,
        cortex=model_cortex,
        scene=scene,
        T_patient_tracker=T_patient_tracker,
        start=draw_start(T_patient_tracker, craniotomy.center, rng),
        shift=shift,
        shift_peak_m=float(mm_to_m(peak_mm)),
        first=scans[0],
        later=scans[1],
        cavity=cavity,
    )
