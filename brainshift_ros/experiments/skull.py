"""A stress-free cap or one-sided skull contact: which linear atlas is closer to a finite-strain brain in a rigid skull.

Forward: the linear models under the truth's own load, on the truth's own quadratic mesh. Inverse: an atlas of each model on
another mesh, fitted to 20 noisy points in the craniotomy, judged by target groups. The truths' tissue may leave the skull above
the high cap of the thesis, or, physically, wherever the fluid has drained.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from numpy.typing import NDArray

from brainshift_ros.atlas.orientations import directions_in_cone
from brainshift_ros.experiments.patients import template_patient
from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.skull_cases import (
    FLUID_LEVEL,
    SKULLS,
    MemoryAtlas,
    TruthCase,
    Truths,
    build_memory_atlas,
)
from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.mechanics.boundary import CAP_LEVEL
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.simulation.contact_newton import NoEquilibriumError
from brainshift_ros.simulation.truth import direction_between
from brainshift_ros.units import m_to_mm, mm_to_m

Progress = Callable[[str, float], None]
Row = dict[str, Any]

#: Planned directions of gravity: on the back, head turned by 45 degrees so that the craniotomy is uppermost, half sitting.
ORIENTATIONS: Mapping[str, tuple[float, float, float]] = {
    "supine": (0.0, -0.94, -0.34),
    "turned": (0.66, -0.71, -0.25),
    "half sitting": (0.0, -0.64, -0.77),
}
CONE, ATLAS_ORIENTATIONS, ATLAS_LEVELS = np.radians(20.0), 20, (0.4, 0.6)

POINTS, NOISE_M, REPEATS = 20, float(mm_to_m(0.5)), 5

#: Groups that the verdict looks at: what the surgeon does not see.
SUBSURFACE = ("tumor_margin", "subsurface", "deep", "midline", "contralateral")

#: Estimates that differ by less are as good as each other: another draw of points changes more.
TIE = 1.1

_BESIDE_M = 0.01
_CAPS = {"high cap": CAP_LEVEL, "fluid": FLUID_LEVEL}
_COLORS = {
    "free, high cap": "#fdae6b",
    "free to the fluid": "#d94801",
    "contact, high cap": "#9ecae1",
    "contact to the fluid": "#2171b5",
    "mean of the points": "#bdbdbd",
}


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Compare four linear models of the skull with finite-strain truths.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv, skull_forward.png and skull_inverse.png, and keeps the meshes.
    full
        Three orientations, both caps of the truth, with and without resection, on 4,000 vertices, atlases on 10,000; else one
        truth on 2,000 vertices.
    progress
        Called with stage and fraction done.

    Returns
    -------
    dict
        What summary.json holds; its `verdict` says which model's estimates are closest below the surface.
    """
    truth_nodes, atlas_nodes = (4_000, 10_000) if full else (2_000, 3_000)
    truths = Truths(template_patient(folder, truth_nodes, 1, progress))
    inverse = _Inverse(template_patient(folder, atlas_nodes, 0, progress))
    planned = list(ORIENTATIONS.items()) if full else list(ORIENTATIONS.items())[:1]
    caps = _CAPS if full else {"fluid": FLUID_LEVEL}
    states = (False, True) if full else (False,)
    rows: list[Row] = []
    solved: list[Row] = []
    unsolved: list[Row] = []
    for number, (name, direction) in enumerate(planned):
        progress("truths and atlases", number / len(planned))
        atlases = inverse.atlases(direction)
        between = direction_between(directions_in_cone(direction, CONE, ATLAS_ORIENTATIONS), direction, CONE)
        true_direction = (float(between[0]), float(between[1]), float(between[2]))
        for cap, cap_level in caps.items():
            for resected in states:
                case = TruthCase(name, true_direction, cap_level, resected)
                labels = {"orientation": name, "truth's cap": cap, "resected": resected}
                try:
                    with Stopwatch() as watch:
                        truth = truths.solve(case)
                except NoEquilibriumError as error:
                    unsolved.append(labels | {"why": str(error)})
                    continue
                sag_mm = float(m_to_mm(np.linalg.norm(truth.displacement[truths.opening], axis=1).max()))
                solved.append(
                    labels
                    | {
                        "sag_mm": sag_mm,
                        "newton_iterations": len(truth.history),
                        "smallest_jacobian": truth.smallest_jacobian,
                        "closed": int((truth.contact_force > 0.0).sum()),
                        "one_sided": len(truth.gap),
                        "cpu_s": watch.cpu_s,
                    }
                )
                rows += _forward_rows(truths, case, truth.displacement, labels)
                rows += inverse.rows(truths, case, truth.displacement, labels, atlases)
                summary = _summary(rows, solved, inverse.build_cpu_s) | {"truths without equilibrium": unsolved}
                write_results(folder, summary, rows)
    progress("truths and atlases", 1.0)
    if not rows:
        raise NoEquilibriumError(f"no truth was solved: {unsolved}")
    for kind in ("forward", "inverse"):
        write_figure(folder / f"skull_{kind}.png", _figure([row for row in rows if row["kind"] == kind], kind))
    return summary


