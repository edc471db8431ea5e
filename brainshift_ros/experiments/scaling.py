"""Mesh size against time and memory of the whole atlas: 720 entries, each size in a process of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from brainshift_ros.experiments import scaling_case
from brainshift_ros.experiments.own_process import measured
from brainshift_ros.experiments.patients import patient_path, template_patient
from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.resources import resource

Progress = Callable[[str, float], None]

#: Asked numbers of nodes.
SIZES, LARGE = (5_000, 10_000, 20_000), (40_000, 80_000)
DEFAULT = 20_000

SCENE = "config/scene_full.yaml"

#: What the issue allows for 20,000 nodes on two quiet cores.
WALL_LIMIT_S, MEMORY_LIMIT_MB = 60.0, 2500.0


def run(folder: Path, full: bool, progress: Progress) -> dict[str, object]:
    """Build the whole atlas once a size.

    Parameters
    ----------
    folder
        Takes summary.json, table.csv and scaling.png; patients are kept in it, since meshing takes longer than an atlas.
    full
        Up to 80,000 nodes instead of 20,000.
    progress
        Called with stage and fraction done.
    """
    rows: list[dict[str, Any]] = []
    for nodes in (*SIZES, *LARGE) if full else SIZES:
        template_patient(folder, nodes, 0, progress)
        progress(f"{nodes} nodes: atlas", 0.0)
        patient = patient_path(folder, nodes, 0).absolute()
        figures = measured(scaling_case.__name__, [patient, Path(resource(SCENE)).absolute(), "atlas.h5"])
        rows.append({"asked": nodes, **figures})
        progress(f"{nodes} nodes: atlas", 1.0)
    exponents = {key: _exponent(rows, key) for key in ("wall, s", "CPU, s", "peak memory, MB")}
    summary: dict[str, object] = {"scene": SCENE, "grows with the number of nodes to the power": exponents, "rows": rows}
    write_results(folder, summary, rows)
    write_figure(folder / "scaling.png", chart(rows))
    return summary


def chart(rows: list[dict[str, Any]]) -> Figure:
    """Draw time by stage and memory over the number of nodes, with the limits at the default size."""
    nodes = [row["nodes"] for row in rows]
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    time, memory = figure.subplots(1, 2)
    time.loglog(nodes, [row["wall, s"] for row in rows], "o-", color="black", label="wall")
    time.loglog(nodes, [row["CPU, s"] for row in rows], "s--", color="0.4", label="CPU")
    stages = [key for key in rows[0] if key.endswith(", s") and key not in ("wall, s", "CPU, s")]
    for key in stages:
        time.loglog(nodes, [max(row[key], 1e-2) for row in rows], ".:", label=f"of the wall time: {key.removesuffix(', s')}")
    time.plot(DEFAULT, WALL_LIMIT_S, "_", color="tab:red", markersize=28, markeredgewidth=2)
    time.annotate("limit", (DEFAULT, WALL_LIMIT_S), (6, 5), textcoords="offset points", color="tab:red", fontsize=8)
    time.set_title(f"an atlas of {rows[0]['entries']} entries, s", fontsize=10)
    memory.loglog(nodes, [row["peak memory, MB"] for row in rows], "o-", color="black", label="peak memory of the build")
    memory.loglog(nodes, [row["file, MB"] for row in rows], "s--", color="0.4", label="atlas file")
    memory.plot(DEFAULT, MEMORY_LIMIT_MB, "_", color="tab:red", markersize=28, markeredgewidth=2)
    memory.annotate("limit", (DEFAULT, MEMORY_LIMIT_MB), (6, 5), textcoords="offset points", color="tab:red", fontsize=8)
    memory.set_title("memory and file, MB", fontsize=10)
    for axes in (time, memory):
        axes.set_xlabel("nodes")
        axes.grid(visible=True, which="both", alpha=0.25)
        axes.legend(fontsize=8)
    return figure


def _exponent(rows: list[dict[str, Any]], key: str) -> float:
    """Slope of a figure over the number of nodes, both in logarithms."""
    slope = np.polyfit(np.log([row["nodes"] for row in rows]), np.log([row[key] for row in rows]), 1)[0]
    return round(float(slope), 2)
