"""From an MR with labels to a patient model (spec P3 to P6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, rigid, transform_points
from brainshift_ros.image.labels import cropped, labels_on_grid, largest_component, voxel_volume
from brainshift_ros.image.resample import sample
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.mesh.cortex import cortical_surface
from brainshift_ros.mesh.facets import compact, components, face_table, facet_areas
from brainshift_ros.mesh.patient import ImageReference, PatientModel
from brainshift_ros.mesh.patient_file import patient_digest
from brainshift_ros.mesh.quality import element_quality, faults, refuse_bad_mesh, relative_error_percent
from brainshift_ros.mesh.queries import inside
from brainshift_ros.mesh.septa_fit import check_septa
from brainshift_ros.mesh.sheets import Septum
from brainshift_ros.mesh.side import side_of_sheet
from brainshift_ros.mesh.sizing import edge_length_for, size_field
from brainshift_ros.mesh.split import sheet_surfaces, split_along_septa
from brainshift_ros.mesh.surface import Surface
from brainshift_ros.mesh.surfacing import decimate, face_areas, smooth_taubin, surface_of_mask
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.mesh.tetwild import tetrahedralize
from brainshift_ros.mesh.tissue import classify_tissue
from brainshift_ros.mesh.volume import restore_volume
from brainshift_ros.units import m3_to_ml, m_to_mm

Progress = Callable[[str, float], None]

NODES_RANGE = (2_000, 200_000)

#: Distance, in edge lengths, by which a meshed surface may miss the given one.
ENVELOPE = 0.2

#: Blur that takes the voxels' steps off a surface: less at the tumour, which is small and loses more of its shape.
SURFACE_BLUR_M, TUMOR_BLUR_M = 0.001, 0.0007

_HEALTHY = (Region.LEFT_CEREBRUM, Region.RIGHT_CEREBRUM, Region.CEREBELLUM, Region.BRAINSTEM)

#: Share of the brain, or of the tumour, that may lie apart from the rest without a word: crumbs of a drawn mask.
CRUMBS = 0.02

#: How often to mesh, each time in another frame, before a mesh that fails the gate is refused: the mesher is random.
ATTEMPTS = 3


@dataclass(frozen=True)
class _Shapes:
    """What the mesh must follow, and its edge length."""

    brain: Surface
    tumor: Surface | None
    septa: tuple[Septum, ...]
    edge_length: float


def build_patient(
    t1: Volume,
    labels: Volume,
    septa: Sequence[Septum] = (),
    *,
    image_ref: ImageReference,
    nodes: int = 20_000,
    seed: int = 0,
    progress: Progress | None = None,
) -> PatientModel:
    """Mesh the labelled brain, split it along the septa, classify tissue, and check the result.

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
    brain = labels.data > 0
    t1, labels = cropped(t1, brain, margin=3), cropped(labels, brain, margin=3)
    labels, warnings = _in_one_piece(labels)
    if not septa:
        warnings += ("no dural septa: both hemispheres and the cerebellum move as one body",)
    shapes = _shapes(labels, tuple(septa), nodes)
    warnings += check_septa(septa, shapes.brain)
    for attempt in range(ATTEMPTS):
        report("mesh", 0.0)
        points, elements = _tetrahedra(shapes, nodes, np.random.default_rng([seed, attempt]), report)
        report("septa", 0.0)
        mesh = _named_mesh(points, elements, shapes, labels)
        quality = {**element_quality(mesh), **_against_shapes(mesh, shapes, labels)}
        if not faults(quality):
            break
    refuse_bad_mesh(quality)
    report("tissue", 0.0)
    tissue = classify_tissue(mesh, t1)
    report("cortex", 0.0)
    cortex = cortical_surface(t1, labels)
    report("cortex", 1.0)
    return PatientModel(mesh, tissue, cortex, image_ref, quality, warnings, patient_digest(mesh, tissue, cortex, image_ref))


def brain_mask(labels: Volume) -> NDArray[np.bool_]:
    """Fill the labelled brain to one solid: largest part, no holes."""
    return ndimage.binary_fill_holes(largest_component(labels.data > 0))


