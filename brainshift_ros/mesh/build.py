"""From an MR with labels to a patient model (spec P3 to P6)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, rigid, transform_points
from brainshift_ros.image.labels import cropped, edge_warnings, labels_on_grid
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.mesh.fidelity import fidelity
from brainshift_ros.mesh.fit import fitted_nodes
from brainshift_ros.mesh.patient import ImageReference, PatientModel
from brainshift_ros.mesh.patient_file import patient_digest
from brainshift_ros.mesh.quality import dihedral_angles_deg, element_quality, faults, refuse_bad_mesh
from brainshift_ros.mesh.regions import regions_of
from brainshift_ros.mesh.septa_gap import gap_figures
from brainshift_ros.mesh.shapes import Shapes, shapes_of, surface_figures
from brainshift_ros.mesh.sizing import Craniotomy, effective_radius, size_field
from brainshift_ros.mesh.split import split_along_septa
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.mesh.tetwild import Tetrahedra, tetrahedralize
from brainshift_ros.mesh.tissue import classify_tissue
from brainshift_ros.septa.fit import check_septa
from brainshift_ros.septa.sheets import Septum
from brainshift_ros.surface.cortex import cortical_surface
from brainshift_ros.surface.facets import compact, components, face_table
from brainshift_ros.surface.queries import closest_points, inside
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm

Progress = Callable[[str, float], None]

NODES_RANGE = (2_000, 200_000)

#: Distance by which a meshed surface may miss the given one: in edge lengths, and in radii of the smallest tumour.
ENVELOPE, TUMOR_ENVELOPE = 0.15, 0.25

#: A tumour's meshed surface that lies this share of its radius off, on average, is worth a warning.
_COARSE = 0.15

#: How often to mesh, each time in another frame, before a mesh that fails the gate is refused: the mesher is random.
ATTEMPTS = 4


def build_patient(
    t1: Volume,
    labels: Volume,
    septa: Sequence[Septum] = (),
    *,
    image_ref: ImageReference,
    nodes: int = 20_000,
    seed: int = 0,
    craniotomy: tuple[ArrayLike, float] | None = None,
    tissue_threshold: float | None = None,
    progress: Progress | None = None,
) -> PatientModel:
    """Mesh the labelled brain, split it along the septa, classify tissue, and check the result.

    Every piece of tumour above :data:`~brainshift_ros.mesh.tumors.CRUMB_M3` is meshed. Where tumour grew through a
    septum it stays one solid body: the sheet ends at the tumour's surface.

    Parameters
    ----------
    t1
        The MR.
    labels
        Values of :class:`Region`, on any grid.
    septa
        Falx and tentorium; none leaves the mesh whole.
    image_ref
        The MR's identity, kept in the model.
    nodes
        About how many nodes the mesh shall have, 2,000 to 200,000.
    seed
        Turns the frame in which the mesher works: another seed gives another mesh of the same brain.
    craniotomy
        Centre, shape (3,), on or near the cortex, and radius, both in metres: the mesh is finer there.
    tissue_threshold
        Intensity of the MR above which an element is white matter; None finds it by Otsu's method.
    progress
        Called with stage and fraction done.

    Raises
    ------
    InputError
        Labels or septa that do not fit, a mesher that fails, or a mesh that does not pass the gate of :mod:`quality`.
    """
    if not NODES_RANGE[0] <= nodes <= NODES_RANGE[1]:
        raise InputError("nodes", f"is {nodes}", f"give {NODES_RANGE[0]} to {NODES_RANGE[1]}")
    report = progress or (lambda stage, fraction: None)
    report("surfaces", 0.0)
    labels = labels_on_grid(labels, t1)
    if not np.any(labels.data == Region.BRAINSTEM):
        problem = "hold no brainstem, which is what keeps the brain in place"
        raise InputError("labels", problem, f"label the brainstem ({int(Region.BRAINSTEM)})")
    cut = edge_warnings(labels)
    brain = labels.data > 0
    t1, labels = cropped(t1, brain, margin=3), cropped(labels, brain, margin=3)
    opening = None if craniotomy is None else Craniotomy(np.asarray(craniotomy[0], dtype=np.float64), float(craniotomy[1]))
    shapes, warnings = shapes_of(labels, tuple(septa), nodes, opening)
    if not septa:
        warnings += ("no dural septa: both hemispheres and the cerebellum move as one body",)
    warnings = (*cut, *warnings, *check_septa(septa, shapes.brain))
    if opening is not None:
        warnings += _check_opening(opening, shapes.brain)
    # The mesher works in a process of its own: on a second core these cost no time.
    with ThreadPoolExecutor(1) as beside:
        figures = beside.submit(surface_figures, shapes)
        cortex = beside.submit(cortical_surface, t1, shapes.labels)
        mesh, quality = _passing_mesh(shapes, nodes, seed, report)
        report("tissue", 0.0)
        tissue, tissue_warnings = classify_tissue(mesh, t1, tissue_threshold)
        report("cortex", 0.0)
        quality |= figures.result()
        surface = cortex.result()
    report("cortex", 1.0)
    warnings += _check_resolution(quality, shapes) + tissue_warnings
    patient_id = patient_digest(mesh, tissue, surface, image_ref)
    return PatientModel(mesh, tissue, surface, image_ref, quality, warnings, patient_id)


def _passing_mesh(shapes: Shapes, nodes: int, seed: int, report: Progress) -> tuple[TetMesh, dict[str, float]]:
    """Mesh until a mesh passes the gate, or refuse the last."""
    for attempt in range(ATTEMPTS):
        report("mesh", 0.0)
        made = tetrahedra_of(shapes, nodes, np.random.default_rng([seed, attempt]), report)
        report("septa", 0.0)
        mesh, piece = named_mesh(made.nodes, made.elements, shapes)
        quality = {**element_quality(mesh), **fidelity(mesh, piece, shapes), **gap_figures(mesh, shapes.septa), **_mesher(made)}
        if not faults(quality):
            break
    refuse_bad_mesh(quality)
    return mesh, quality


def named_mesh(points: NDArray[np.float64], elements: NDArray[np.int32], shapes: Shapes) -> tuple[TetMesh, NDArray[np.int32]]:
    """Name the parts of a mesh, split it along the septa, and fit it to its volumes.

    Returns
    -------
    mesh : TetMesh
    piece : ndarray
        Shape (M,), number of the tumour's piece from 1 that each element belongs to, else 0.
    """
    region, piece = regions_of(points, elements, shapes)
    split = split_along_septa(points, elements, shapes.septa, uncut=piece > 0)
    table = face_table(split.elements)
    sheets = np.vstack([np.empty((0, 3), dtype=np.int32), *split.facets.values()])
    facets = {"skull": table.boundary[~_among(table.boundary, sheets)], **split.facets}
    inner = piece[table.owners] > 0
    interface = inner[:, 0] != inner[:, 1]
    if interface.any():
        facets["tumor"] = np.where(inner[interface, :1], table.interior[interface], table.interior[interface, ::-1])
    node_sets = {f"{name}_rim": rim for name, rim in split.rims.items()}
    node_sets["brainstem"] = np.unique(split.elements[region == Region.BRAINSTEM]).astype(np.int32)
    mesh = TetMesh(split.nodes, split.elements, region, facets, node_sets)
    return replace(mesh, nodes=fitted_nodes(mesh, piece, shapes)), piece


def _check_opening(opening: Craniotomy, brain: Surface) -> tuple[str, ...]:
    distance = float(closest_points(brain, opening.center[None]).distance[0])
    if distance <= opening.radius:
        return ()
    return (
        f"the craniotomy's centre lies {float(m_to_mm(distance)):.0f} mm from the brain's surface, farther than its radius",
    )


def _check_resolution(quality: Mapping[str, float], shapes: Shapes) -> tuple[str, ...]:
    """Warn of a tumour whose volume is right but whose shape is lost: too thin or small for the mesh."""
    if "tumor_distance_mm_mean" not in quality:
        return ()
    off_mm = quality["tumor_distance_mm_mean"]
    smallest_mm = float(m_to_mm(min(effective_radius(tumor.surface) for tumor in shapes.tumors)))
    if off_mm <= _COARSE * smallest_mm:
        return ()
    return (
        f"the mesh follows the tumour's surface only to {off_mm:.1f} mm on average, for it is thin or small: use more nodes",
    )


def _mesher(made: Tetrahedra) -> dict[str, float]:
    """Processor time and memory of the mesher, and its smallest dihedral angle, before any repair."""
    angles = dihedral_angles_deg(made.nodes, made.elements)
    cpu_s, peak_mb = made.worker.cpu_s, made.worker.peak_bytes / 1e6
    return {"mesher_cpu_s": cpu_s, "mesher_peak_mb": peak_mb, "mesher_dihedral_min_deg": float(angles.min())}


def tetrahedra_of(shapes: Shapes, nodes: int, rng: np.random.Generator, report: Progress) -> Tetrahedra:
    """Mesh the brain alone, in one piece, in a randomly turned frame; `report` gets an estimate of what is done."""
    centre = shapes.brain.vertices.mean(axis=0)
    turn = Rotation.from_rotvec(0.2 * rng.normal(size=3))
    T_mesher_patient = rigid(turn, centre - turn.apply(centre))

    def turned(surface: Surface) -> Surface:
        return Surface(transform_points(T_mesher_patient, surface.vertices), surface.faces)

    brain, tumors = turned(shapes.meshed_brain), [turned(tumor) for tumor in shapes.meshed_tumors]
    opening = shapes.craniotomy
    if opening is not None:
        opening = Craniotomy(transform_points(T_mesher_patient, opening.center), opening.radius)
    expected_s = 5.0 + 0.004 * nodes
    made = tetrahedralize(
        [brain, *tumors, *(turned(septum.surface) for septum in shapes.septa)],
        size_field(brain, tumors, shapes.edge_length, opening),
        envelope=min([ENVELOPE * shapes.edge_length, *(TUMOR_ENVELOPE * effective_radius(tumor) for tumor in tumors)]),
        waiting=lambda waited: report("mesh", 1.0 - np.exp(-waited / expected_s)),
    )
    elements = made.elements[inside(brain, made.nodes[made.elements].mean(axis=1))]
    part = components(len(elements), face_table(elements).owners)
    points, elements = compact(made.nodes, elements[part == np.argmax(np.bincount(part))])
    return Tetrahedra(transform_points(invert_rigid(T_mesher_patient), points), elements, made.worker)


def _among(facets: NDArray[np.int32], others: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Which facets occur among others, in any order of nodes."""
    void = np.dtype((np.void, 12))
    keys = [np.ascontiguousarray(np.sort(f.astype(np.int32), axis=1)).view(void).ravel() for f in (facets, others)]
    return np.isin(keys[0], keys[1])
