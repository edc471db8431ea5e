"""Chart of :mod:`brainshift_ros.experiments.atlas_levels`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brainshift_ros.atlas.columns import fluid_levels
from brainshift_ros.experiments.atlas_studies import values_of

Row = Mapping[str, Any]

_COLORS = ("#252525", "#2171b5", "#238b45", "#d94801", "#88419d")
_MARKERS = "os^v*"
_GROUPS = ("surface", "subsurface", "deep")


def chart(rows: Sequence[Row], names: Sequence[str], cost: Mapping[str, Row]) -> Figure:
    """Draw errors over the fluid's true level, the changes over drawn truths, and what the atlases cost."""
    figure = Figure(figsize=(15, 8.2), layout="constrained")
    grid = figure.subplots(2, 3)
    for axes, group in zip(grid[0], _GROUPS, strict=True):
        _over_level(axes, [row for row in rows if (row["truths"], row["group"]) == ("gravity", group)], names)
        axes.set_title(f"{group}: gravity alone", fontsize=10)
    for axes, group in zip(grid[1, :2], _GROUPS, strict=False):
        _changes(axes, [row for row in rows if (row["truths"], row["group"]) == ("drawn", group)], names)
        axes.set_title(f"{group}: drawn truths (gravity, drug, resection; 4 to 20 mm)", fontsize=10)
    grid[0, 0].set_ylabel("mean error, mm")
    grid[1, 0].set_ylabel("error less that with three levels, mm")
    _cost(grid[1, 2], cost)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(names) + 1, fontsize=9)
    truths = len({row["truth"] for row in rows})
    figure.suptitle(
        f"levels of the fluid and of the drug in the atlas; {truths} truths of another mesh and stiffness", fontsize=11
    )
    return figure


def _over_level(axes: Axes, rows: Sequence[Row], names: Sequence[str]) -> None:
    levels = sorted({row["fluid_level"] for row in rows})
    for k, (name, color) in enumerate(zip(names, _COLORS, strict=False)):
        mean = [values_of(rows, "error_mm", levels=name, fluid_level=level).mean() for level in levels]
        axes.plot(levels, mean, _MARKERS[k] + "-", color=color, markersize=5, label=name)
    for level in fluid_levels(3):
        axes.axvline(level, color="0.6", linestyle=":", linewidth=1.0)
    axes.set_xlabel("the truth's fluid level (dotted: the atlas's)")
    axes.set_ylim(0.0, None)
    axes.grid(alpha=0.25)


def _changes(axes: Axes, rows: Sequence[Row], names: Sequence[str]) -> None:
    three = values_of(rows, "error_mm", levels=names[0])
    changes = [values_of(rows, "error_mm", levels=name) - three for name in names[1:]]
    boxes = axes.boxplot(changes, widths=0.55, whis=(0, 100), patch_artist=True)
    for box, color in zip(boxes["boxes"], _COLORS[1:], strict=False):
        box.set(facecolor=color, alpha=0.5)
    for line in boxes["medians"]:
        line.set(color="#cb181d", linewidth=1.6)
    axes.axhline(0.0, color="0.4", linewidth=0.8)
    axes.set_xticks(range(1, len(names)), [_two_lines(name) for name in names[1:]], fontsize=8)
    axes.grid(axis="y", alpha=0.25)


def _cost(axes: Axes, cost: Mapping[str, Row]) -> None:
    names = list(cost)
    axes.barh(range(len(names)), [cost[name]["cpu_s"] for name in names], 0.5, color="0.6")
    axes.set_yticks([])
    for place, name in enumerate(names):
        axes.text(0.0, place - 0.36, f"{name} ({cost[name]['entries']} entries)", va="center", fontsize=9)
        axes.text(cost[name]["cpu_s"], place, f" {cost[name]['cpu_s']:.1f} s", va="center", fontsize=9)
    axes.set_xlim(0.0, 1.2 * max(cost[name]["cpu_s"] for name in names))
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlabel("CPU time of the build, s")
    axes.set_title("as figure 30 (published: 13.1 h and 2.2 h)", fontsize=10)


def _two_lines(name: str) -> str:
    return name.replace(": ", ":\n").replace(", one", ",\none")
