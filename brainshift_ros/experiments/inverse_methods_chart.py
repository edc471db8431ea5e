"""Part of :mod:`brainshift_ros.experiments.inverse_methods`: its pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from brainshift_ros.experiments.inverse_methods_cases import (
    BEST_CONSTRAINED,
    BEST_FREE,
    CONSTRAINED,
    DISTANCES_MM,
    LAMBDAS,
    LEAST_SQUARES,
    MEAN,
    NO_LIMIT,
    NOISES_MM,
    SWEPT,
    tikhonov_name,
)

Row = dict[str, Any]

#: Colour of each method: references grey, unconstrained red, Tikhonov with a given lambda from yellow to brown
#: and with a chosen one purple, constrained blue, ceilings green.
COLORS = {
    MEAN: "#969696",
    LEAST_SQUARES: "#de2d26",
    **dict(zip(map(tikhonov_name, LAMBDAS), ("#fee08b", "#fec44f", "#fe9929", "#cc6d11"), strict=True)),
    "Tikhonov, GCV": "#b48fd1",
    "Tikhonov, L-curve": "#6a3d9a",
    NO_LIMIT: "#9ecae1",
    CONSTRAINED: "#2171b5",
    BEST_CONSTRAINED: "#74c476",
    BEST_FREE: "#c7e9c0",
}

#: Corrections below are counted beside an arrow, not drawn.
_LOWEST = -60.0


def by_group(rows: Sequence[Row]) -> Figure:
    """Draw the corrections of all truths as boxes, a panel for each target group, a box for each method and noise."""
    groups = list(dict.fromkeys(row["group"] for row in rows))
    methods = [method for method in COLORS if any(row["method"] == method for row in rows)]
    figure = Figure(figsize=(16, 9.5), layout="constrained")
    for axes, group in zip(figure.subplots(2, 3, sharex=True, sharey=True).ravel(), groups, strict=False):
        own = [row for row in rows if row["group"] == group]
        for place, method in enumerate(methods):
            noises = sorted({row["noise_mm"] for row in own if row["method"] == method})
            for k, noise in enumerate(noises):
                values = np.array([r["correction_percent"] for r in own if r["method"] == method and r["noise_mm"] == noise])
                at = place + (0.0 if len(noises) == 1 else 0.38 * (k - 0.5))
                _box(axes, values, at, COLORS[method], 0.32, faded=k > 0)
        shift = np.mean([row["shift_mm"] for row in own])
        axes.set_title(f"{group.replace('_', ' ')}: mean shift {shift:.1f} mm", fontsize=11)
        axes.axhline(0.0, color="0.5", linewidth=0.8)
        axes.set_ylim(_LOWEST - 8.0, 102.0)
        axes.grid(axis="y", alpha=0.25)
        axes.set_xticks(range(len(methods)), methods, rotation=40, ha="right", fontsize=9)
    figure.supylabel("shift correction (4.4), %")
    truths = len({row["truth"] for row in rows})
    figure.suptitle(
        f"shift correction of {truths} truths by method, from 15 to 24 points in the craniotomy with noise of "
        f"{NOISES_MM[0]:g} mm (full colour) and {NOISES_MM[1]:g} mm (pale). "
        "▼: estimates below the axis",
        fontsize=11,
    )
    return figure


def over_distance(rows: Sequence[Row]) -> Figure:
    """Draw error and correction over the distance to the nearest measured point."""
    figure = Figure(figsize=(14, 5.2), layout="constrained")
    error, correction = figure.subplots(1, 2)
    for method, color in COLORS.items():
        own = [row for row in rows if row["method"] == method]
        if not own:
            continue
        starts = [start for start in DISTANCES_MM[:-1] if sum(row["distance_mm"] == start for row in own) > len(own) / 100]
        parts = [[row for row in own if row["distance_mm"] == start] for start in starts]
        at = np.array(starts) + 0.5 * (DISTANCES_MM[1] - DISTANCES_MM[0])
        shares = [np.array([100.0 * (1.0 - row["error_mm"] / row["shift_mm"]) for row in part]) for part in parts]
        style = {"color": color, "label": method, "linewidth": 2.4 if method in (CONSTRAINED, LEAST_SQUARES) else 1.4}
        error.semilogy(at, [np.median([row["error_mm"] for row in part]) for part in parts], "o-", markersize=3.5, **style)
        correction.plot(at, [np.median(part) for part in shares], "o-", markersize=3.5, **style)
        if method in (CONSTRAINED, LEAST_SQUARES):
            low, high = (np.array([np.quantile(part, q) for part in shares]) for q in (0.25, 0.75))
            correction.fill_between(at, low, high, color=color, alpha=0.15, linewidth=0.0)
    shift = [[row["shift_mm"] for row in rows if row["distance_mm"] == start] for start in DISTANCES_MM[:-1]]
    drawn = [(start + 5.0, np.median(part)) for start, part in zip(DISTANCES_MM, shift, strict=False) if part]
    error.semilogy(*zip(*drawn, strict=True), "k--", linewidth=1.0, label="the shift itself")
    error.set_ylabel("median over truths of the mean error, mm")
    error.yaxis.set_major_formatter("{x:g}")
    correction.set_ylabel("median shift correction, %; bands: quartiles")
    correction.set_ylim(_LOWEST, 100.0)
    correction.axhline(0.0, color="0.5", linewidth=0.8)
    for axes in (error, correction):
        axes.set_xlabel("distance to the nearest measured point, mm")
        axes.grid(visible=True, which="both", alpha=0.25)
    error.legend(fontsize=8, loc="upper right")
    figure.suptitle("how far from the measured points each method holds", fontsize=11)
    return figure


def over_lambda(rows: Sequence[Row]) -> Figure:
    """Draw what Tikhonov's method does for each lambda of (3.8), against the constrained method."""
    figure = Figure(figsize=(15, 5.2), layout="constrained")
    groups = [group for group in ("surface", "subsurface", "contralateral") if any(row["group"] == group for row in rows)]
    for axes, group in zip(figure.subplots(1, len(groups), sharey=True), groups, strict=True):
        own = [row for row in rows if row["group"] == group]
        for noise, color in zip(NOISES_MM, ("#cc6d11", "#fec44f"), strict=True):
            parts = [_values(own, tikhonov_name(value), noise) for value in SWEPT]
            axes.semilogx(SWEPT, [np.median(p) for p in parts], "o-", color=color, label=f"Tikhonov, {noise:g} mm noise")
            low, high = (np.maximum([np.quantile(part, q) for part in parts], 2.0 * _LOWEST) for q in (0.05, 0.95))
            axes.fill_between(SWEPT, low, high, color=color, alpha=0.25, linewidth=0.0)
        for noise, style in zip(NOISES_MM, ("-", "--"), strict=True):
            values = _values(own, CONSTRAINED, noise)
            label = f"constrained, {noise:g} mm noise"
            axes.axhline(float(np.median(values)), color=COLORS[CONSTRAINED], linestyle=style, label=label)
            low, high = np.quantile(values, (0.05, 0.95))
            axes.axhspan(low, high, color=COLORS[CONSTRAINED], alpha=0.08, linewidth=0.0)
        axes.set_ylim(_LOWEST, 100.0)
        axes.set_title(group, fontsize=11)
        axes.set_xlabel("λ of (3.8)")
        axes.grid(visible=True, alpha=0.25)
    axes.legend(fontsize=9, loc="lower right")
    figure.supylabel("shift correction (4.4), %")
    figure.suptitle(
        "Tikhonov's method over its λ, and the constrained method, which has none: median, and 5 to 95 % of the truths",
        fontsize=11,
    )
    return figure


