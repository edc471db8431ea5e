"""What a gap between dural septa and skull does to the displacement field (the prototype left 3 to 4 mm).

The gap is made on one mesh, by joining the doubled nodes near the skull again, so that nothing else differs. What another
mesh of the same brain changes, and what leaving the septa out changes, are shown beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.h5 import digest
from brainshift_ros.mechanics.forward import solve_gravity
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mesh.build import build_patient
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.mesh.patient import ImageReference, PatientModel
from brainshift_ros.mesh.septa_gap import gap_figures
from brainshift_ros.mesh.septa_join import with_gap
from brainshift_ros.mesh.template_patient import template_patient_images
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.septa.sheets import Septum, septa_spacing_mm
from brainshift_ros.septa.template import septa_from_template
from brainshift_ros.simulation.targets import target_groups
from brainshift_ros.units import m_to_mm, mm_to_m

Progress = Callable[[str, float], None]

GAPS_MM = (2.0, 4.0, 8.0)

#: A left frontal craniotomy; the patient lies on the back, or on the right side, where the falx carries the upper hemisphere.
CENTER_MM, RADIUS_MM = (-35.0, 45.0, 50.0), 35.0
ORIENTATIONS: Mapping[str, tuple[float, float, float]] = {"supine": (0.0, -0.94, -0.34), "lateral": (0.94, -0.34, 0.0)}
FLUID_LEVEL = 0.5

#: Nodes of one mesh's surface lie beside another mesh by up to this, metres.
_BESIDE_M = 0.01


@dataclass(frozen=True)
class Difference:
    """How far a field differs from that of the closed septa in one group of nodes, mm."""

    orientation: str
    variant: str
    group: str
    nodes: int
    field_mean_mm: float
    difference_mean_mm: float
    difference_p95_mm: float
    difference_max_mm: float


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Solve gravity with septa that reach the skull, and with gaps of 2, 4 and 8 mm; compare by target groups.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv and septa_gap.png.
    full
        20,000 nodes rather than 6,000.
    progress
        Called with stage and fraction done.

    Returns
    -------
    dict
        What summary.json holds.
    """
    nodes = 20_000 if full else 6_000
    septa = septa_from_template(lambda points: points, septa_spacing_mm(nodes))
    closed, other = (_patient(nodes, seed, septa, progress) for seed in (0, 1))
    gaps, rows = compare(closed, other, septa, progress)
    summary = {
        "nodes": len(closed.mesh.nodes),
        "fluid_level": FLUID_LEVEL,
        "gaps": gaps,
        "differences": [asdict(row) for row in rows],
    }
    write_results(folder, summary, [asdict(row) for row in rows])
    write_figure(folder / "septa_gap.png", _figure(rows, gaps))
    return summary


def compare(
    closed: PatientModel, other: PatientModel, septa: Sequence[Septum], progress: Progress
) -> tuple[dict[str, dict[str, float]], list[Difference]]:
    """Solve all variants and compare them with the closed septa.

    Parameters
    ----------
    closed, other
        Two meshes of one brain, both split along `septa`.
    septa
        The sheets.
    progress
        Called with stage and fraction done.

    Returns
    -------
    gaps : dict
        :func:`~brainshift_ros.mesh.septa_gap.gap_figures` of each variant of the mesh.
    differences : list of Difference
        A row for each orientation, variant and target group.
    """
    # On a septum another mesh's displacement could be read from the wrong side.
    on_septa = np.unique(np.vstack([closed.mesh.facets["falx"], closed.mesh.facets["tentorium"]]))
    groups = {
        name: np.setdiff1d(ids, on_septa)
        for name, ids in target_groups(closed.mesh, mm_to_m(CENTER_MM), float(mm_to_m(RADIUS_MM))).items()
    }
    meshes = {f"gap {gap_mm:g} mm": with_gap(closed.mesh, float(mm_to_m(gap_mm))) for gap_mm in GAPS_MM}
    gaps = {"closed": gap_figures(closed.mesh, septa)}
    gaps |= {variant: gap_figures(mesh, septa) for variant, (mesh, _) in meshes.items()}
    located = PointLocator(other.mesh).locate(closed.mesh.nodes, max_outside_m=_BESIDE_M)
    rows: list[Difference] = []
    for number, (orientation, direction) in enumerate(ORIENTATIONS.items()):
        progress("fields", number / len(ORIENTATIONS))
        reference = _field(closed, closed.mesh, direction)
        variants = {variant: _field(closed, mesh, direction)[node_of] for variant, (mesh, node_of) in meshes.items()}
        variants["another mesh"] = located.interpolate(other.mesh, _field(other, other.mesh, direction))
        variants["no septa"] = _field(closed, closed.mesh, direction, septa=False)
        rows += [
            _difference(orientation, variant, group, reference[ids], field[ids])
            for variant, field in variants.items()
            for group, ids in groups.items()
        ]
    progress("fields", 1.0)
    return gaps, rows


