"""Is a dense field worth more than its points? Its error over distance, and an inverse whose points lie on one side.

The thesis (appendix E) proposes to interpolate between homologous points, and to weigh what was interpolated by an error that
grows with the distance to the nearest feature, fitted to vessels left out. First part: that curve against the truth, on
simulated scans. Second part: figure 56's case, points on one side of the craniotomy, with the weights and without.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from brainshift_ros.experiments import dense_field_inverse, dense_field_scans
from brainshift_ros.experiments.dense_field_inverse import COVERAGES, METHODS, MODEL_SIGMA_M, NOISE_M, POINTS
from brainshift_ros.experiments.results import write_figure, write_results, write_table
from brainshift_ros.units import m_to_mm

Progress = Callable[[str, float], None]
Row = dict[str, Any]

#: Truths of the inverse, and numbers of the scan cases.
SEEDS, MORE_SEEDS = range(3), range(12)
CASES, MORE_CASES = tuple(range(0, 36, 9)), tuple(range(72))

_GROUPS = ("surface, measured side", "surface, other side", "subsurface", "tumor_margin", "deep", "midline")
_COLORS = ("#525252", "#d94801", "#9ecae1", "#2171b5", "#6a51a3")


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Compare interpolated displacements and estimates from them with truths.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv (estimates), error_growth.csv, error_growth.png and one_sided.png, and keeps the meshes.
    full
        72 scan cases and 12 truths on finer meshes instead of 4 and 3.
    progress
        Called with stage and fraction done.
    """
    found = dense_field_scans.interpolated_cases(MORE_CASES if full else CASES, progress)
    write_table(folder / "error_growth.csv", dense_field_scans.table(found))
    write_figure(folder / "error_growth.png", dense_field_scans.chart(found))
    rows = dense_field_inverse.estimates(folder, full, MORE_SEEDS if full else SEEDS, progress)
    summary = {"interpolation": dense_field_scans.summary(found), "inverse": summary_of(rows)}
    write_results(folder, summary, rows)
    write_figure(folder / "one_sided.png", chart(rows))
    return summary


def summary_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Mean errors of the estimates over their truths, by coverage, method and target group."""
    return {
        "measured_points": POINTS,
        "noise_mm": float(m_to_mm(NOISE_M)),
        "model_sigma_mm": float(m_to_mm(MODEL_SIGMA_M)),
        "truths": len({row["seed"] for row in rows}),
        "error_mm": _means(rows, "error_mm"),
        "correction_percent": _means(rows, "correction_percent"),
    }


def chart(rows: Sequence[Row]) -> Figure:
    """Draw mean errors by target group, a panel for each coverage."""
    figure = Figure(figsize=(12.5, 7.6), layout="constrained")
    panels = figure.subplots(len(COVERAGES), 1, sharey=True)
    groups = [group for group in _GROUPS if any(row["group"] == group for row in rows)]
    width = 0.84 / len(METHODS)
    for axes, (coverage, share) in zip(panels, COVERAGES.items(), strict=True):
        own = [row for row in rows if row["coverage"] == coverage]
        for k, (method, color) in enumerate(zip(METHODS, _COLORS, strict=True)):
            values = [[r["error_mm"] for r in own if (r["method"], r["group"]) == (method, group)] for group in groups]
            at = np.arange(len(groups)) + width * (k - (len(METHODS) - 1) / 2)
            axes.bar(at, [np.mean(part) for part in values], 0.94 * width, color=color, label=method)
            for x, part in zip(at, values, strict=True):
                axes.plot(np.full(len(part), x), part, ".", color="black", ms=2.5, alpha=0.6)
        shift = [np.mean([row["shift_mm"] for row in own if row["group"] == group]) for group in groups]
        labels = [f"{group.replace('_', ' ')}\n(shift {mean:.1f} mm)" for group, mean in zip(groups, shift, strict=True)]
        axes.set_xticks(range(len(groups)), labels, fontsize=9)
        where = "all over the opening" if share == 1.0 else f"in {100 * share:.0f} % of the opening, from one side"
        axes.set_title(f"{POINTS} measured points {where}", fontsize=10)
        axes.grid(axis="y", alpha=0.25)
        axes.set_ylabel("mean error, mm")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    truths = len({row["seed"] for row in rows})
    figure.suptitle(f"what drives the inverse (3.9): mean of {truths} truths on another mesh; dots: each truth", fontsize=11)
    return figure


def _means(rows: Sequence[Row], column: str) -> dict[str, dict[str, dict[str, float]]]:
    """Mean over truths, by coverage, method and group."""
    groups = list(dict.fromkeys(row["group"] for row in rows))
    return {
        coverage: {
            method: {
                group: round(float(np.mean(values)), 4)
                for group in groups
                if (
                    values := [r[column] for r in rows if (r["coverage"], r["method"], r["group"]) == (coverage, method, group)]
                )
            }
            for method in METHODS
        }
        for coverage in COVERAGES
    }