def by_kind(rows: Sequence[Row]) -> Figure:
    """Draw the methods' corrections for each kind of truth: how they bear what the atlas does not model."""
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    methods = [method for method in COLORS if any(row["method"] == method and row["points"] for row in rows)]
    figure = Figure(figsize=(16, 9.0), layout="constrained")
    for axes, group in zip(figure.subplots(3, 1, sharex=True), ("surface", "subsurface", "contralateral"), strict=True):
        own = [row for row in rows if row["group"] == group and row["points"]]
        width = 0.86 / len(methods)
        for k, method in enumerate(methods):
            for place, kind in enumerate(kinds):
                values = np.array([r["correction_percent"] for r in own if r["method"] == method and r["kind"] == kind])
                at = place + width * (k - 0.5 * (len(methods) - 1))
                if len(values):
                    _box(axes, values, at, COLORS[method], 0.85 * width, faded=False)
        axes.axhline(0.0, color="0.5", linewidth=0.8)
        axes.set_ylim(_LOWEST - 8.0, 102.0)
        axes.set_title(group, fontsize=10)
        axes.grid(axis="y", alpha=0.25)
        counts = [len({row["truth"] for row in rows if row["kind"] == kind}) for kind in kinds]
        labels = [f"{kind}\n({count} truths)" for kind, count in zip(kinds, counts, strict=True)]
        axes.set_xticks(range(len(kinds)), labels, fontsize=10)
    handles = [Patch(facecolor=COLORS[method], label=method) for method in methods]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=9)
    figure.supylabel("shift correction (4.4), %")
    figure.suptitle(
        "the methods where the atlas models the truth, and where not; both noises. ▼: estimates below the axis", fontsize=11
    )
    return figure


def _values(rows: Sequence[Row], method: str, noise_mm: float) -> np.ndarray:
    return np.array([row["correction_percent"] for row in rows if row["method"] == method and row["noise_mm"] == noise_mm])


def _box(axes: Any, values: np.ndarray, at: float, color: str, width: float, *, faded: bool) -> None:
    """Draw a box with whiskers to the 5th and 95th percentiles, and count what lies below the axis."""
    axes.boxplot(
        np.maximum(values, _LOWEST - 20.0),
        positions=[at],
        widths=width,
        whis=(5, 95),
        showfliers=False,
        patch_artist=True,
        manage_ticks=False,
        boxprops={"facecolor": color, "alpha": 0.4 if faded else 1.0, "linewidth": 0.7},
        medianprops={"color": "black"},
        whiskerprops={"linewidth": 0.7},
        capprops={"linewidth": 0.7},
    )
    below = int((values < _LOWEST).sum())
    if below:
        axes.text(at, _LOWEST - 7.0, f"▼\n{below}", ha="center", va="bottom", fontsize=7)
