"""Error against seconds for linear and quadratic elements, on a box and on the brain (E7): which default follows.

On the box the solution is known and the mesh exact. On the brain every mesh has a surface, a tumour and septa of its own, so
that a finer one changes the problem as well as its solution. The reference there is the finest quadratic mesh, made from
another seed; where a curve stays level, the meshes differ and no longer the elements.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brainshift_ros.experiments.elements_box import box_row
from brainshift_ros.experiments.elements_brain import COMPARED, MECHANISMS, compared, directions_of, solve_brain
from brainshift_ros.experiments.patients import template_patient
from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.mechanics.space import ElementName

Progress = Callable[[str, float], None]
Row = dict[str, Any]

POISSONS_RATIOS = (0.45, 0.499)

#: Cells along the box's edge, as many dofs in P2 as in P1 with twice the cells.
BOX_CELLS: dict[ElementName, tuple[int, ...]] = {"P1": (6, 10, 16, 24), "P2": (3, 5, 8, 12)}
BOX_LARGE: dict[ElementName, tuple[int, ...]] = {"P1": (36,), "P2": (18,)}

#: Asked vertices of the brain's meshes by element, and of the reference.
BRAIN: dict[ElementName, tuple[int, ...]] = {"P1": (2_000, 4_000), "P2": (2_000,)}
BRAIN_LARGE: dict[ElementName, tuple[int, ...]] = {"P1": (2_500, 5_000, 10_000, 20_000, 40_000), "P2": (2_500, 5_000, 10_000)}
REFERENCE, REFERENCE_LARGE = 4_000, 20_000
ORIENTATIONS = 12

#: What the package does unless the scene says otherwise.
DEFAULT_ELEMENT, DEFAULT_NODES = "P1", 20_000

#: The reference's mesh is made from another seed than the rest.
REFERENCE_SEED = 1

#: An atlas's entries, for the time of a whole one.
ENTRIES = 720

#: What an atlas may cost, CPU s.
LIMIT_S = 60.0

_STYLE = {"P1": ("o-", "#d95f02"), "P2": ("s-", "#1b6ca8")}


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Measure error and time of both elements over mesh sizes.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv, box/table.csv and elements.png, and keeps the meshes.
    full
        The brain on 2,500 to 40,000 vertices, against quadratic elements on 20,000; else 2,000 against 4,000.
    progress
        Called with stage and fraction done.
    """
    box = _box_rows(full, progress)
    (folder / "box").mkdir(exist_ok=True)
    write_results(folder / "box", {"rows": box}, box)
    sizes, finest = (BRAIN_LARGE, REFERENCE_LARGE) if full else (BRAIN, REFERENCE)
    rows = _brain_rows(folder, sizes, finest, progress)
    means = _means(rows)
    summary = {"box": box, "brain": means, "verdict": _verdict(means)}
    write_results(folder, summary, rows)
    write_figure(folder / "elements.png", chart(box, means))
    return summary


def chart(box: Sequence[Row], brain: Sequence[Row]) -> Figure:
    """Draw error over CPU seconds: the box at two Poisson's ratios, the brain under each mechanism."""
    figure = Figure(figsize=(13.5, 8.2), layout="constrained")
    panels = figure.subplots(2, 2)
    for axes, ratio in zip(panels[0], POISSONS_RATIOS, strict=True):
        rows = [row for row in box if row["case"] == f"box, nu {ratio:g}"]
        _curves(axes, rows, "cpu_s", "error")
        axes.set(title=f"box, known solution free of divergence, Poisson's ratio {ratio:g}", ylabel="relative L2 error")
        axes.set_xlabel("assembly and one solution, CPU s")
    for axes, mechanism in zip(panels[1], MECHANISMS, strict=True):
        rows = [row for row in brain if row["mechanism"] == mechanism]
        _curves(axes, rows, "atlas_s", "error_mm_mean")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
        shift = np.mean([row["shift_mm_mean"] for row in rows])
        axes.set_title(f"brain, {mechanism}{' with contact' if mechanism == 'gravity' else ''}: mean shift {shift:.1f} mm")
        axes.set(xlabel=f"factorisation and {ENTRIES} entries, CPU s", ylabel="mean difference over target groups, mm")
    return figure