def _in_one_piece(labels: Volume) -> tuple[Volume, tuple[str, ...]]:
    """Keep the largest piece of brain and of tumour, which the mesh follows; other tumour becomes what surrounds it."""
    data, warnings = labels.data, []
    brain, tumor = data > 0, data == Region.TUMOR
    for name, mask, fate in (("brain", brain, "left out"), ("tumour", tumor, "taken as healthy tissue")):
        apart = np.count_nonzero(mask & ~largest_component(mask))
        if apart > CRUMBS * np.count_nonzero(mask):
            millilitres = float(m3_to_ml(voxel_volume(labels) * apart))
            warnings.append(f"{millilitres:.2g} ml of {name} apart from its largest piece are {fate}")
    data = np.where(brain & ~largest_component(brain), np.uint8(Region.OUTSIDE), data)
    pieces = (data == Region.TUMOR) & ~largest_component(data == Region.TUMOR)
    if pieces.any():
        data = np.where(pieces, _filled(labels, _HEALTHY).data, data)
    return Volume(data, labels.T_patient_voxel), tuple(warnings)


def _shapes(labels: Volume, septa: tuple[Septum, ...], nodes: int) -> _Shapes:
    brain = smooth_taubin(surface_of_mask(brain_mask(labels), labels.T_patient_voxel, SURFACE_BLUR_M))
    tumor_mask = labels.data == Region.TUMOR
    tumor = None
    if tumor_mask.any():
        tumor = smooth_taubin(surface_of_mask(tumor_mask, labels.T_patient_voxel, TUMOR_BLUR_M))
    edge = edge_length_for(nodes, brain, tumor)
    return _Shapes(_with_edges(brain, 0.8 * edge), tumor and _with_edges(tumor, 0.5 * edge), septa, edge)


def _with_edges(surface: Surface, edge_length: float) -> Surface:
    """Decimate to about this edge length: the area of an equilateral triangle is sqrt(3) / 4 of its edge squared."""
    return decimate(surface, int(face_areas(surface).sum() / (0.433 * edge_length**2)))


