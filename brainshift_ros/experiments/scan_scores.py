"""How a simulated scan case came out: registration error, errors and standard deviations of its homologous points, times."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, transform_points
from brainshift_ros.registration.register import RegistrationResult
from brainshift_ros.registration.target import CortexTarget, prepare_target
from brainshift_ros.session.session import LrsOptions, LrsSession, LrsUpdate
from brainshift_ros.simulation.scan_brains import SEGMENTATION_ERROR_M, brain
from brainshift_ros.simulation.scan_cases import ScanCase
from brainshift_ros.simulation.scanner import Seen
from brainshift_ros.units import m_to_mm

Result = TypeVar("Result")

#: Visible cortex counts as covered when a point lies within this distance.
COVERED_WITHIN_M = 10e-3
_CELL_M = 10e-3
_STILL_VISIBLE_M = 1e-3


@dataclass(frozen=True)
class RegistrationScore:
    """A registration against the truth.

    Attributes
    ----------
    result
        What the registration said.
    surface_mm, deep_mm
        Target registration errors on the cortex in the opening, and 15 to 50 mm below it.
    wall_s, cpu_s
        From the scan to its registered cloud.
    """

    result: RegistrationResult
    surface_mm: NDArray[np.float64]
    deep_mm: NDArray[np.float64]
    wall_s: float
    cpu_s: float


@dataclass(frozen=True)
class PointScore:
    """Homologous points against the truth.

    Attributes
    ----------
    residual_mm
        Shape (n, 3), measured minus true displacement; NaN where there is no such tissue: a false point.
    sigma_mm
        Shape (n,), what the points claim for each component.
    covered
        Share of 10 mm cells of the cortex that both scans see with a point within 10 mm.
    wall_s, cpu_s
        From the later scan to its points.
    """

    residual_mm: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]
    covered: float
    wall_s: float
    cpu_s: float

    @property
    def error_mm(self) -> NDArray[np.float64]:
        """Length of the residuals, shape (n,); infinite for false points, so that no quantile overlooks them."""
        return np.nan_to_num(np.linalg.norm(self.residual_mm, axis=1), nan=np.inf)

    @property
    def z(self) -> NDArray[np.float64]:
        """Residual components over their standard deviation, flat; false points are infinite."""
        return np.nan_to_num(self.residual_mm / self.sigma_mm[:, None], nan=np.inf).ravel()


@dataclass(frozen=True)
class CaseScore:
    """One case; `points` is None where the registration was refused, or the later scan."""

    name: str
    tags: frozenset[str]
    shift_mm: float
    start_deg: float
    start_mm: float
    registration: RegistrationScore
    points: PointScore | None
    refusal: str
    later: LrsUpdate | None
    times_s: Mapping[str, float]


@lru_cache(maxsize=4)
def model_target(brain_number: int, segmentation_error_m: float = SEGMENTATION_ERROR_M) -> CortexTarget:
    """Prepare the registration's target from a brain's model; cases share it."""
    return prepare_target(brain(brain_number, segmentation_error_m)[1])


def score_case(case: ScanCase, target: CortexTarget, options: LrsOptions | None = None) -> CaseScore:
    """Run a session through the case as the node would: pose, first scan, later scan.

    Parameters
    ----------
    case
        From :func:`brainshift_ros.simulation.scan_cases.make_scan_case`.
    target
        Prepared from the case's cortex.
    options
        Of the session.
    """
    session = LrsSession(target, options)
    session.set_initial_pose(case.start)
    placed, wall_s, cpu_s = _timed(lambda: session.place(case.first.scan))
    result = placed.registration
    if result is None:
        raise RuntimeError(f"{case.name}: a first scan with a pose came to no registration")
    surface, deep = case.tre_m(result.T_patient_tracker)
    registration = RegistrationScore(result, m_to_mm(surface), m_to_mm(deep), wall_s, cpu_s)
    times = dict(placed.times_s)
    points, later, refusal = None, None, "; ".join(result.reasons)
    if result.accepted:
        try:
            session.compare()  # prepares the first scan while nobody waits
            later, wall_s, cpu_s = _timed(lambda: session.add_scan(case.later.scan))
        except InputError as error:
            refusal = str(error)
        else:
            times |= later.times_s
            if later.homologous is not None:
                points = score_points(case, later.homologous, result.T_patient_tracker, wall_s, cpu_s)
    off = case.start @ invert_rigid(case.T_patient_tracker)
    center = case.scene.craniotomy.center
    return CaseScore(
        name=case.name,
        tags=case.tags,
        shift_mm=float(m_to_mm(case.shift_peak_m)),
        start_deg=float(np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude())),
        start_mm=float(m_to_mm(np.linalg.norm(transform_points(off, center) - center))),
        registration=registration,
        points=points,
        refusal=refusal,
        later=later,
        times_s=times,
    )


def score_points(
    case: ScanCase, points: HomologousPoints, T_patient_tracker: NDArray[np.float64], wall_s: float = 0.0, cpu_s: float = 0.0
) -> PointScore:
    """Compare homologous points, patient frame through `T_patient_tracker`, with the case's truth."""
    residual = case.point_residuals_m(points, T_patient_tracker)
    return PointScore(m_to_mm(residual), m_to_mm(points.sigma), covered_share(case, points.points), wall_s, cpu_s)


