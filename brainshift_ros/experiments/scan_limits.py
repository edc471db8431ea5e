"""Where do registration and homologous points give up, and do they say so? Cases made worse one way at a time (spec E8)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.scan_scores import CaseScore, model_target, row_of, score_case, upper
from brainshift_ros.experiments.scans import failures_of
from brainshift_ros.simulation.scan_brains import SEGMENTATION_ERROR_M
from brainshift_ros.simulation.scan_cases import make_scan_case
from brainshift_ros.simulation.scan_plan import Severity, case_plan
from brainshift_ros.units import mm_to_m

Progress = Callable[[str, float], None]

#: Undisturbed cases (no cavity, no instruments) of three lobes.
CASES, MORE_CASES = (8,), (20, 29)
_TOP_MM = 5.0


@dataclass(frozen=True)
class Axis:
    """One way to make a case worse: its levels, few and all, and how a level is asked for."""

    label: str
    few: tuple[float, ...]
    levels: tuple[float, ...]
    severity: Callable[[float], Severity]


AXES: Mapping[str, Axis] = {
    "shift": Axis("greatest shift, mm", (10, 30, 50), (10, 20, 30, 40, 50), lambda mm: Severity(shift_mm=mm)),
    "dropouts": Axis(
        "share of points lost", (0.6,), (0.02, 0.2, 0.4, 0.6, 0.75), lambda share: Severity(dropout_fraction=share)
    ),
    "range_noise": Axis(
        "range noise, mm", (1.0,), (0.2, 0.5, 1.0, 1.5, 2.0), lambda mm: Severity(range_noise_m=float(mm_to_m(mm)))
    ),
    "segmentation": Axis(
        "segmentation error, mm", (1.0,), (0.25, 0.5, 1.0, 1.5), lambda mm: Severity(segmentation_error_m=float(mm_to_m(mm)))
    ),
    "blood": Axis(
        "share of the cortex under blood", (0.5,), (0.0, 0.2, 0.4, 0.6, 0.8), lambda share: Severity(blood_share=share)
    ),
}


@dataclass(frozen=True)
class Trial:
    """A case at one level of one axis."""

    axis: str
    level: float
    score: CaseScore

    @property
    def silent(self) -> bool:
        """Whether something wrong was handed on: a TRE beyond 3 mm accepted, or points of which 95 % are not within 2 mm."""
        registration, points = self.score.registration, self.score.points
        if not registration.result.accepted:
            return False
        wrong_pose = max(registration.surface_mm.max(), registration.deep_mm.max()) > 3.0
        return bool(wrong_pose or (points is not None and len(points.error_mm) > 0 and upper(points.error_mm, 0.95) > 2.0))


def run(folder: Path, full: bool, progress: Progress) -> dict[str, object]:
    """Score the cases at each level of each axis.

    Parameters
    ----------
    folder
        Takes summary.json, table.csv and limits.png.
    full
        All levels on three cases instead of a few on one.
    progress
        Called with stage and fraction done.
    """
    cases = CASES + MORE_CASES if full else CASES
    planned = [
        (name, level, number)
        for name, axis in AXES.items()
        for level in (axis.levels if full else axis.few)
        for number in cases
    ]
    trials: list[Trial] = []
    for done, (name, level, number) in enumerate(planned):
        progress("trials", done / len(planned))
        severity = AXES[name].severity(level)
        error_m = SEGMENTATION_ERROR_M if severity.segmentation_error_m is None else severity.segmentation_error_m
        score = score_case(make_scan_case(number, severity=severity), model_target(case_plan(number).brain, error_m))
        trials.append(Trial(name, level, score))
    progress("trials", 1.0)
    summary = summarise(trials)
    rows = [{"axis": t.axis, "level": t.level, "silently_wrong": t.silent, **row_of(t.score)} for t in trials]
    write_results(folder, summary, rows)
    write_figure(folder / "limits.png", chart(trials))
    return summary


def summarise(trials: Sequence[Trial]) -> dict[str, object]:
    """For each axis: up to which level every case is as required, and what was said beyond it."""
    found = {}
    for name in dict.fromkeys(trial.axis for trial in trials):
        here = [trial for trial in trials if trial.axis == name]
        failing = [trial.level for trial in here if failures_of(trial.score)]
        first_failure = min(failing, default=np.inf)
        fine = [trial.level for trial in here if trial.level < first_failure]
        found[name] = {
            "unit": AXES[name].label,
            "all_required_up_to": max(fine, default=None),
            "failures": {f"{t.level:g}, {t.score.name}": failures_of(t.score) for t in here if failures_of(t.score)},
        }
    return {"axes": found, "silently_wrong": sum(trial.silent for trial in trials), "trials": len(trials)}


def chart(trials: Sequence[Trial]) -> Figure:
    """Draw registration error, number of points and their errors over each axis."""
    names = list(dict.fromkeys(trial.axis for trial in trials))
    figure = Figure(figsize=(3.3 * len(names) + 0.6, 8.2), layout="constrained")
    panels = figure.subplots(3, len(names), squeeze=False, sharex="col")
    for column, name in enumerate(names):
        here = [trial for trial in trials if trial.axis == name]
        for number, case in enumerate(dict.fromkeys(trial.score.name for trial in here)):
            _draw(list(panels[:, column]), [trial for trial in here if trial.score.name == case], f"C{number}", case)
        for axes, limits in zip(panels[:, column], ((0.7, 3.0), (20.0,), (0.8, 2.0)), strict=True):
            for limit in limits:
                axes.axhline(limit, color="tab:red", linestyle="--", linewidth=0.8)
            axes.grid(visible=True, alpha=0.25)
            axes.set_ylim(bottom=0.0)
        panels[2, column].set_xlabel(AXES[name].label)
    panels[0, 0].set_ylabel("TRE on the cortex, mm\n(hollow: refused)")
    panels[1, 0].set_ylabel("homologous points")
    panels[2, 0].set_ylabel("their errors, mm\n(median; dotted: 95 %)")
    panels[0, 0].legend(fontsize=7)
    figure.suptitle(
        f"cases made worse one way at a time; red: what is required; errors beyond {_TOP_MM:g} mm: drawn there", fontsize=10
    )
    return figure


def _draw(panels: Sequence[Axes], trials: Sequence[Trial], color: str, label: str) -> None:
    levels = [trial.level for trial in trials]
    tre = [min(float(np.median(trial.score.registration.surface_mm)), _TOP_MM) for trial in trials]
    panels[0].plot(levels, tre, color=color, linewidth=0.8, label=label)
    for trial, value in zip(trials, tre, strict=True):
        face = color if trial.score.registration.result.accepted else "white"
        panels[0].plot(trial.level, value, "o", color=color, markerfacecolor=face, markersize=5)
    errors = [trial.score.points.error_mm if trial.score.points is not None else np.zeros(0) for trial in trials]
    panels[1].plot(levels, [len(found) for found in errors], "o-", color=color, linewidth=0.8, markersize=4)
    for share, style in ((0.5, "o-"), (0.95, "o:")):
        panels[2].plot(
            levels, [min(upper(e, share), _TOP_MM) for e in errors], style, color=color, linewidth=0.9, markersize=3.5
        )