def _tetrahedra(
    shapes: _Shapes, nodes: int, rng: np.random.Generator, report: Progress
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    centre = shapes.brain.vertices.mean(axis=0)
    turn = Rotation.from_rotvec(0.2 * rng.normal(size=3))
    T_mesher_patient = rigid(turn, centre - turn.apply(centre))

    def turned(surface: Surface) -> Surface:
        return Surface(transform_points(T_mesher_patient, surface.vertices), surface.faces)

    brain, tumor = turned(shapes.brain), shapes.tumor and turned(shapes.tumor)
    surfaces = [s for s in (brain, tumor, *(turned(septum.surface) for septum in shapes.septa)) if s is not None]
    expected_s = 5.0 + 0.004 * nodes
    points, elements = tetrahedralize(
        surfaces,
        size_field(brain, tumor, shapes.edge_length),
        envelope=ENVELOPE * shapes.edge_length,
        waiting=lambda waited: report("mesh", 1.0 - np.exp(-waited / expected_s)),
    )
    elements = elements[inside(brain, points[elements].mean(axis=1))]
    part = components(len(elements), face_table(elements).owners)
    points, elements = compact(points, elements[part == np.argmax(np.bincount(part))])
    return transform_points(invert_rigid(T_mesher_patient), points), elements


def _named_mesh(points: NDArray[np.float64], elements: NDArray[np.int32], shapes: _Shapes, labels: Volume) -> TetMesh:
    region = _regions(points[elements].mean(axis=1), shapes, labels)
    voxel, tumor = voxel_volume(labels), region == Region.TUMOR
    if tumor.any():
        points = restore_volume(points, elements, tumor, voxel * np.count_nonzero(labels.data == Region.TUMOR))
    points = restore_volume(points, elements, region > 0, voxel * np.count_nonzero(brain_mask(labels)))
    split = split_along_septa(points, elements, shapes.septa)
    table = face_table(split.elements)
    sheets = np.vstack([np.empty((0, 3), dtype=np.int32), *split.facets.values()])
    facets = {"skull": table.boundary[~_among(table.boundary, sheets)], **split.facets}
    inner = region[table.owners] == Region.TUMOR
    interface = inner[:, 0] != inner[:, 1]
    if interface.any():
        facets["tumor"] = np.where(inner[interface, :1], table.interior[interface], table.interior[interface, ::-1])
    node_sets = {f"{name}_rim": rim for name, rim in split.rims.items()}
    node_sets["brainstem"] = np.unique(split.elements[region == Region.BRAINSTEM]).astype(np.int32)
    return TetMesh(split.nodes, split.elements, region, facets, node_sets)


def _regions(centres: NDArray[np.float64], shapes: _Shapes, labels: Volume, near: float = 0.01) -> NDArray[np.uint8]:
    """Region of each element: the tumour by its meshed surface, sides of septa by the sheets, the rest by the labels."""
    healthy = sample(_filled(labels, _HEALTHY), centres, "nearest")
    cerebral = sample(_filled(labels, (Region.LEFT_CEREBRUM, Region.RIGHT_CEREBRUM)), centres, "nearest")
    sheets = sheet_surfaces(shapes.septa)
    if "tentorium" in sheets:
        side = side_of_sheet(sheets["tentorium"], centres)
        beside = (side.overshoot == 0.0) & (np.abs(side.height) < near) & (healthy != Region.BRAINSTEM)
        healthy[beside & (side.height < 0.0)] = Region.CEREBELLUM
        above = beside & (side.height >= 0.0)
        healthy[above] = cerebral[above]
    if "falx" in sheets:
        side = side_of_sheet(sheets["falx"], centres)
        beside = (side.overshoot == 0.0) & (np.abs(side.height) < near)
        beside &= (healthy == Region.LEFT_CEREBRUM) | (healthy == Region.RIGHT_CEREBRUM)
        healthy[beside] = np.where(side.height[beside] >= 0.0, Region.RIGHT_CEREBRUM, Region.LEFT_CEREBRUM)
    if shapes.tumor is not None:
        healthy[inside(shapes.tumor, centres)] = Region.TUMOR
    return healthy


def _filled(labels: Volume, regions: Sequence[Region]) -> Volume:
    """Labels of the given regions spread to all voxels, each taking the nearest."""
    known = np.isin(labels.data, regions)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return Volume(labels.data[tuple(nearest)], labels.T_patient_voxel)


def _among(facets: NDArray[np.int32], others: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Which facets occur among others, in any order of nodes."""
    void = np.dtype((np.void, 12))
    keys = [np.ascontiguousarray(np.sort(f.astype(np.int32), axis=1)).view(void).ravel() for f in (facets, others)]
    return np.isin(keys[0], keys[1])


def _against_shapes(mesh: TetMesh, shapes: _Shapes, labels: Volume) -> dict[str, float]:
    voxel, volumes = voxel_volume(labels), mesh.volumes
    brain_volume = voxel * np.count_nonzero(brain_mask(labels))
    figures = {
        "edge_target_mm": float(m_to_mm(shapes.edge_length)),
        "volume_error_percent": relative_error_percent(float(volumes.sum()), brain_volume),
    }
    if shapes.tumor is not None:
        tumor_volume = voxel * np.count_nonzero(labels.data == Region.TUMOR)
        figures["tumor_ml"] = float(m3_to_ml(tumor_volume))
        figures["tumor_volume_error_percent"] = relative_error_percent(
            float(volumes[mesh.region == Region.TUMOR].sum()), tumor_volume
        )
    for name, surface in sheet_surfaces(shapes.septa).items():
        centres = surface.vertices[surface.faces].mean(axis=1)
        expected = face_areas(surface)[inside(shapes.brain, centres)].sum()
        one_side = 0.5 * facet_areas(mesh.nodes, mesh.facets[name]).sum()
        figures[f"{name}_area_error_percent"] = relative_error_percent(one_side, float(expected))
    return figures
