"""How far may the head lie from where it was planned? Truths tilted past the rim of the atlas's cone (thesis, figure 27).

The thesis tilts its truths by 2.5 to 32.5 degrees from the centre of a cone of 20 degrees and finds the error small within the
cone, growing outside, and larger with resection. Here also: truths of another mesh and stiffness with noise, and an atlas whose
cone holds all truths at the same number of orientations, which tells what a wider cone costs within the planned one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from brainshift_ros.experiments.atlas_extent_chart import chart
from brainshift_ros.experiments.atlas_studies import (
    AS_THESIS,
    INDEPENDENT,
    NOISE_M,
    POINTS,
    SAME_MM,
    Judge,
    Setting,
    degrees_from_plan,
    p_text,
    rank_sum_p,
    signed_rank_p,
    solve_together,
    values_of,
)
from brainshift_ros.experiments.inverse_cases import study_atlas, study_scene
from brainshift_ros.experiments.inverse_truths import CONE_DEG, PLANNED, TruthSpec, tilted
from brainshift_ros.experiments.patients import template_patient
from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.units import m_to_mm

Progress = Callable[[str, float], None]
Row = dict[str, Any]

#: Degrees from the cone's centre to the truths; the thesis's steps.
ANGLES_DEG = (2.5, 7.5, 12.5, 17.5, 22.5, 27.5, 32.5)

#: Half angle of the cone that holds them all.
WIDE_DEG = 35.0

#: Between the atlas's levels, so that no truth is a column even where its orientation is.
FLUID_LEVEL = 0.5

#: Groups that the verdict reads, as in figures 27 and 28.
GROUPS = ("surface", "subsurface")


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Estimate truths inside and outside the cone of the atlas.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv and atlas_extent.png, and keeps meshes and atlases.
    full
        Eight azimuths for each angle, 60 orientations, meshes of 8,000 and 10,000 nodes; else three, 30, 3,000 and 3,000.
    progress
        Called with stage and fraction done.

    Returns
    -------
    dict
        What summary.json holds; `thesis_holds_here` says whether figure 27 is met.
    """
    azimuths, orientations, nodes, truth_nodes = (8, 60, 8_000, 10_000) if full else (3, 30, 3_000, 3_000)
    rows: list[Row] = []
    for setting in (AS_THESIS, INDEPENDENT):
        if setting.points:
            patient = template_patient(folder, truth_nodes, 1, progress)
        else:
            patient = template_patient(folder, nodes, 0, progress)
        specs = tilted_specs(setting, azimuths)
        progress(f"truths, {setting.name}", 0.0)
        truths = solve_together(patient, specs)
        progress(f"truths, {setting.name}", 1.0)
        for cone_deg in (CONE_DEG, WIDE_DEG):
            scene = study_scene(cone_deg=cone_deg, orientations=orientations, skull=setting.skull)
            atlas = study_atlas(folder, scene, progress, nodes=nodes)
            judge = Judge(atlas.mesh)
            for number, truth in enumerate(truths):
                progress(f"estimates, {setting.name}, cone of {cone_deg:g} degrees", number / len(truths))
                measured = setting.measured(truth, np.random.default_rng([number, 27]))
                labels = {
                    "setting": setting.name,
                    "cone_deg": cone_deg,
                    "angle_deg": round(degrees_from_plan(truth.spec.direction), 1),
                    "resected": truth.spec.resected,
                    "truth": number,
                }
                rows += [labels | row for row in judge.rows(atlas, truth, measured, setting.options)]
            progress(f"estimates, {setting.name}, cone of {cone_deg:g} degrees", 1.0)
    summary = summary_of(rows)
    write_results(folder, summary, rows)
    write_figure(folder / "atlas_extent.png", figure(rows, orientations))
    return summary


def figure(rows: Sequence[Row], orientations: int) -> Figure:
    """Draw the boxes of figure 27, and where atlas and truths lie."""
    return chart(rows, ANGLES_DEG, orientations, (CONE_DEG, WIDE_DEG))


def tilted_specs(setting: Setting, azimuths: int) -> list[TruthSpec]:
    """Truths at every angle, evenly around the axis and turned from one angle to the next, without and with resection.

    Those at one azimuth share their stiffness field.
    """
    return [
        TruthSpec(
            seed=azimuth,
            direction=tilted(PLANNED, float(np.radians(angle)), 2.0 * np.pi * (azimuth / azimuths + 0.381966 * ring)),
            fluid_level=FLUID_LEVEL,
            resected=resected,
            skull=setting.skull,
            stiffness_spread=setting.stiffness_spread,
        )
        for resected in (False, True)
        for ring, angle in enumerate(ANGLES_DEG)
        for azimuth in range(azimuths)
    ]


