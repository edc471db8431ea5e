"""What does the accuracy of registration cost in time? Engines and resolutions on patients whose truth is known (spec E7).

The time is that of a segmentation: linear part, non-rigid part, and carrying the labels to the patient's grid.

ANTs (SyN) takes part if the environment variable BRAINSHIFT_ANTS_PYTHON names an interpreter that has antspyx, in an
environment of its own: antspyx asks for older NumPy and SciPy than this package has.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from brainshift_ros.evaluation.overlap import dice
from brainshift_ros.evaluation.septa_distance import septa_distances
from brainshift_ros.experiments.registration_engines import Engine, ants_engine, demons_engine, greedy_engine
from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.image.labels import add_tumor
from brainshift_ros.image.template import template_labels, template_landmarks, template_t1
from brainshift_ros.image.tumor import TumorShape
from brainshift_ros.image.volume import Region
from brainshift_ros.segmentation.segment import carried
from brainshift_ros.segmentation.settings import SegmentationSettings
from brainshift_ros.septa.template import septa_from_template
from brainshift_ros.simulation.synthetic_patient import SyntheticPatient, synthetic_patient
from brainshift_ros.units import m_to_mm

Progress = Callable[[str, float], None]
Row = dict[str, str | int | float]

#: Seconds that a segmentation may take on two cores.
LIMIT_S = 90.0

#: The variable that names an interpreter with antspyx.
ANTS_VARIABLE = "BRAINSHIFT_ANTS_PYTHON"

DEFAULT = "greedy 2 mm"

#: Whole head or not, and seed.
PATIENTS, MORE_PATIENTS = ((True, 1),), ((True, 2), (False, 1))

_SEPTA_SPACING_MM = 3.0

#: What the chart shows: column, label, and what a segmentation has to reach.
_SHOWN = (
    ("dice_brain", "Dice, brain", 0.97),
    ("dice_brainstem", "Dice, brainstem", 0.85),
    ("septa_mm", "mean distance of the septa, mm", 2.5),
)


def run(folder: Path, full: bool, progress: Progress) -> dict[str, object]:
    """Register every patient by every engine, and compare with the truth.

    Parameters
    ----------
    folder
        Takes summary.json, table.csv and registration.png.
    full
        Three patients instead of one; also 1 mm, mutual information instead of local correlation, and few iterations.
    progress
        Called with stage and fraction done.
    """
    chosen = PATIENTS + MORE_PATIENTS if full else PATIENTS
    rows: list[Row] = []
    for whole_head, seed in chosen:
        patient = synthetic_patient(seed, whole_head=whole_head, tumor=TumorShape())
        case = f"{'whole head' if whole_head else 'stripped'}, seed {seed}"
        for name, engine in engines(full).items():
            progress(f"{case}: {name}", 0.0)
            rows.append({"engine": name, "patient": case, **measured(engine, patient)})
            progress(f"{case}: {name}", 1.0)
            summary = _summary(rows, len(chosen))
            write_results(folder, summary, rows)
            write_figure(folder / "registration.png", chart(rows))
    return summary


def engines(full: bool) -> dict[str, Engine]:
    """Candidates by name; all of them on two threads."""
    default = SegmentationSettings()
    changes: dict[str, SegmentationSettings] = {
        "greedy 3 mm": replace(default, spacing_mm=3.0),
        DEFAULT: default,
        "greedy 1.5 mm": replace(default, spacing_mm=1.5),
    }
    if full:
        changes["greedy 1 mm"] = replace(default, spacing_mm=1.0, timeout_s=3600.0)
        changes["greedy 2 mm, NMI"] = replace(default, metric="nmi")
        changes["greedy 2 mm, few iterations"] = replace(default, iterations=(50, 20, 5))
    found = {name: greedy_engine(settings) for name, settings in changes.items()}
    found["SimpleITK demons 2 mm"] = demons_engine(default)
    python = os.environ.get(ANTS_VARIABLE)
    if python:
        found["ANTs SyN 2 mm"] = ants_engine(python, default)
    return found


def measured(engine: Engine, patient: SyntheticPatient) -> dict[str, float]:
    """Run one engine on one patient: seconds, Dice, distances of the septa and of points in the brain."""
    template, regions = template_t1(), template_labels(template_landmarks())
    with Stopwatch() as watch:
        template_map = engine(template, regions.data > 0, patient.t1, patient.tumor)
        labels = carried(regions, template_map, patient.t1)
    if patient.tumor is not None:
        labels = add_tumor(labels, patient.tumor)
    ours, truth = labels.data, patient.labels.data
    septa = septa_from_template(template_map.to_patient, _SEPTA_SPACING_MM)
    distance = septa_distances(septa, patient.septa, patient.labels)["all"].to_manual
    some = np.argwhere(regions.data > 0)[::500]
    points = some @ regions.T_patient_voxel[:3, :3].T + regions.T_patient_voxel[:3, 3]
    return {
        "wall_s": round(watch.wall_s, 1),
        "cpu_s": round(watch.cpu_s, 1),
        "dice_brain": round(dice(ours > 0, truth > 0), 4),
        "dice_cerebellum": round(dice(ours == Region.CEREBELLUM, truth == Region.CEREBELLUM), 4),
        "dice_brainstem": round(dice(ours == Region.BRAINSTEM, truth == Region.BRAINSTEM), 4),
        "volume_percent": round(100.0 * np.count_nonzero(ours) / np.count_nonzero(truth) - 100.0, 2),
        "septa_mm": float("nan") if distance is None else round(distance.mean_mm, 3),
        "points_mm": round(_mean_mm(template_map.to_patient(points) - patient.to_patient(points)), 3),
        "smallest_jacobian": round(float(template_map.jacobian_determinant().min()), 3),
    }


def chart(rows: list[Row]) -> Figure:
    """Draw accuracy over time, medians over the patients: the default starred, the limit of time and the targets dashed."""
    figure = Figure(figsize=(15, 4.9), layout="constrained")
    names = list(dict.fromkeys(str(row["engine"]) for row in rows))
    shown = figure.subplots(1, len(_SHOWN))
    for axes, (key, label, required) in zip(shown, _SHOWN, strict=True):
        for number, name in enumerate(names):
            _point(axes, [row for row in rows if row["engine"] == name], key, f"C{number}")
        axes.axhline(required, color="0.4", linestyle="--", linewidth=0.9)
        axes.axvline(LIMIT_S, color="tab:red", linestyle="--", linewidth=0.9)
        axes.text(LIMIT_S, 0.01, f" {LIMIT_S:g} s", transform=axes.get_xaxis_transform(), color="tab:red", fontsize=8)
        axes.set(xscale="log", xlabel="time, s", title=label)
        axes.set_xticks([10, 20, 50, 100, 200, 500], ["10", "20", "50", "100", "200", "500"])
        axes.minorticks_off()
        axes.margins(x=0.08, y=0.12)
        axes.grid(visible=True, alpha=0.25)
    figure.legend(handles=_legend(names), loc="outside lower center", ncols=min(len(names) + 3, 6), fontsize=9)
    patients = len({row["patient"] for row in rows})
    which = str(rows[0]["patient"]) if patients == 1 else f"medians of {patients} synthetic patients"
    figure.suptitle(f"template to patient: accuracy over time, two threads; {which}", fontsize=11)
    return figure


def _point(axes: Axes, rows: list[Row], key: str, colour: str) -> None:
    wall, cpu, value = (median(float(row[column]) for row in rows) for column in ("wall_s", "cpu_s", key))
    axes.plot([wall, cpu], [value, value], color=colour, linewidth=1.0, alpha=0.6)
    for time, face in ((wall, colour), (cpu, "white")):
        handle = _marker(str(rows[0]["engine"]), colour, face)
        handle.set_data([time], [value])
        axes.add_line(handle)
    axes.autoscale_view()


def _marker(name: str, colour: str, face: str) -> Line2D:
    star = name == DEFAULT
    size, label = (15.0, f"{name} (default)") if star else (8.0, name)
    return Line2D(
        [], [], color=colour, marker="*" if star else "o", markersize=size, markerfacecolor=face, linestyle="", label=label
    )


def _legend(names: list[str]) -> list[Line2D]:
    handles = [_marker(name, f"C{number}", f"C{number}") for number, name in enumerate(names)]
    handles += [_marker("filled: wall time", "0.3", "0.3"), _marker("open: CPU time", "0.3", "white")]
    return [*handles, Line2D([], [], color="0.4", linestyle="--", label="required")]


def _summary(rows: list[Row], planned: int) -> dict[str, object]:
    names = list(dict.fromkeys(str(row["engine"]) for row in rows))
    columns = [key for key in rows[0] if key not in ("engine", "patient")]
    medians = {
        name: {key: round(median(float(row[key]) for row in rows if row["engine"] == name), 4) for key in columns}
        for name in names
    }
    patients = len({row["patient"] for row in rows})
    return {"default": DEFAULT, "limit_s": LIMIT_S, "patients": patients, "planned": planned, "medians": medians}


def _mean_mm(vectors: NDArray[np.float64]) -> float:
    return float(m_to_mm(np.linalg.norm(vectors, axis=1)).mean())
