"""Chart of :mod:`brainshift_ros.experiments.atlas_extent`: the boxes of figure 27, and where atlas and truths lie."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brainshift_ros.atlas.orientations import directions_in_cone
from brainshift_ros.experiments.atlas_studies import polar, values_of
from brainshift_ros.experiments.inverse_truths import PLANNED

#: Groups drawn beside each other at every angle.
GROUP_COLORS = {"surface": "#2171b5", "subsurface": "#d94801", "deep": "#6a51a3"}


def chart(rows: Sequence[dict[str, Any]], angles_deg: Sequence[float], orientations: int, cones: tuple[float, float]) -> Figure:
    """Draw a row of panels for each kind of truth: without resection, with it."""
    narrow, wide = cones
    settings = list(dict.fromkeys(row["setting"] for row in rows))
    figure = Figure(figsize=(15, 4.4 * len(settings)), layout="constrained")
    grid = figure.subplots(len(settings), 3, squeeze=False, width_ratios=(1.0, 1.0, 0.62))
    for panels, setting in zip(grid, settings, strict=True):
        for axes, resected in zip(panels[:2], (False, True), strict=True):
            _boxes(axes, [r for r in rows if (r["setting"], r["resected"]) == (setting, resected)], angles_deg, cones)
            axes.set_title(f"truths {setting}, {'tumour resected' if resected else 'no resection'}", fontsize=10)
            axes.set_ylabel("error of the estimate, mm")
        top = max(axes.get_ylim()[1] for axes in panels[:2])
        for axes in panels[:2]:
            axes.set_ylim(0.0, top)
        _orientation_error(panels[2], [r for r in rows if r["setting"] == setting], angles_deg, cones)
    grid[0, 0].legend(fontsize=8, loc="upper left")
    grid[-1, 2].legend(fontsize=8, loc="lower right")
    _map(figure, grid[0, 2], orientations, narrow, angles_deg)
    figure.suptitle(
        f"true orientation against the atlas's cone (shaded, {narrow:g}°, {orientations} orientations): median, quartiles, "
        f"extent over truths; dashed: median with a cone of {wide:g}°",
        fontsize=11,
    )
    return figure


def _boxes(axes: Axes, rows: Sequence[dict[str, Any]], angles_deg: Sequence[float], cones: tuple[float, float]) -> None:
    narrow, wide = cones
    width = 1.1
    for k, (group, color) in enumerate(GROUP_COLORS.items()):
        at = np.asarray(angles_deg) + (k - (len(GROUP_COLORS) - 1) / 2) * 1.25
        values = [values_of(rows, "error_mm", cone_deg=narrow, group=group, angle_deg=angle) for angle in angles_deg]
        boxes = axes.boxplot(values, positions=at, widths=width, whis=(0, 100), patch_artist=True, manage_ticks=False)
        for box in boxes["boxes"]:
            box.set(facecolor=color, alpha=0.45, edgecolor=color)
        for line in (*boxes["whiskers"], *boxes["caps"]):
            line.set(color=color)
        for line in boxes["medians"]:
            line.set(color="#cb181d", linewidth=1.6)
        median = [np.median(values_of(rows, "error_mm", cone_deg=wide, group=group, angle_deg=angle)) for angle in angles_deg]
        axes.plot(at, median, "--", color=color, linewidth=1.2)
        axes.plot([], [], "s", color=color, alpha=0.6, label=group)
    axes.axvspan(0.0, narrow, color="0.92", zorder=0)
    axes.set_xticks(angles_deg, [f"{angle:g}" for angle in angles_deg])
    axes.set_xlim(0.0, max(angles_deg) + 2.5)
    axes.set_xlabel("angle from the cone's centre, degrees")
    axes.grid(axis="y", alpha=0.25)


def _orientation_error(
    axes: Axes, rows: Sequence[dict[str, Any]], angles_deg: Sequence[float], cones: tuple[float, float]
) -> None:
    """Draw how far the weights' mean orientation is from the true one."""
    for cone, style in zip(cones, ("o-", "s--"), strict=True):
        values = [
            np.nanmedian(values_of(rows, "orientation_error_deg", cone_deg=cone, group="surface", angle_deg=angle))
            for angle in angles_deg
        ]
        axes.plot(angles_deg, values, style, color="0.25", markersize=4, label=f"cone of {cone:g}°")
    axes.axvspan(0.0, cones[0], color="0.92", zorder=0)
    axes.set_xlim(0.0, max(angles_deg) + 2.5)
    axes.set_ylim(0.0, None)
    axes.set_xlabel("angle from the cone's centre, degrees")
    axes.set_ylabel("mean orientation of the weights\nto the true one, degrees (median)")
    axes.grid(alpha=0.25)


def _map(figure: Figure, beside: Axes, orientations: int, cone_deg: float, angles_deg: Sequence[float]) -> None:
    """Inset: the atlas's orientations and the truths' angles, seen along the axis of the cone."""
    axes = beside.inset_axes((0.02, 0.52, 0.46, 0.46), projection="polar")
    angle, azimuth = polar(directions_in_cone(PLANNED, np.radians(cone_deg), orientations))
    axes.plot(azimuth, angle, ".", color="#2171b5", markersize=3)
    around = np.linspace(0.0, 2.0 * np.pi, 100)
    for ring in angles_deg:
        axes.plot(around, np.full(100, ring), color="#cb181d", linewidth=0.6)
    axes.set(xticks=[], yticks=[], ylim=(0.0, max(angles_deg) + 1.0))
    axes.set_title("atlas (dots), truths (rings)", fontsize=7, pad=2)
