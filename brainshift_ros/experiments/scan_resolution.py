"""Scan resolution, and cells of the plane views, against accuracy and time of registration and homologous points (E7).

The same cases are scanned at several resolutions and go through a session as the node runs it; the finest scans, which any cell
size suits, go through it with several of them. The noise of a single range stays the same, so that finer scans also average
more of it away: a real scanner may have to trade one for the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brainshift_ros.correspondence.tracking import TrackingOptions
from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.scan_scores import CaseScore, model_target, score_case, upper
from brainshift_ros.registration.opening import pixel_spacing
from brainshift_ros.session.session import LrsOptions
from brainshift_ros.simulation.scan_cases import ScanCase, case_plan, make_scan_case
from brainshift_ros.simulation.scanner import Scanner
from brainshift_ros.units import m_to_mm

Progress = Callable[[str, float], None]
Row = dict[str, Any]

#: Width and height of the scans, pixels.
RESOLUTIONS = ((320, 240), (640, 480), (960, 720), (1280, 960))
USUAL, FINEST = RESOLUTIONS[1], RESOLUTIONS[-1]
CELLS_MM = (0.12, 0.2, 0.3, 0.45)
#: With instruments, and a far shift; the whole study has two plain ones, two with a cavity, two with both, and so on.
FEW, MANY = (5, 15), (2, 5, 10, 13, 15, 17, 22, 27)

_STAGES = ("registration", "resample", "coarse", "fine", "lift")


def run(folder: Path, full: bool, progress: Progress) -> dict[str, object]:
    """Score each case at each resolution, and at the finest one with each cell size.

    Parameters
    ----------
    folder
        Takes summary.json, table.csv and scan_resolution.png.
    full
        Eight cases instead of two.
    progress
        Called with stage and fraction done.
    """
    rows: list[Row] = []
    for number in MANY if full else FEW:
        target = model_target(case_plan(number).brain)
        for width, height in RESOLUTIONS:
            stage = f"case {number}, {width} x {height}"
            progress(stage, 0.0)
            case = make_scan_case(number, scanner=Scanner(width=width, height=height))
            finest = (width, height) == FINEST
            for cell_mm in CELLS_MM if finest else (TrackingOptions().cell_mm,):
                score = score_case(case, target, LrsOptions(tracking=TrackingOptions(cell_mm=cell_mm)))
                rows.append(row_of(case, score, cell_mm))
            progress(stage, 1.0)
    summary = {
        "default_cell_mm": TrackingOptions().cell_mm,
        "resolutions": means(rows, "width"),
        "cells": means(rows, "cell_mm"),
    }
    write_results(folder, summary, rows)
    write_figure(folder / "scan_resolution.png", chart(rows))
    return summary


def row_of(case: ScanCase, score: CaseScore, cell_mm: float) -> Row:
    """One session: errors, number of points, times."""
    height, width = case.first.scan.seen.shape
    points = score.points
    error = points.error_mm if points is not None else np.zeros(0)
    stages = dict.fromkeys(_STAGES, 0.0)
    for name, seconds in score.times_s.items():
        stage = name.split("_")[0]
        if stage in stages:
            stages[stage] += seconds
    return {
        "case": score.name,
        "width": width,
        "height": height,
        "pixel_mm": round(float(m_to_mm(pixel_spacing(case.first.scan))), 3),
        "cell_mm": cell_mm,
        "accepted": score.registration.result.accepted,
        "tre_surface_mm": round(float(np.median(score.registration.surface_mm)), 3),
        "tre_deep_mm": round(float(np.median(score.registration.deep_mm)), 3),
        "points": len(error),
        "error_median_mm": round(float(np.median(error)), 3) if len(error) else float("nan"),
        "error_p95_mm": round(upper(error, 0.95), 3),
        "within_sigma": round(float(np.mean(np.abs(points.z) < 1.0)), 3) if points is not None else float("nan"),
        "first_cpu_s": round(score.registration.cpu_s, 3),
        "later_cpu_s": round(points.cpu_s, 3) if points is not None else float("nan"),
        **{f"{stage}_s": round(seconds, 4) for stage, seconds in stages.items()},
    }


def means(rows: Sequence[Row], key: str) -> list[Row]:
    """Mean of every figure over the cases, by "width" at the default cell size, or by "cell_mm" at the finest resolution."""
    fixed, value = ("cell_mm", TrackingOptions().cell_mm) if key == "width" else ("width", FINEST[0])
    chosen = [row for row in rows if row[fixed] == value]
    result = []
    for value in sorted({row[key] for row in chosen}):
        own = [row for row in chosen if row[key] == value]
        figures = [name for name in own[0] if name not in ("case", "accepted")]
        result.append({name: float(np.nanmean([row[name] for row in own])) for name in figures})
    return result


def chart(rows: Sequence[Row]) -> Figure:
    """Draw errors, points and times over the resolution above, over the cell size below."""
    figure = Figure(figsize=(15, 8.4), layout="constrained")
    panels = figure.subplots(2, 3)
    for line, key, label, default in (
        (panels[0], "width", "columns of the scan (rows: three quarters)", USUAL[0]),
        (panels[1], "cell_mm", f"cells of the plane views at {FINEST[0]} x {FINEST[1]}, mm", TrackingOptions().cell_mm),
    ):
        mean = means(rows, key)
        at = [row[key] for row in mean]
        _errors(line[0], at, mean, registration=key == "width")
        line[1].plot(at, [row["points"] for row in mean], "o-", color="tab:green")
        line[1].axhline(20.0, color="tab:red", linewidth=0.8)
        line[1].set_title("homologous points a case; red: the least asked for", fontsize=9)
        line[1].set_ylim(0.0, None)
        _times(line[2], at, mean)
        for axes in line:
            axes.set_xticks(at)
            axes.axvline(default, color="0.5", linestyle="-.", linewidth=0.9)
            axes.text(default, 0.96, " default", transform=axes.get_xaxis_transform(), color="0.3", fontsize=8)
            axes.set_xlabel(label)
            axes.grid(visible=True, alpha=0.25)
    return figure


def _errors(axes: Axes, at: Sequence[float], mean: Sequence[Row], *, registration: bool) -> None:
    if registration:
        axes.plot(at, [row["tre_surface_mm"] for row in mean], "s--", label="registration, median on the cortex")
        axes.plot(at, [row["tre_deep_mm"] for row in mean], "^--", label="registration, median at depth")
    axes.plot(at, [row["error_median_mm"] for row in mean], "o-", color="tab:green", label="homologous points, median")
    axes.plot(at, [row["error_p95_mm"] for row in mean], "v-", color="tab:red", label="homologous points, 95 %")
    axes.set_title("error, mm; the tracker's own error of 0.1 to 0.3 mm a scan is in it", fontsize=9)
    axes.set_ylim(0.0, None)
    axes.legend(fontsize=8)


def _times(axes: Axes, at: Sequence[float], mean: Sequence[Row]) -> None:
    axes.plot(at, [row["first_cpu_s"] for row in mean], "s--", label="first scan to registered cloud, CPU s")
    axes.plot(at, [row["later_cpu_s"] for row in mean], "o-", label="later scan to points, CPU s")
    for stage in _STAGES[1:]:
        axes.plot(at, [row[f"{stage}_s"] for row in mean], ".:", label=f"of it {stage}, wall s")
    axes.axhline(1.0, color="tab:red", linewidth=0.8)
    axes.set_title("time; red: 1 s", fontsize=9)
    axes.set_ylim(0.0, 2.2 * max(1.0, *(row["later_cpu_s"] for row in mean)))
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(0.0, 0.94))
