"""Does the standard deviation of an estimate hold up? Coverage of 68 % and 95 % intervals on truths it was not tuned on.

Errors and deviations are of displacement components. Half the question is calibration: as many errors within the interval
as it says. The other half is sharpness: a deviation that is large everywhere covers everything and says nothing, so the
mean deviation stands beside the error, by distance to the nearest measured point.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import norm

from brainshift_ros.experiments.inverse_cases import study_atlas, study_scene
from brainshift_ros.experiments.inverse_truths import solved_truths, truth_patients
from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.uncertainty_cases import (
    DISTANCES_MM,
    TUNING_SEEDS,
    Scored,
    distance_name,
    scored_estimates,
    varied_truth,
)

Progress = Callable[[str, float], None]
Row = dict[str, Any]

#: Intervals that are judged: probability and half width in standard deviations.
INTERVALS: Mapping[int, float] = {68: 1.0, 95: 1.96}

DEFAULT_METHOD = "constrained"
METHODS = (DEFAULT_METHOD, "tikhonov_gcv", "least_squares")
NOISES_MM = (0.3, 0.5, 1.0)
COUNTS, MORE_COUNTS = (8, 24), (8, 15, 24, 60)
SEEDS, MORE_SEEDS = range(12), range(24)
SIZES, MORE_SIZES = (3_000, 3_500), (8_000, 10_000)

GROUPS = ("surface", "subsurface", "tumor_margin", "deep", "midline", "contralateral")
_COLORS = ("#d94801", "#fdae6b", "#74c476", "#2171b5", "#6a51a3", "#969696")


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Estimate truths, and count how often they lie within the stated intervals.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv and uncertainty.png, and keeps meshes, atlas and truths.
    full
        24 truths on finer meshes, an atlas of 60 orientations and four numbers of points, instead of 12, 20 and two.
    progress
        Called with stage and fraction done.
    """
    (atlas_nodes, truth_nodes), seeds = (MORE_SIZES, MORE_SEEDS) if full else (SIZES, SEEDS)
    atlas = study_atlas(folder, study_scene(orientations=60 if full else 20), progress, nodes=atlas_nodes)
    patients = truth_patients(folder, truth_nodes, progress)
    truths = solved_truths(folder, patients, map(varied_truth, seeds), progress)
    scored = list(scored_estimates(atlas, truths, METHODS, MORE_COUNTS if full else COUNTS, NOISES_MM))
    rows = [row_of(item) for item in scored]
    summary = {
        "truths": len(seeds),
        "columns": len(atlas.entries),
        "tuned_on_seeds": [TUNING_SEEDS.start, TUNING_SEEDS.stop - 1],
        **summary_of(rows),
    }
    write_results(folder, summary, rows)
    write_figure(folder / "uncertainty.png", chart(scored, rows))
    return summary


def row_of(item: Scored) -> Row:
    """Coverage of one estimate at the targets of one group, or distance."""
    covered = {f"within_{percent}": float(np.mean(item.ratio < width)) for percent, width in INTERVALS.items()}
    return {**item.labels, **covered, "error_mm": item.error_mm, "std_mm": item.std_mm}