def _forward_rows(truths: Truths, case: TruthCase, truth: NDArray[np.float64], labels: Row) -> list[Row]:
    rows = []
    for name, skull in SKULLS.items():
        linear = truths.linear(case, skull)
        for group, ids in truths.groups(case).items():
            rows.append(_row("forward", labels, name, group, truth[ids], linear[ids]))
    return rows


def _row(kind: str, labels: Row, model: str, group: str, truth: NDArray[np.float64], other: NDArray[np.float64]) -> Row:
    shift = m_to_mm(np.linalg.norm(truth, axis=1))
    error = m_to_mm(np.linalg.norm(other - truth, axis=1))
    return labels | {
        "kind": kind,
        "model": model,
        "group": group,
        "targets": len(shift),
        "shift_mm_mean": float(shift.mean()),
        "error_mm_mean": float(error.mean()),
        "error_mm_p95": float(np.percentile(error, 95.0)),
        "error_mm_max": float(error.max()),
        "explained_percent": float(100.0 * (1.0 - error.mean() / shift.mean())),
    }


class _Inverse:
    """Estimates on the atlas's mesh."""

    def __init__(self, patient: PatientModel) -> None:
        self._mesh = patient.mesh
        material = material_of(patient.tissue)
        self._systems = {resected: assemble_system(patient.mesh, material, resected=resected) for resected in (False, True)}
        self._locator = PointLocator(patient.mesh)
        self.build_cpu_s: dict[str, list[float]] = {name: [] for name in SKULLS}

    def atlases(self, planned: Sequence[float]) -> dict[str, MemoryAtlas]:
        """Build an atlas of each model around a planned orientation."""
        atlases = {}
        for name, skull in SKULLS.items():
            atlases[name], watch = build_memory_atlas(self._systems, planned, CONE, ATLAS_ORIENTATIONS, ATLAS_LEVELS, skull)
            self.build_cpu_s[name].append(watch.cpu_s)
        return atlases

    def rows(
        self,
        truths: Truths,
        case: TruthCase,
        truth: NDArray[np.float64],
        labels: Row,
        atlases: Mapping[str, MemoryAtlas],
    ) -> list[Row]:
        """Errors by group of each model's estimate, over several draws of points and noise."""
        groups = truths.groups(case)
        located = {name: self._locator.locate(truths.mesh.nodes[ids], _BESIDE_M) for name, ids in groups.items()}
        draws = [truths.measured(case, truth, POINTS, NOISE_M, np.random.default_rng(seed)) for seed in range(REPEATS)]
        fields = {
            name: [estimate_shift(atlas, points, locator=self._locator).field.displacement for points in draws]
            for name, atlas in atlases.items()
        }
        rows = []
        for group, ids in groups.items():
            found = located[group].found
            target = np.tile(truth[ids][found], (REPEATS, 1))
            for name, estimates in fields.items():
                at_targets = [located[group].interpolate(self._mesh, estimate)[found] for estimate in estimates]
                rows.append(_row("inverse", labels, name, group, target, np.concatenate(at_targets)))
            constant = np.repeat([points.displacements.mean(axis=0) for points in draws], found.sum(), axis=0)
            rows.append(_row("inverse", labels, "mean of the points", group, target, constant))
        return rows