def summary_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Errors within and outside the cone, by setting, cone of the atlas and state, and whether the thesis's finding holds."""
    found = {
        setting.name: {
            f"cone of {cone:g} degrees": {
                state: _inside_outside(rows, setting.name, cone, resected)
                for state, resected in (("tumour present", False), ("resected", True))
            }
            for cone in (CONE_DEG, WIDE_DEG)
        }
        for setting in (AS_THESIS, INDEPENDENT)
    }
    return {
        "thesis_holds_here": " ".join(_verdict(rows, setting.name) for setting in (AS_THESIS, INDEPENDENT)),
        "wider_cone": " ".join(_wider(rows, setting.name) for setting in (AS_THESIS, INDEPENDENT)),
        "truths": len({(row["setting"], row["truth"]) for row in rows}),
        "same_mm": SAME_MM,
        "angles_deg": ANGLES_DEG,
        "points": POINTS,
        "noise_mm": float(m_to_mm(NOISE_M)),
        "median_error_mm": found,
    }


def _inside_outside(rows: Sequence[Row], setting: str, cone_deg: float, resected: bool) -> Row:
    told: Row = {}
    for group in dict.fromkeys(row["group"] for row in rows):
        own = {"setting": setting, "cone_deg": cone_deg, "resected": resected, "group": group}
        by_angle = {angle: values_of(rows, "error_mm", angle_deg=angle, **own) for angle in ANGLES_DEG}
        told[group] = {f"{angle:g}": float(np.median(values)) for angle, values in by_angle.items()}
        inside = np.concatenate([values for angle, values in by_angle.items() if angle <= CONE_DEG])
        outside = np.concatenate([values for angle, values in by_angle.items() if angle > CONE_DEG])
        told[group] |= {"inside": float(np.median(inside)), "outside": float(np.median(outside))}
        told[group]["rank_sum_p"] = rank_sum_p(inside, outside)
    return told


def _errors(rows: Sequence[Row], setting: str, cone_deg: float, group: str, inside: bool) -> list[Row]:
    """Rows of a group on one side of the planned cone's rim, by truth."""
    own = (setting, cone_deg, group, inside)
    return [row for row in rows if (row["setting"], row["cone_deg"], row["group"], row["angle_deg"] <= CONE_DEG) == own]


def _verdict(rows: Sequence[Row], setting: str) -> str:
    """Say whether the error grows outside the cone, and with resection, by more than can be told."""
    told = []
    grows, resection = [], []
    for group in GROUPS:
        inside, outside = (
            np.array([row["error_mm"] for row in _errors(rows, setting, CONE_DEG, group, side)]) for side in (True, False)
        )
        p = rank_sum_p(inside, outside)
        grows.append(bool(np.median(outside) - np.median(inside) > SAME_MM and p < 0.05))
        told.append(f"{group} {np.median(inside):.2f} mm inside, {np.median(outside):.2f} mm outside ({p_text(p)})")
        own = {"setting": setting, "cone_deg": CONE_DEG, "group": group}
        present, resected = (values_of(rows, "error_mm", resected=state, **own) for state in (False, True))
        q = signed_rank_p(present, resected)
        resection.append(bool(np.median(resected - present) > SAME_MM and q < 0.05))
        told[-1] += f", resection {np.median(resected - present):+.2f} mm ({p_text(q)})"
    grown = {2: "larger outside the cone", 1: "larger outside in one group of two", 0: "not larger outside"}[sum(grows)]
    cut = {2: "larger with resection", 1: "larger with resection in one group of two", 0: "not larger with resection"}
    return f"Truths {setting}: median error {grown}, {cut[sum(resection)]}: {'; '.join(told)}."


def _wider(rows: Sequence[Row], setting: str) -> str:
    """Say what the wide cone brings outside the planned one, and costs inside it."""
    told = []
    for group in GROUPS:
        for inside in (True, False):
            errors = [
                np.median([row["error_mm"] for row in _errors(rows, setting, cone, group, inside)])
                for cone in (CONE_DEG, WIDE_DEG)
            ]
            told.append(f"{group} {'inside' if inside else 'outside'} {errors[0]:.2f} -> {errors[1]:.2f} mm")
    return f"Truths {setting}, cone of {CONE_DEG:g} -> {WIDE_DEG:g} degrees at as many orientations: {', '.join(told)}."
