"""How many head orientations an atlas needs (thesis, figures 21, 22 and 28).

First as the thesis does it: each orientation of an atlas is taken out in turn, and its own solutions are the truth, exact and
on the same mesh. An orientation on the rim of the cone is then outside what is left, which is the extent's fault and not the
resolution's; those inside are told apart. Second: truths of another mesh and stiffness with noise, the same for every size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brainshift_ros.atlas.entry import AtlasEntry
from brainshift_ros.experiments.atlas_size_chart import chart
from brainshift_ros.experiments.atlas_studies import (
    AS_THESIS,
    INDEPENDENT,
    SAME_MM,
    Judge,
    at_orientation,
    column_truth,
    degrees_from_plan,
    p_text,
    signed_rank_p,
    values_of,
)
from brainshift_ros.experiments.inverse_cases import study_atlas, study_scene, subset
from brainshift_ros.experiments.inverse_truths import CONE_DEG, drawn_truth, solved_truths, truth_patients
from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.skull_cases import MemoryAtlas

Progress = Callable[[str, float], None]
Row = dict[str, Any]

#: Orientations of the thesis's atlases, one more where each is left out in turn; then larger ones, as in figure 22.
SIZES, LARGER = (5, 14, 21, 30, 43, 59), (90, 120)

#: Groups of figure 28.
GROUPS = ("surface", "subsurface")

#: An orientation within this fraction of the cone has others on all its sides.
_INNER = 0.7

LEFT_OUT, INDEPENDENT_TRUTHS = "left out in turn", "independent"


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Estimate truths with atlases of 5 to 59 orientations.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv and atlas_size.png, and keeps meshes, atlases and truths.
    full
        Every orientation left out, 32 independent truths, atlases up to 120 orientations, meshes of 5,000 and 10,000 nodes;
        else at most 5, 8, up to 59, 3,000 and 3,000.
    progress
        Called with stage and fraction done.

    Returns
    -------
    dict
        What summary.json holds; `thesis_holds_here` says whether figure 28 is met.
    """
    most, count, nodes, truth_nodes = (None, 32, 5_000, 10_000) if full else (5, 8, 3_000, 3_000)
    rows: list[Row] = []
    for size in SIZES:
        scene = study_scene(orientations=size + 1, skull=AS_THESIS.skull)
        atlas = study_atlas(folder, scene, progress, nodes=nodes)
        rows += left_out(atlas, most, progress)
    specs = [drawn_truth(seed) for seed in range(count)]
    truths = list(solved_truths(folder, truth_patients(folder, truth_nodes, progress), specs, progress))
    measured = [INDEPENDENT.measured(truth, np.random.default_rng([truth.spec.seed, 28])) for truth in truths]
    for size in (*SIZES, *LARGER) if full else SIZES:
        atlas = study_atlas(folder, study_scene(orientations=size), progress, nodes=nodes)
        judge = Judge(atlas.mesh)
        for truth, points in zip(truths, measured, strict=True):
            progress(f"independent truths, {size} orientations", truth.spec.seed / count)
            labels = _labels(INDEPENDENT_TRUTHS, size, truth.spec.seed, degrees_from_plan(truth.spec.direction))
            rows += [labels | row for row in judge.rows(atlas, truth, points, INDEPENDENT.options)]
        progress(f"independent truths, {size} orientations", 1.0)
    summary = summary_of(rows)
    write_results(folder, summary, rows)
    write_figure(folder / "atlas_size.png", chart(rows, summary["error_mm"]))
    return summary


def left_out(atlas: MemoryAtlas, most: int | None, progress: Progress) -> list[Row]:
    """Leave orientations out one by one; their middle level of gravity and of the drug, in both states, are the truths.

    Parameters
    ----------
    atlas
        Of gravity and mannitol in three levels.
    most
        No more orientations than this, spread over all of them; None takes all.
    progress
        Called with stage and fraction done.
    """
    directions = list(dict.fromkeys(entry.gravity_direction for entry in atlas.entries))
    chosen = directions if most is None or len(directions) <= most else [directions[i] for i in _spread(len(directions), most)]
    middle = np.array([is_middle(entry) for entry in atlas.entries])
    size, judge, rows = len(directions) - 1, Judge(atlas.mesh), []
    for number, direction in enumerate(chosen):
        progress(f"{size} orientations, each left out", number / len(chosen))
        own = at_orientation(atlas, direction)
        rest = subset(atlas, ~own)
        for column in np.flatnonzero(own & middle).tolist():
            truth = column_truth(atlas, column)
            labels = _labels(LEFT_OUT, size, column, degrees_from_plan(direction))
            measured = AS_THESIS.measured(truth, np.random.default_rng(column))
            rows += [labels | row for row in judge.rows(rest, truth, measured, AS_THESIS.options)]
    progress(f"{size} orientations, each left out", 1.0)
    return rows