def _patient(nodes: int, seed: int, septa: tuple[Septum, ...], progress: Progress) -> PatientModel:
    images = template_patient_images()
    image = ImageReference("template.nii.gz", digest(images.t1.data), images.t1.shape, images.t1.T_patient_voxel)
    return build_patient(
        images.t1,
        images.labels,
        septa,
        image_ref=image,
        nodes=nodes,
        seed=seed,
        progress=lambda stage, fraction: progress(f"{stage} {seed + 1}", fraction),
    )


def _field(
    patient: PatientModel, mesh: TetMesh, direction: tuple[float, float, float], septa: bool = True
) -> NDArray[np.float64]:
    return solve_gravity(mesh, material_of(patient.tissue), direction, FLUID_LEVEL, septa=septa).displacement


def _difference(
    orientation: str, variant: str, group: str, reference: NDArray[np.float64], field: NDArray[np.float64]
) -> Difference:
    apart_mm = m_to_mm(np.linalg.norm(field - reference, axis=1))
    mean, highest = float(apart_mm.mean()), float(apart_mm.max())
    field_mm = float(m_to_mm(np.linalg.norm(reference, axis=1)).mean())
    return Difference(orientation, variant, group, len(apart_mm), field_mm, mean, float(np.percentile(apart_mm, 95.0)), highest)


def _figure(rows: list[Difference], gaps: Mapping[str, Mapping[str, float]]) -> Figure:
    variants = list(dict.fromkeys(row.variant for row in rows))
    colors = dict(zip(variants, ("#9ecae1", "#4292c6", "#084594", "#969696", "#d95f02"), strict=True))
    figure = Figure(figsize=(13.0, 5.2), layout="constrained")
    for axes, orientation in zip(figure.subplots(1, len(ORIENTATIONS), sharey=True), ORIENTATIONS, strict=True):
        own = [row for row in rows if row.orientation == orientation]
        groups = list(dict.fromkeys(row.group for row in own))
        means = {row.group: row.field_mean_mm for row in own}
        for k, variant in enumerate(variants):
            heights = [next(r.difference_mean_mm for r in own if (r.variant, r.group) == (variant, g)) for g in groups]
            label = variant
            if variant in gaps:
                label += f" (measured: {gaps[variant].get('falx_gap_mm_mean', 0.0):.1f} mm at the falx)"
            axes.bar(np.arange(len(groups)) + 0.16 * (k - 2), heights, 0.16, color=colors[variant], label=label)
        axes.set_xticks(range(len(groups)), [f"{g.replace('_', ' ')}\n({means[g]:.1f} mm)" for g in groups], fontsize=8)
        axes.set_title(f"{orientation}, gravity along {ORIENTATIONS[orientation]}")
        axes.set_yscale("log")
        axes.grid(axis="y", alpha=0.3)
    first = figure.axes[0]
    first.set_ylabel("mean difference from septa that reach the skull, mm")
    first.legend(fontsize=8)
    figure.supxlabel("target group (mean displacement)", fontsize=9)
    return figure