def _curves(axes: Axes, rows: Sequence[Row], x: str, y: str) -> None:
    for element, (marker, color) in _STYLE.items():
        own = [row for row in rows if row["element"] == element]
        axes.loglog([row[x] for row in own], [row[y] for row in own], marker, color=color, label=element)
        for row in own:
            axes.annotate(f"{row['vertices']:,}", (row[x], row[y]), (4, 4), textcoords="offset points", fontsize=7, color=color)
    axes.grid(visible=True, which="both", alpha=0.25)
    axes.legend(title="vertices beside the points", fontsize=8, title_fontsize=7)


def _box_rows(full: bool, progress: Progress) -> list[Row]:
    rows = []
    for ratio in POISSONS_RATIOS:
        for element in BOX_CELLS:
            for cells in BOX_CELLS[element] + (BOX_LARGE[element] if full else ()):
                progress(f"box: {element}, nu {ratio:g}, {cells} cells", 0.0)
                rows.append(box_row(cells, element, ratio))
    progress("box", 1.0)
    return rows


def _brain_rows(folder: Path, sizes: Mapping[ElementName, tuple[int, ...]], finest: int, progress: Progress) -> list[Row]:
    """Solve the reference, then every other mesh, and compare."""
    directions = directions_of(ORIENTATIONS)
    patient = template_patient(folder, finest, REFERENCE_SEED, progress)
    progress(f"brain: reference, {finest} vertices", 0.0)
    reference = solve_brain(patient, "P2", directions[:COMPARED])
    rows: list[Row] = []
    for element, counts in sizes.items():
        for nodes in counts:
            patient = template_patient(folder, nodes, 0, progress)
            progress(f"brain: {element}, {nodes} vertices", 0.0)
            rows += compared(solve_brain(patient, element, directions), reference)
    progress("brain", 1.0)
    return rows


def _means(rows: Sequence[Row]) -> list[Row]:
    """Mean over the groups of targets for each mesh, element and mechanism, and the time of a whole atlas."""
    means = []
    for key in dict.fromkeys((row["element"], row["vertices"], row["mechanism"]) for row in rows):
        own = [row for row in rows if (row["element"], row["vertices"], row["mechanism"]) == key]
        first = {name: own[0][name] for name in ("element", "vertices", "dofs", "mechanism", "factorise_s")}
        entry_s = own[0][f"{key[2]}_entry_s"]
        means.append(
            first
            | {
                "entry_s": entry_s,
                "atlas_s": own[0]["factorise_s"] + ENTRIES * entry_s,
                "shift_mm_mean": float(np.mean([row["shift_mm_mean"] for row in own])),
                "error_mm_mean": float(np.mean([row["error_mm_mean"] for row in own])),
            }
        )
    return means


def _verdict(means: Sequence[Row]) -> str:
    """Say which mesh and element are cheapest at the error under gravity that the default's, or the mesh nearest to it, has."""
    gravity = [row for row in means if row["mechanism"] == "gravity"]
    linear = [row for row in gravity if row["element"] == DEFAULT_ELEMENT]
    default = min(linear, key=lambda row: abs(row["vertices"] - DEFAULT_NODES))
    cheapest = min((row for row in gravity if row["error_mm_mean"] <= default["error_mm_mean"]), key=lambda row: row["atlas_s"])

    def told(row: Row) -> str:
        size = f"{row['element']} on {row['vertices']:,} vertices"
        return f"{size} ({row['error_mm_mean']:.2f} mm, {row['atlas_s']:.0f} CPU s for {ENTRIES} entries)"

    affordable = min(
        (row for row in gravity if row["atlas_s"] <= LIMIT_S), key=lambda row: row["error_mm_mean"], default=default
    )
    if cheapest is default:
        verdict = f"nothing measured is as accurate as {told(default)} for less"
    else:
        verdict = f"{told(cheapest)} is as accurate as {told(default)}, for less"
    return f"{verdict}; the most accurate within {LIMIT_S:.0f} s is {told(affordable)}"