def is_middle(entry: AtlasEntry) -> bool:
    """Tell whether an entry is of the middle one of three levels."""
    return entry.drug_level == 2 if entry.mechanism == "mannitol" else abs(entry.fluid_level - 0.6) < 1e-9


def _spread(count: int, most: int) -> list[int]:
    return np.unique(np.linspace(0, count - 1, most).round().astype(int)).tolist()


def _labels(kind: str, size: int, truth: int, angle_deg: float) -> Row:
    return {
        "truths": kind,
        "orientations": size,
        "truth": truth,
        "angle_deg": angle_deg,
        "inner": angle_deg <= _INNER * CONE_DEG,
    }


def summary_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Mean and standard deviation of the error, by kind of truth, group and size, and whether the thesis's finding holds."""
    kinds: dict[str, Row] = {
        LEFT_OUT: {"truths": LEFT_OUT},
        f"{LEFT_OUT}, inner ones": {"truths": LEFT_OUT, "inner": True},
        INDEPENDENT_TRUTHS: {"truths": INDEPENDENT_TRUTHS},
    }
    errors: dict[str, dict[str, dict[int, Row]]] = {}
    for kind, labels in kinds.items():
        errors[kind] = {}
        for group in dict.fromkeys(row["group"] for row in rows):
            sizes = sorted({row["orientations"] for row in rows if row["truths"] == labels["truths"]})
            by_size = {size: values_of(rows, "error_mm", group=group, orientations=size, **labels) for size in sizes}
            errors[kind][group] = {
                size: {"mean": float(values.mean()), "std": float(values.std()), "truths": len(values)}
                for size, values in by_size.items()
                if len(values)
            }
    return {
        "thesis_holds_here": " ".join(_verdict(kind, errors[kind]) for kind in kinds),
        "thirty_or_more": _thirty_or_more(rows),
        "same_mm": SAME_MM,
        "error_mm": errors,
    }


def _verdict(kind: str, errors: dict[str, dict[int, Row]]) -> str:
    """Say from which size on the error does not fall any more."""
    told, holds = [], True
    for group in GROUPS:
        means = {size: found["mean"] for size, found in errors[group].items()}
        first, last = min(means), max(means)
        settled = settled_from(means)
        holds &= settled <= 30
        told.append(f"{group} {means[first]:.2f} mm at {first}, {means[last]:.2f} mm at {last}, settled from {settled}")
    answer = "at its asymptote by 30 orientations, as in the thesis" if holds else "still falling after 30 orientations"
    return f"Truths {kind}: {answer} ({'; '.join(told)})."


def settled_from(means: dict[int, float]) -> int:
    """Find the smallest size from which on every mean is the largest atlas's, to within `SAME_MM`."""
    sizes = sorted(means)
    far = [size for size in sizes if abs(means[size] - means[sizes[-1]]) > SAME_MM]
    return sizes[sizes.index(far[-1]) + 1] if far else sizes[0]


def _thirty_or_more(rows: Sequence[Row]) -> str:
    """Say what more than 30 orientations bring to independent truths."""
    last = max(row["orientations"] for row in rows if row["truths"] == INDEPENDENT_TRUTHS)
    told = []
    for group in GROUPS:
        few, many = (
            values_of(rows, "error_mm", truths=INDEPENDENT_TRUTHS, group=group, orientations=size) for size in (30, last)
        )
        told.append(f"{group} {np.mean(many - few):+.3f} mm ({p_text(signed_rank_p(few, many))})")
    return f"{last} orientations instead of 30, mean change of the error over the same independent truths: {', '.join(told)}."
