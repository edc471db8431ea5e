"""How far is automatic segmentation from the truth? Patients made of the template by random diffeomorphisms (spec P2).

The report is that of the thesis's chapter V: Dice, slices with errors (table 7), distances of falx thirds and tentoria
(figure 25). These patients have the template's own gyri, so real heads will come out worse: the study shows what the
registration loses to deformation, bias field, noise, contrast, skull and tumour, not what anatomy adds.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from brainshift_ros.evaluation.report import SegmentationReport, compare_segmentations
from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.image.tumor import TumorShape
from brainshift_ros.segmentation.segment import segment
from brainshift_ros.septa.template import septa_from_template
from brainshift_ros.simulation.synthetic_patient import synthetic_patient

Progress = Callable[[str, float], None]

#: Seeds of the random deformations in the whole study; the short one takes the first.
SEEDS = (1, 2, 3)

SPACING_MM = 3.0

#: What the segmentation has to reach: Dice, and mean distance of the septa in mm.
REQUIRED = {"brain": 0.97, "brainstem": 0.85, "septa_mm": 2.5}

REGIONS = ("brain", "left_cerebrum", "right_cerebrum", "cerebellum", "brainstem")
SHEETS = ("falx_anterior", "falx_middle", "falx_posterior", "tentorium_left", "tentorium_right")

Row = dict[str, str | int | float]


def run(folder: Path, full: bool, progress: Progress) -> dict[str, object]:
    """Segment stripped brains and whole heads with a tumour, and compare with the truth.

    Parameters
    ----------
    folder
        Takes summary.json, table.csv and segmentation.png.
    full
        Three deformations of each kind instead of one.
    progress
        Called with stage and fraction done.
    """
    seeds = SEEDS if full else SEEDS[:1]
    cases = [(kind, seed) for kind in ("stripped", "whole head") for seed in seeds]
    rows: list[Row] = []
    for kind, seed in cases:
        progress(f"{kind} {seed}", 0.0)
        rows.append(_row(kind, seed))
        progress(f"{kind} {seed}", 1.0)
        summary = _summary(rows, len(cases))
        write_results(folder, summary, rows)
        write_figure(folder / "segmentation.png", _figure(rows))
    return summary


def _row(kind: str, seed: int) -> Row:
    patient = synthetic_patient(seed, whole_head=kind == "whole head", tumor=TumorShape())
    with Stopwatch() as watch:
        found = segment(patient.t1, tumor=patient.tumor)
    septa = septa_from_template(found.template_map.to_patient, SPACING_MM)
    report = compare_segmentations(found.labels, patient.labels, septa, patient.septa)
    row: Row = {"case": kind, "seed": seed, "mean_displacement_mm": round(patient.warp.mean_mm, 2)}
    row |= {f"dice_{name}": round(float(report.regions[name].dice), 4) for name in REGIONS}
    row |= {"slices_with_errors": len(report.slices.with_errors), "slices": report.slices.with_brain}
    row |= {f"{name}_mm": round(_distance_mm(report, name), 3) for name in (*SHEETS, "all")}
    return row | {"wall_s": round(watch.wall_s, 1), "cpu_s": round(watch.cpu_s, 1)}


def _distance_mm(report: SegmentationReport, sheet: str) -> float:
    distance = report.septa[sheet].to_manual
    return float("nan") if distance is None else float(distance.mean_mm)


def _summary(rows: list[Row], planned: int) -> dict[str, object]:
    def column(name: str) -> list[float]:
        return [float(row[name]) for row in rows]

    return {
        "required": REQUIRED,
        "cases": len(rows),
        "planned": planned,
        "dice_brain_min": min(column("dice_brain")),
        "dice_brainstem_min": min(column("dice_brainstem")),
        "dice_cerebellum_min": min(column("dice_cerebellum")),
        "septa_mm_max": max(column("all_mm")),
        "slices_with_errors": [f"{row['slices_with_errors']} of {row['slices']}" for row in rows],
        "wall_s_median": float(np.median(column("wall_s"))),
        "cpu_s_median": float(np.median(column("cpu_s"))),
    }


def _figure(rows: list[Row]) -> Figure:
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    overlap, distance = figure.subplots(1, 2)
    width = 0.8 / len(rows)
    for number, row in enumerate(rows):
        offset = (number - (len(rows) - 1) / 2) * width
        colour = f"C{0 if row['case'] == 'stripped' else 1}"
        label = f"{row['case']}, seed {row['seed']}"
        overlap.bar(np.arange(len(REGIONS)) + offset, [row[f"dice_{name}"] for name in REGIONS], 0.9 * width, color=colour)
        distance.bar(
            np.arange(len(SHEETS)) + offset, [row[f"{name}_mm"] for name in SHEETS], 0.9 * width, color=colour, label=label
        )
    overlap.set(ylim=(0.8, 1.0), ylabel="Dice", title="labels against the truth")
    overlap.set_xticks(range(len(REGIONS)), [name.replace("_", "\n") for name in REGIONS])
    for name, low in (("brain", REQUIRED["brain"]), ("brainstem", REQUIRED["brainstem"])):
        at = REGIONS.index(name)
        overlap.hlines(low, at - 0.5, at + 0.5, color="black", linestyle="--", linewidth=1.0)
    distance.axhline(REQUIRED["septa_mm"], color="black", linestyle="--", linewidth=1.0)
    distance.set(ylabel="mean closest-point distance, mm", title="septa against the truth (dashed: required)")
    distance.set_xticks(range(len(SHEETS)), [name.replace("_", "\n") for name in SHEETS])
    distance.legend(fontsize=8)
    return figure
