"""Septa of one person from a file: landmarks, a semi-automatic sketch, or sheets as triangles (spec P5)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import igl
import meshio
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.files import atomic_path, existing_file, writable_target
from brainshift_ros.image.landmarks import SeptaLandmarks, read_septa_landmarks
from brainshift_ros.image.volume import Volume
from brainshift_ros.septa.frame import check_frame
from brainshift_ros.septa.sheets import Septum, SeptumName, septa_from_landmarks
from brainshift_ros.septa.sketch import septa_from_sketch
from brainshift_ros.septa.strip import with_strips
from brainshift_ros.surface.facets import compact
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import vertex_normals
from brainshift_ros.units import m_to_mm, mm_to_m

MESH_SUFFIXES = (".vtu", ".vtk")

#: Cell data that tells the sheets apart, and its values.
CELL_DATA = "septum"
SHEETS: tuple[tuple[int, SeptumName, str], ...] = (
    (1, "falx", "falx"),
    (2, "tentorium", "left tentorium"),
    (3, "tentorium", "right tentorium"),
)

#: Point data: 0, or a vertex's rank along its sheet's attached edge, counted from 1 at the torcula.
POINT_DATA = "attached"


def read_septa(path: str | Path, spacing_mm: float, brain: Volume | None = None) -> tuple[Septum, ...]:
    """Read falx, left and right tentorium.

    Parameters
    ----------
    path
        ``.vtu`` or ``.vtk``: triangles in mm, RAS, as :func:`write_septa` writes them. Any other name: YAML with ``septa``
        (full landmarks, see config/template_mni152.yaml) or ``septa_sketch`` (see config/septa_example.yaml).
    spacing_mm
        Distance between the vertices of sheets made from landmarks.
    brain
        Mask or labels of this patient, nonzero in the brain. If given, sheets made from landmarks are carried on past
        their attached edges, so that an edge drawn on the skull's inner side still ends outside the brain.

    Raises
    ------
    InputError
        The file is of neither kind, or its sheets cannot be those of an upright head in mm, RAS.
    """
    if Path(path).suffix.lower() in MESH_SUFFIXES:
        return _read_sheets(path)
    landmarks = read_septa_landmarks(path)
    try:
        if isinstance(landmarks, SeptaLandmarks):
            septa = septa_from_landmarks(landmarks, spacing_mm)
        else:
            septa = septa_from_sketch(landmarks, spacing_mm)
    except InputError as error:
        raise InputError(path, error.problem, error.remedy) from error
    check_frame(path, septa)
    return septa if brain is None else with_strips(septa, brain, spacing_mm)


def write_septa(path: str | Path, septa: Sequence[Septum]) -> None:
    """Write falx, left and right tentorium as triangles in mm, RAS, to be looked at or edited elsewhere (ParaView, Slicer).

    Cell data ``septum`` is 1 on the falx, 2 and 3 on left and right tentorium; vertices that sheets share are written once.

    Parameters
    ----------
    path
        ``.vtu`` or ``.vtk``.
    septa
        Falx, left and right tentorium, in this order.
    """
    path = writable_target(path, MESH_SUFFIXES)
    points = np.vstack([septum.surface.vertices for septum in septa])
    places, first, merged_id = np.unique(points.round(9), axis=0, return_index=True, return_inverse=True)
    offsets = np.cumsum([0, *(len(septum.surface.vertices) for septum in septa)])
    rank = np.zeros(len(places), dtype=np.int32)
    blocks, codes = [], []
    for septum, offset, (code, _, _) in zip(septa, offsets, SHEETS, strict=False):
        ids = merged_id.ravel()[offset:]
        blocks.append(ids[septum.surface.faces])
        codes.append(np.full(len(septum.surface.faces), code, dtype=np.int32))
        rank[ids[septum.attached]] = np.arange(1, len(septum.attached) + 1)
    mesh = meshio.Mesh(
        m_to_mm(points[first]),
        [("triangle", np.vstack(blocks))],
        point_data={POINT_DATA: rank},
        cell_data={CELL_DATA: [np.concatenate(codes)]},
    )
    with atomic_path(path) as temporary:
        meshio.write(temporary, mesh)


def _read_sheets(path: str | Path) -> tuple[Septum, ...]:
    path = existing_file(path, "sheet mesh (.vtu or .vtk)")
    try:
        mesh = meshio.read(path)
    # meshio's readers let whatever goes wrong inside them through
    except (Exception, SystemExit) as error:
        raise InputError(
            path, f"cannot be read as a mesh ({type(error).__name__})", "write it again as .vtu or .vtk"
        ) from error
    faces = mesh.get_cells_type("triangle")
    if len(faces) == 0 or CELL_DATA not in mesh.cell_data:
        problem = f"holds {len(faces)} triangles and cell data {sorted(mesh.cell_data)}"
        raise InputError(path, problem, f"give triangles with cell data `{CELL_DATA}` (1 falx, 2 left and 3 right tentorium)")
    codes = np.asarray(mesh.get_cell_data(CELL_DATA, "triangle")).ravel()
    if not np.isfinite(mesh.points).all():
        raise InputError(path, "holds points that are not finite", "write it again")
    points, rank = mm_to_m(mesh.points), np.asarray(mesh.point_data.get(POINT_DATA, np.zeros(len(mesh.points))))
    septa = []
    for code, name, title in SHEETS:
        if not np.any(codes == code):
            raise InputError(path, f"holds no triangles of the {title}", f"mark them by cell data `{CELL_DATA}` = {code}")
        septa.append(_septum(name, points, faces[codes == code], rank))
    check_frame(path, septa)
    return tuple(septa)


def _septum(name: SeptumName, points: NDArray[np.float64], faces: NDArray, rank: NDArray) -> Septum:
    used = np.unique(faces)
    vertices, faces = compact(points, faces)
    turned, _ = igl.bfs_orient(np.ascontiguousarray(faces, dtype=np.int64))
    surface = Surface(vertices, turned.astype(np.int32))
    axis = 0 if name == "falx" else 2
    if vertex_normals(surface.vertices, surface.faces)[:, axis].mean() < 0.0:
        surface = Surface(surface.vertices, surface.faces[:, ::-1])
    attached = np.flatnonzero(rank[used])
    attached = attached[np.argsort(rank[used][attached], kind="stable")]
    return Septum(name, surface, attached.astype(np.int32))
