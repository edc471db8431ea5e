"""Whether an atlas needs levels of fluid and drug, or weights from 0 to 1 make up for them (thesis, chapter V).

The thesis finds no change with two levels (the lowest and the highest) or one (the highest) instead of three, and explains it
by the weights: they scale a column down. So the one level must be that of the largest shift; the study also takes the smallest,
which weights cannot reach beyond. Truths differ in mesh, stiffness and noise: first gravity over the fluid's level, then drawn
ones with drug and resection. Last, the smaller atlas of figure 30: half the orientations and one level, and what it costs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from brainshift_ros.atlas.build import build_atlas
from brainshift_ros.atlas.entry import AtlasEntry
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.experiments.atlas_levels_chart import chart
from brainshift_ros.experiments.atlas_studies import (
    INDEPENDENT,
    SAME_MM,
    Judge,
    p_text,
    signed_rank_p,
    solve_together,
    values_of,
)
from brainshift_ros.experiments.inverse_cases import columns_where, study_atlas, study_scene, subset
from brainshift_ros.experiments.inverse_truths import InverseTruth, TruthSpec, drawn_truth, solved_truths, truth_patients
from brainshift_ros.experiments.patients import template_patient
from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.skull_cases import MemoryAtlas
from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.mesh.patient import PatientModel

Progress = Callable[[str, float], None]
Row = dict[str, Any]

#: Ranks of the kept levels by the shift that they cause, 1 the smallest of three.
KEPT: Mapping[str, frozenset[int]] = {
    "three levels": frozenset({1, 2, 3}),
    "two: smallest, largest": frozenset({1, 3}),
    "one: largest shift": frozenset({3}),
    "one: smallest shift": frozenset({1}),
}
ALL, HALF = "three levels", "half the orientations, one level"

#: Fluid levels of the truths of gravity: the atlas's are 0.4, 0.6 and 0.8; 0.3 shifts more than any column.
FLUID_LEVELS = (0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.8)

GROUPS = ("surface", "subsurface")

DRAWN, OF_GRAVITY = "drawn", "gravity"


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Estimate truths with three, two and one level.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv and atlas_levels.png, and keeps meshes, atlases and truths.
    full
        60 orientations, 12 truths a fluid level, 48 drawn ones, meshes of 8,000 and 10,000 nodes; else 30, 4, 12, 3,000
        and 3,000.
    progress
        Called with stage and fraction done.

    Returns
    -------
    dict
        What summary.json holds; `thesis_holds_here` says whether fewer levels change the error.
    """
    orientations, per_level, drawn, nodes, truth_nodes = (60, 12, 48, 8_000, 10_000) if full else (30, 4, 12, 3_000, 3_000)
    patient = template_patient(folder, nodes, 0, progress)
    whole, half = study_scene(orientations=orientations), half_scene(orientations)
    atlas = study_atlas(folder, whole, progress, nodes=nodes)
    atlases = {name: of_levels(atlas, ranks) for name, ranks in KEPT.items()}
    atlases[HALF] = study_atlas(folder, half, progress, nodes=nodes)
    patients = truth_patients(folder, truth_nodes, progress)
    progress("truths of gravity", 0.0)
    truths = [(OF_GRAVITY, truth) for truth in solve_together(patients[0], level_specs(per_level))]
    truths += [(DRAWN, truth) for truth in solved_truths(folder, patients, map(drawn_truth, range(drawn)), progress)]
    rows = estimates(atlases, truths, progress)
    cost = {"three levels": build_cost(patient, whole, progress), HALF: build_cost(patient, half, progress)}
    summary = summary_of(rows, cost)
    write_results(folder, summary, rows)
    write_figure(folder / "atlas_levels.png", chart(rows, list(atlases), cost))
    return summary


