"""Scans in, homologous points out: what comes of simulated cases, some tuned on and some held out (spec I1 to I4).

Each case is scanned before and after a known shift, and goes through a session as the node runs it. Numbers 0 to 35 served to
choose settings and gates; 36 to 71, on other brains, did not.

What the simulator cannot tell: how real vessels look (its trees have one colour each and do not pulse), how a real scanner's
range errs on wet and translucent tissue, tissue that tears or swells out of the opening, and brains unlike the template's.
Blood that pools over the cortex is in the study of limits only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.scan_scores import CaseScore, model_target, row_of, score_case, upper
from brainshift_ros.experiments.scans_pictures import Example, calibration_chart, example_of, montage, point_chart, tre_chart
from brainshift_ros.simulation.scan_cases import make_scan_case
from brainshift_ros.simulation.scan_plan import CASES_A_ROUND, case_plan

Progress = Callable[[str, float], None]

#: A spread over conditions and shifts, and all of two rounds.
FEW = (0, 5, 10, 15, 20, 25, 30, 35)
ALL = tuple(range(2 * CASES_A_ROUND))

#: Cases in the montage: conditions beside each other.
SHOWN = (0, 4, 5, 10, 13, 15, 20, 22, 25, 27, 30, 31, 35)
_MOST_SHOWN = 6


#: Between which each figure of a set has to lie.
REQUIRED: Mapping[str, tuple[float, float]] = {
    "tre_surface_median_mm": (0.0, 0.7),
    "tre_surface_p95_mm": (0.0, 1.5),
    "tre_deep_median_mm": (0.0, 0.7),
    "tre_deep_p95_mm": (0.0, 1.5),
    "tre_accepted_max_mm": (0.0, 3.0),
    "points_fewest": (20.0, np.inf),
    "point_error_median_mm": (0.0, 0.8),
    "point_error_p95_mm": (0.0, 2.0),
    "within_sigma": (0.60, 0.76),
}
_WORST_TRE_MM, _FEWEST_POINTS = REQUIRED["tre_accepted_max_mm"][1], REQUIRED["points_fewest"][0]
_MEDIAN_ERROR_MM, _P95_ERROR_MM = REQUIRED["point_error_median_mm"][1], REQUIRED["point_error_p95_mm"][1]


def run(folder: Path, full: bool, progress: Progress) -> dict[str, object]:
    """Score the cases.

    Parameters
    ----------
    folder
        Takes summary.json, table.csv and the pictures.
    full
        All 72 cases, 36 of them held out, instead of eight.
    progress
        Called with stage and fraction done.
    """
    numbers = ALL if full else FEW
    scores: list[CaseScore] = []
    examples: list[Example] = []
    for done, number in enumerate(numbers):
        progress("cases", done / len(numbers))
        case = make_scan_case(number)
        score = score_case(case, model_target(case_plan(number).brain))
        scores.append(score)
        if number in SHOWN and len(examples) < _MOST_SHOWN:
            examples.append(example_of(case, score))
    progress("cases", 1.0)
    summary = summarise(scores)
    write_results(folder, summary, [{"set": set_of(score), **row_of(score)} for score in scores])
    write_figure(folder / "registration.png", tre_chart(scores))
    write_figure(folder / "points.png", point_chart(scores))
    write_figure(folder / "calibration.png", calibration_chart(scores))
    write_figure(folder / "cases.png", montage(examples))
    return summary


def set_of(score: CaseScore) -> str:
    """Name the set of a case: ``tuned`` or ``held out``."""
    return "tuned" if int(score.name.rpartition("_")[2]) < CASES_A_ROUND else "held out"


def summarise(scores: Sequence[CaseScore]) -> dict[str, object]:
    """Figures of each set, whether each requirement is met, figures by condition, and what failed and why."""
    names = [name for name in ("tuned", "held out") if any(set_of(score) == name for score in scores)]
    sets = {name: figures([score for score in scores if set_of(score) == name]) for name in names}
    tags = sorted({tag for score in scores for tag in score.tags})
    return {
        "cases": len(scores),
        "sets": sets,
        "required": {name: [low, high if np.isfinite(high) else None] for name, (low, high) in REQUIRED.items()},
        "met": {name: {key: _met(found[key], *limits) for key, limits in REQUIRED.items()} for name, found in sets.items()},
        "by_tag": {tag: figures([score for score in scores if tag in score.tags]) for tag in tags},
        "failures": {score.name: failures_of(score) for score in scores if failures_of(score)},
        "median_stage_ms": _stage_medians(scores),
    }


def figures(scores: Sequence[CaseScore]) -> dict[str, float | int | None]:
    """Figures over some cases; None stands for infinite, or for nothing to measure."""
    return {"cases": len(scores), **_registration_figures(scores), **_point_figures(scores)}


def _registration_figures(scores: Sequence[CaseScore]) -> dict[str, float | int | None]:
    """Errors over all targets of the accepted registrations."""
    accepted = [score.registration for score in scores if score.registration.result.accepted]
    surface = _joined(registration.surface_mm for registration in accepted)
    deep = _joined(registration.deep_mm for registration in accepted)
    return {
        "accepted": len(accepted),
        "tre_surface_median_mm": _quantile(surface, 0.5),
        "tre_surface_p95_mm": _quantile(surface, 0.95),
        "tre_deep_median_mm": _quantile(deep, 0.5),
        "tre_deep_p95_mm": _quantile(deep, 0.95),
        "tre_accepted_max_mm": _quantile(_joined([surface, deep]), 1.0),
        "first_scan_wall_s_median": _quantile([score.registration.wall_s for score in scores], 0.5),
        "first_scan_cpu_s_median": _quantile([score.registration.cpu_s for score in scores], 0.5),
    }


def _point_figures(scores: Sequence[CaseScore]) -> dict[str, float | int | None]:
    """Errors over all points of the registered cases."""
    registered = [score for score in scores if score.registration.result.accepted]
    compared = [score.points for score in registered if score.points is not None]
    counts = [len(score.points.error_mm) if score.points is not None else 0 for score in registered]
    errors = _joined(points.error_mm for points in compared)
    z = np.abs(_joined(points.z for points in compared))
    covered = [points.covered for points in compared]
    return {
        "points_fewest": min(counts, default=None),
        "points_median": _quantile(counts, 0.5),
        "cases_below_20_points": sum(count < _FEWEST_POINTS for count in counts),
        "covered_share_median": _quantile(covered, 0.5),
        "covered_share_least": _quantile(covered, 0.0),
        "point_error_median_mm": _quantile(errors, 0.5),
        "point_error_p95_mm": _quantile(errors, 0.95),
        "point_error_max_mm": _quantile(errors, 1.0),
        "false_points": int(np.isinf(errors).sum()),
        "within_sigma": round(float(np.mean(z < 1.0)), 3) if len(z) else None,
        "within_two_sigma": round(float(np.mean(z < 2.0)), 3) if len(z) else None,
        "later_scan_wall_s_median": _quantile([points.wall_s for points in compared], 0.5),
        "later_scan_cpu_s_median": _quantile([points.cpu_s for points in compared], 0.5),
    }


def failures_of(score: CaseScore) -> list[str]:
    """Say what is wrong with a case, in words; empty when nothing is."""
    registration, points = score.registration, score.points
    worst = float(max(registration.surface_mm.max(), registration.deep_mm.max()))
    if not registration.result.accepted:
        return [f"registration refused (TRE up to {worst:.1f} mm): {score.refusal}"]
    found = []
    if worst > _WORST_TRE_MM:
        found.append(f"registration accepted with a TRE of {worst:.1f} mm")
    if points is None:
        return [*found, f"no points: {score.refusal}"]
    error = points.error_mm
    if len(error) < _FEWEST_POINTS:
        found.append(f"{len(error)} points")
    if len(error) and np.median(error) > _MEDIAN_ERROR_MM:
        found.append(f"median error of {np.median(error):.2f} mm")
    if len(error) and upper(error, 0.95) > _P95_ERROR_MM:
        found.append(f"95 % of errors below {upper(error, 0.95):.1f} mm only")
    return found


def _joined(parts: Iterable[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.concatenate([np.zeros(0), *parts])


def _quantile(values: Sequence[float] | NDArray[np.float64], share: float) -> float | None:
    """Quantile, rounded for a file; JSON knows neither infinity nor NaN."""
    value = upper(np.asarray(values, dtype=np.float64), share)
    return round(value, 3) if np.isfinite(value) else None


def _met(value: float | int | None, low: float, high: float) -> bool:
    """Whether a figure is known and lies within its limits."""
    return value is not None and bool(low <= value <= high)


def _stage_medians(scores: Sequence[CaseScore]) -> dict[str, float]:
    stages = dict.fromkeys(stage for score in scores for stage in score.times_s)
    return {
        stage: round(1e3 * float(np.median([score.times_s[stage] for score in scores if stage in score.times_s])), 1)
        for stage in stages
    }