def summary_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Mean coverage over estimates, each counted alike: by group, distance, noise, number of points, truth and method."""
    default = [row for row in rows if row["method"] == DEFAULT_METHOD]
    grouped = [row for row in default if row["group"] in GROUPS]
    bins = [distance_name(low, high) for low, high in pairwise(DISTANCES_MM)]
    return {
        "method": DEFAULT_METHOD,
        "all_groups": _means(grouped),
        "by_group": _by(default, "group", GROUPS),
        "by_distance": _by(default, "group", bins),
        "by_noise_mm": _by(grouped, "noise_mm"),
        "by_points": _by(grouped, "points"),
        "by_truth": _by(grouped, "truth"),
        "by_resected": _by(grouped, "resected"),
        "by_method": _by([row for row in rows if row["group"] in GROUPS], "method"),
    }


def _by(rows: Sequence[Row], key: str, values: Sequence[object] | None = None) -> dict[str, Row]:
    values = sorted({row[key] for row in rows}) if values is None else values
    parts = {str(value): [row for row in rows if row[key] == value] for value in values}
    return {name: _means(part) for name, part in parts.items() if part}


def _means(rows: Sequence[Row]) -> Row:
    names = [f"within_{percent}" for percent in INTERVALS]
    of_errors = {name: float(np.sqrt(np.mean([row[name] ** 2 for row in rows]))) for name in ("error_mm", "std_mm")}
    return {"estimates": len(rows), **{name: float(np.mean([row[name] for row in rows])) for name in names}, **of_errors}


def chart(scored: Sequence[Scored], rows: Sequence[Row]) -> Figure:
    """Draw coverage by group, over points and by method; a reliability diagram; deviation and error over distance."""
    summary = summary_of(rows)
    figure = Figure(figsize=(16, 9), layout="constrained")
    (by_group, reliability, distance), (points, noise, methods) = figure.subplots(2, 3)
    _coverage_bars(by_group, summary["by_group"], f"by target group, {DEFAULT_METHOD} (3.9)")
    _coverage_bars(points, summary["by_points"], "by number of measured points")
    _coverage_bars(noise, {f"{k} mm": v for k, v in summary["by_noise_mm"].items()} | summary["by_truth"], "by noise, by truth")
    _coverage_bars(methods, summary["by_method"], "by method")
    _reliability(reliability, scored)
    _over_distance(distance, summary["by_distance"])
    figure.suptitle(
        "Errors of displacement components within the stated standard deviation: truths that it was not tuned on", fontsize=12
    )
    return figure


def _coverage_bars(axes: Axes, parts: Mapping[str, Row], title: str) -> None:
    place = np.arange(len(parts))
    for percent, color, shift in ((68, "#6baed6", -0.2), (95, "#08519c", 0.2)):
        share = [100.0 * part[f"within_{percent}"] for part in parts.values()]
        bars = axes.bar(place + shift, share, 0.4, color=color, label=f"{percent} % interval")
        axes.bar_label(bars, fmt="%.0f", fontsize=8, padding=2)
        axes.axhline(percent, color=color, linestyle="--", linewidth=1)
    names = [fill(name.replace("_", " "), 13) for name in parts]
    sizes = [f"{part['std_mm']:.3g}\n{part['error_mm']:.3g}" for part in parts.values()]
    axes.set_xticks(place, [f"{size}\n{name}" for size, name in zip(sizes, names, strict=True)], fontsize=8)
    axes.set(ylim=(0, 112), ylabel="errors within the interval, %")
    axes.set_title(f"{title}\n(below: root mean squares of std and error, mm)", fontsize=10)
    axes.legend(fontsize=8, loc="lower left", framealpha=1.0, ncols=2)


def _reliability(axes: Axes, scored: Sequence[Scored]) -> None:
    stated = np.linspace(0.02, 0.99, 60)
    width = norm.ppf(0.5 + stated / 2.0)
    axes.plot([0, 100], [0, 100], color="0.5", linewidth=1)
    for group, color in zip(GROUPS, _COLORS, strict=True):
        own = [item for item in scored if item.labels["group"] == group and item.labels["method"] == DEFAULT_METHOD]
        if own:
            found = np.mean([(item.ratio[:, None] < width).mean(axis=0) for item in own], axis=0)
            axes.plot(100 * stated, 100 * found, color=color, label=group.replace("_", " "))
    axes.set(xlabel="stated probability of an interval, %", ylabel="errors within it, %", xlim=(0, 100), ylim=(0, 100))
    axes.set_title("reliability: above the line the deviation is too large", fontsize=10)
    axes.legend(fontsize=8)
    axes.grid(alpha=0.25)


def _over_distance(axes: Axes, parts: Mapping[str, Row]) -> None:
    middle = [0.5 * sum(float(edge) for edge in name.removesuffix(" mm").split(" to ")) for name in parts]
    axes.plot(middle, [part["std_mm"] for part in parts.values()], "o-", color="#08519c", label="stated deviation")
    axes.plot(middle, [part["error_mm"] for part in parts.values()], "s--", color="#d94801", label="error")
    axes.set(xlabel="distance to the nearest measured point, mm", ylabel="root mean square of a component, mm")
    axes.set_ylim(0.0, None)
    other = axes.twinx()
    for percent, color in ((68, "#6baed6"), (95, "#08519c")):
        other.plot(middle, [100 * part[f"within_{percent}"] for part in parts.values()], ":", color=color)
        other.axhline(percent, color=color, linewidth=0.6)
    other.set(ylim=(0, 102), ylabel="dotted: errors within the 68 and 95 % intervals, %")
    axes.set_title("over distance: sharp where it can be", fontsize=10)
    axes.legend(fontsize=8, loc="lower right")