def half_scene(orientations: int) -> Scene:
    """Scene of figure 30's smaller atlas: half the orientations, one level."""
    return study_scene(orientations=orientations // 2, fluid_levels=1, permeability_levels=1)


def of_levels(atlas: MemoryAtlas, ranks: frozenset[int]) -> MemoryAtlas:
    """Atlas of those columns whose level is among the ranks, 1 the one of the smallest shift."""
    fluid = sorted({entry.fluid_level for entry in atlas.entries if entry.mechanism == "gravity"}, reverse=True)

    def rank(entry: AtlasEntry) -> int:
        return entry.drug_level if entry.mechanism == "mannitol" else 1 + fluid.index(entry.fluid_level)

    return subset(atlas, columns_where(atlas, lambda entry: rank(entry) in ranks))


def level_specs(per_level: int) -> list[TruthSpec]:
    """Truths of gravity at every fluid level: the same orientations, states and stiffness fields at each."""
    drawn = [drawn_truth(1000 + number) for number in range(per_level)]
    return [TruthSpec(spec.seed, spec.direction, level, spec.resected) for spec in drawn for level in FLUID_LEVELS]


def estimates(atlases: Mapping[str, MemoryAtlas], truths: Sequence[tuple[str, InverseTruth]], progress: Progress) -> list[Row]:
    """Errors of every atlas for every truth, from the same points."""
    judge = Judge(next(iter(atlases.values())).mesh)
    rows = []
    for number, (kind, truth) in enumerate(truths):
        progress("estimates", number / len(truths))
        measured = INDEPENDENT.measured(truth, np.random.default_rng([number, 5]))
        for name, atlas in atlases.items():
            labels = {"truths": kind, "truth": number, "fluid_level": truth.spec.fluid_level, "levels": name}
            rows += [labels | row for row in judge.rows(atlas, truth, measured, INDEPENDENT.options)]
    progress("estimates", 1.0)
    return rows


def build_cost(patient: PatientModel, scene: Scene, progress: Progress) -> Row:
    """Entries of a scene's atlas, and the time that building it takes, s."""
    with TemporaryDirectory() as place, Stopwatch() as watch:
        report = build_atlas(patient, scene, Path(place) / "atlas.h5", progress=progress)
    return {"entries": report.entries, "cpu_s": watch.cpu_s, "wall_s": watch.wall_s}


def summary_of(rows: Sequence[Row], cost: Mapping[str, Row]) -> dict[str, Any]:
    """Errors by choice of levels, changes against three, and whether the thesis's finding holds."""
    names, groups = (list(dict.fromkeys(row[column] for row in rows)) for column in ("levels", "group"))
    changes = {
        kind: {name: {group: _change(rows, kind, name, group) for group in groups} for name in names if name != ALL}
        for kind in (DRAWN, OF_GRAVITY)
    }
    return {
        "thesis_holds_here": " ".join(_verdict(kind, changes[kind]) for kind in changes),
        "worst_fluid_level": _worst(rows),
        "smaller_atlas": _smaller(changes[DRAWN][HALF], cost),
        "same_mm": SAME_MM,
        "change": changes,
        "build": dict(cost),
    }


def _change(rows: Sequence[Row], kind: str, name: str, group: str) -> Row:
    """Change of error and correction against three levels over the same truths."""
    three, other = (values_of(rows, "error_mm", truths=kind, levels=levels, group=group) for levels in (ALL, name))
    before, after = (values_of(rows, "correction_percent", truths=kind, levels=levels, group=group) for levels in (ALL, name))
    change = other - three
    return {
        "truths": len(change),
        "error_mm": float(other.mean()),
        "change_mm": float(change.mean()),
        "change_mm_p05": float(np.quantile(change, 0.05)),
        "change_mm_p95": float(np.quantile(change, 0.95)),
        "correction_points": float((after - before).mean()),
        "signed_rank_p": signed_rank_p(three, other),
    }


def _told(change: Mapping[str, Row]) -> str:
    """Write the changes of the error of one choice."""
    return ", ".join(
        f"{group} {change[group]['change_mm']:+.2f} mm ({p_text(change[group]['signed_rank_p'])}) "
        f"or {change[group]['correction_points']:+.1f} points of correction"
        for group in GROUPS
    )


def _verdict(kind: str, changes: Mapping[str, Mapping[str, Row]]) -> str:
    """Say whether two levels or one change the error, and what the wrong one does."""
    fewer = ("two: smallest, largest", "one: largest shift")
    same = [all(abs(changes[name][group]["change_mm"]) <= SAME_MM for group in GROUPS) for name in fewer]
    answer = {
        (True, True): f"two levels or one change the mean error by at most {SAME_MM:g} mm, as in the thesis",
        (True, False): f"two levels change the mean error by at most {SAME_MM:g} mm, as in the thesis, one by more",
    }.get((same[0], same[1]), f"two levels change the mean error by over {SAME_MM:g} mm, not as in the thesis")
    told = [f"{name}: {_told(changes[name])}" for name in (*fewer, "one: smallest shift")]
    return f"Truths {'of gravity alone' if kind == OF_GRAVITY else kind}: {answer} ({'; '.join(told)})."


def _worst(rows: Sequence[Row]) -> str:
    """Say at which of the truths' fluid levels one level falls short the most."""
    told = []
    for group in GROUPS:
        change = {
            level: float(np.mean(one - three))
            for level in FLUID_LEVELS
            for three, one in [
                [
                    values_of(rows, "error_mm", truths=OF_GRAVITY, levels=name, group=group, fluid_level=level)
                    for name in (ALL, "one: largest shift")
                ]
            ]
        }
        worst = max(change, key=lambda level: change[level])
        told.append(f"{group} {change[worst]:+.2f} mm at the fluid level {worst:g}")
    return f"One level, that of the largest shift, falls short of three the most with {', '.join(told)}."


def _smaller(change: Mapping[str, Row], cost: Mapping[str, Row]) -> str:
    whole, half = cost[ALL], cost[HALF]
    return (
        f"{half['entries']} entries instead of {whole['entries']}, drawn truths: {_told(change)}; "
        f"built in {half['cpu_s']:.1f} s of CPU time instead of {whole['cpu_s']:.1f} s."
    )
