"""Mesh size against time, memory and geometric accuracy: each size in a process of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from brainshift_ros.experiments import meshing_case
from brainshift_ros.experiments.own_process import measured
from brainshift_ros.experiments.results import write_figure, write_results

Progress = Callable[[str, float], None]

#: Asked numbers of nodes; the command's range is 2,000 to 200,000.
SIZES, LARGE = (2_000, 5_000, 20_000), (50_000, 100_000, 200_000)
DEFAULT = 20_000

_SMALLEST = 0.02
_ERRORS = {
    "skull_distance_mm_mean": "brain surface, mean, mm",
    "tumor_distance_mm_mean": "tumour surface, mean, mm",
    "tumor_distance_mm_max": "tumour surface, largest, mm",
    "falx_area_error_percent": "area of the falx, %",
    "tentorium_area_error_percent": "area of the tentorium, %",
}


def run(folder: Path, full: bool, progress: Progress) -> dict[str, object]:
    """Mesh the template with its tumour and septa once a size.

    Parameters
    ----------
    folder
        Takes summary.json, table.csv and meshing.png.
    full
        Up to 200,000 nodes instead of 20,000, which takes half an hour more.
    progress
        Called with stage and fraction done.
    """
    rows: list[dict[str, Any]] = []
    for nodes in (*SIZES, *LARGE) if full else SIZES:
        progress(f"{nodes} nodes", 0.0)
        rows.append({"asked": nodes, **measured(meshing_case.__name__, [nodes])})
        progress(f"{nodes} nodes", 1.0)
    summary = {"default": DEFAULT, "rows": rows}
    write_results(folder, summary, rows)
    write_figure(folder / "meshing.png", chart(rows))
    return summary


def chart(rows: list[dict[str, Any]]) -> Figure:
    """Draw time, memory, errors and angles over the number of nodes, the default marked."""
    nodes = [row["nodes"] for row in rows]
    figure = Figure(figsize=(15, 4.4), layout="constrained")
    time, error, angle = figure.subplots(1, 3)
    time.loglog(nodes, [row["CPU, s"] for row in rows], "o-", label="CPU time, s")
    time.loglog(nodes, [row["wall, s"] for row in rows], "s--", label="wall time, s")
    time.loglog(nodes, [row["peak memory, MB"] for row in rows], "^:", label="peak memory, MB")
    time.loglog(nodes, [row["mesher_peak_mb"] for row in rows], "v:", label="of it the mesher, MB")
    time.axhline(90.0, color="0.6", linewidth=0.8)
    time.set_title("one patient model: mesh, split, tissue, cortex; grey: 90 s", fontsize=9)
    for key, label in _ERRORS.items():
        error.loglog(nodes, [max(row[key], _SMALLEST) for row in rows], "o-", label=label)
    error.set_title(f"distance or error of the meshed surfaces (below {_SMALLEST:g}: drawn there)", fontsize=9)
    angle.semilogx(nodes, [row["mesher_dihedral_min_deg"] for row in rows], "o--", label="smallest, from the mesher")
    angle.semilogx(nodes, [row["dihedral_min_deg"] for row in rows], "o-", label="smallest, repaired")
    angle.semilogx(nodes, [row["dihedral_p01_deg"] for row in rows], "s-", label="first percentile of elements")
    angle.axhline(10.0, color="tab:red", linewidth=0.8)
    angle.set_title("dihedral angle, degrees; red: the gate", fontsize=9)
    angle.set_ylim(0.0, None)
    for axes in (time, error, angle):
        axes.axvline(DEFAULT, color="0.5", linestyle="-.", linewidth=0.9)
        axes.text(DEFAULT, 0.96, " default", transform=axes.get_xaxis_transform(), color="0.3", fontsize=8)
        axes.set_xlabel("nodes")
        axes.grid(visible=True, which="both", alpha=0.25)
        axes.legend(fontsize=8)
    return figure