def covered_share(case: ScanCase, points: NDArray[np.float64]) -> float:
    """Share of 10 mm cells of the cortex that both scans see whose middle has a point (n, 3) within 10 mm."""
    first, later = (scan.material[scan.label == Seen.CORTEX] for scan in (case.first, case.later))
    visible = first[cKDTree(later).query(first)[0] < _STILL_VISIBLE_M]
    cell = np.unique(np.floor(visible / _CELL_M).astype(int), axis=0, return_inverse=True)[1].ravel()
    count = np.bincount(cell)
    middle = np.stack([np.bincount(cell, visible[:, k]) for k in range(3)], axis=-1) / count[:, None]
    middle = middle[count > 0.2 * np.median(count)]
    if len(points) == 0:
        return 0.0
    return float(np.mean(cKDTree(points).query(middle)[0] < COVERED_WITHIN_M))


def row_of(score: CaseScore) -> dict[str, object]:
    """One line of the study's table."""
    registration, points = score.registration, score.points
    error = points.error_mm if points is not None else np.zeros(0)
    known = len(error) > 0
    return {
        "case": score.name,
        "tags": " ".join(sorted(tag.replace(" ", "_") for tag in score.tags)),
        "shift_mm": round(score.shift_mm, 2),
        "start_deg": round(score.start_deg, 1),
        "start_mm": round(score.start_mm, 1),
        "accepted": registration.result.accepted,
        "refusal": score.refusal,
        "tre_surface_median_mm": round(float(np.median(registration.surface_mm)), 3),
        "tre_surface_max_mm": round(float(registration.surface_mm.max()), 3),
        "tre_deep_median_mm": round(float(np.median(registration.deep_mm)), 3),
        "tre_deep_max_mm": round(float(registration.deep_mm.max()), 3),
        **{f"evidence_{name}": _rounded(value) for name, value in asdict(registration.result.evidence).items()},
        "points": len(error),
        "false_points": int(np.isinf(error).sum()),
        "covered_share": round(points.covered, 3) if points is not None else 0.0,
        "error_median_mm": round(float(np.median(error)), 3) if known else "",
        "error_p95_mm": round(upper(error, 0.95), 3) if known else "",
        "error_max_mm": round(float(error.max()), 3) if known else "",
        "within_sigma": round(float(np.mean(np.abs(points.z) < 1.0)), 3) if points is not None and known else "",
        "sigma_median_mm": round(float(np.median(points.sigma_mm)), 3) if points is not None and known else "",
        "first_wall_s": round(registration.wall_s, 3),
        "first_cpu_s": round(registration.cpu_s, 3),
        "later_wall_s": round(points.wall_s, 3) if points is not None else "",
        "later_cpu_s": round(points.cpu_s, 3) if points is not None else "",
        "stages_ms": " ".join(f"{stage}={1e3 * seconds:.0f}" for stage, seconds in score.times_s.items()),
    }


def upper(values: NDArray[np.float64], share: float) -> float:
    """Smallest value that is not exceeded by `share` of the values, which may be infinite."""
    return float(np.quantile(values, share, method="higher")) if len(values) else float("nan")


def _rounded(value: object) -> object:
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _timed(work: Callable[[], Result]) -> tuple[Result, float, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - wall, time.process_time() - cpu