def _mean_error(rows: Sequence[Row], kind: str, model: str, groups: Sequence[str]) -> float:
    own = [r["error_mm_mean"] for r in rows if (r["kind"], r["model"]) == (kind, model) and r["group"] in groups]
    return float(np.mean(own))


def _summary(rows: Sequence[Row], truths: Sequence[Row], build_cpu_s: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    names = list(SKULLS)
    errors = {
        kind: {
            name: {group: _mean_error(rows, kind, name, [group]) for group in dict.fromkeys(r["group"] for r in rows)}
            | {"below the surface": _mean_error(rows, kind, name, SUBSURFACE)}
            for name in (*names, *(["mean of the points"] if kind == "inverse" else []))
        }
        for kind in ("forward", "inverse")
    }
    cost = {name: float(np.mean(values)) for name, values in build_cpu_s.items()}
    return {
        "fluid_level": FLUID_LEVEL,
        "cap_level": CAP_LEVEL,
        "points": POINTS,
        "noise_mm": float(m_to_mm(NOISE_M)),
        "atlas_entries": 2 * ATLAS_ORIENTATIONS * len(ATLAS_LEVELS),
        "verdict": _verdict(errors),
        "error_mm_mean": errors,
        "build_cpu_s": cost,
        "truths": list(truths),
    }


def _verdict(errors: Mapping[str, Mapping[str, Mapping[str, float]]]) -> str:
    """Name the model whose estimates below the surface are closest; among those that tie, the one that is closest forward."""
    estimate = {name: errors["inverse"][name]["below the surface"] for name in SKULLS}
    forward = {name: errors["forward"][name]["below the surface"] for name in SKULLS}
    ties = [name for name in SKULLS if estimate[name] <= TIE * min(estimate.values())]
    order = sorted(SKULLS, key=lambda name: (name not in ties, forward[name] if name in ties else estimate[name]))
    told = [f"{name} {estimate[name]:.2f} mm after the inverse ({forward[name]:.2f} mm forward)" for name in order]
    return f"mean error below the surface, best first: {'; '.join(told)}"


def _figure(rows: Sequence[Row], kind: str) -> Figure:
    """Draw mean errors by group, a panel for each truth's cap and state of resection, averaged over orientations."""
    panels = list(dict.fromkeys((row["truth's cap"], row["resected"]) for row in rows))
    models = list(dict.fromkeys(row["model"] for row in rows))
    groups = list(dict.fromkeys(row["group"] for row in rows))
    figure = Figure(figsize=(1.0 + 6.0 * min(len(panels), 2), 0.6 + 3.8 * ((len(panels) + 1) // 2)), layout="constrained")
    grid = figure.subplots((len(panels) + 1) // 2, min(len(panels), 2), squeeze=False, sharey=True)
    for axes, (cap, resected) in zip(grid.ravel(), panels, strict=False):
        own = [row for row in rows if (row["truth's cap"], row["resected"]) == (cap, resected)]
        shift = [np.mean([row["shift_mm_mean"] for row in own if row["group"] == group]) for group in groups]
        width = 0.84 / len(models)
        for k, model in enumerate(models):
            heights = [
                np.mean([row["error_mm_mean"] for row in own if (row["model"], row["group"]) == (model, group)])
                for group in groups
            ]
            offset = width * (k - (len(models) - 1) / 2)
            axes.bar(np.arange(len(groups)) + offset, heights, 0.95 * width, color=_COLORS[model], label=model)
        labels = [f"{group.replace('_', ' ')}\n({mean:.1f} mm)" for group, mean in zip(groups, shift, strict=True)]
        axes.set_xticks(range(len(groups)), labels, fontsize=8)
        where = "above the high cap" if cap == "high cap" else "wherever fluid drained"
        axes.set_title(f"truth leaves the skull {where}{', tumour resected' if resected else ''}", fontsize=10)
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_yticks([0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0])
        axes.set_ylim(0.1, 12.0)
        axes.grid(axis="y", which="both", alpha=0.25)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=len(models), fontsize=8)
    figure.supylabel("mean difference from the finite-strain truth, mm", fontsize=9)
    what = "same load, same mesh" if kind == "forward" else f"after the inverse from {POINTS} points in the craniotomy"
    figure.suptitle(f"linear models of the skull, {what}; target group (its mean shift)", fontsize=10)
    return figure
