"""A scene's boundary conditions on the patient's surfaces, before anything is solved: as in the thesis, figures 5 and 31."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from brainshift_ros.atlas.columns import entries_of, fluid_levels
from brainshift_ros.atlas.problem import under_craniotomy
from brainshift_ros.atlas.scene import Scene
from brainshift_ros.mechanics.boundary import CAP_LEVEL, Boundary, NodeKind, boundary_of, in_cap, node_kinds
from brainshift_ros.mechanics.resection import solved_elements
from brainshift_ros.mechanics.space import space_of
from brainshift_ros.mechanics.submesh import CAVITY, Submesh
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.pictures.boundary import BoundaryCase, boundary_figure

#: Orientations drawn: the planned one and the two last, which lie on the cone's rim.
_DRAWN = (0, -2, -1)


def conditions_page(patient: PatientModel, scene: Scene) -> Figure:
    """Draw what the boundary may do in three head orientations, and where the pressure is atmospheric for each load.

    Parameters
    ----------
    patient
        The head, drawn with the tumour in place; the wall that its resection leaves is drawn by itself.
    scene
        Decides orientations, fluid levels, septa, resection and the model of the skull.
    """
    submesh, _ = solved_elements(patient.mesh, resected=False, septa=scene.septa)
    boundary = boundary_of(space_of(submesh.mesh))
    opening = under_craniotomy(patient.mesh, scene.craniotomy)
    every = list(dict.fromkeys(entry.gravity_direction for entry in entries_of(scene)))
    chosen = list(dict.fromkeys(every[number] for number in _DRAWN if -len(every) <= number < len(every)))
    mesh, wall = _with_wall(patient.mesh, scene)
    cases = []
    for direction in chosen:
        title = "gravity " + ", ".join(f"{component:+.2f}" for component in direction)
        cap = in_cap(patient.mesh.nodes, direction)
        kinds = _kinds(submesh, boundary, cap, opening if scene.model.skull == "contact" else None, scene.model.skull)
        kinds[wall & (kinds == NodeKind.INTERIOR)] = NodeKind.CAVITY
        cases.append(BoundaryCase(title, kinds, _drained(patient, scene, direction, _of_head(submesh, boundary.outer))))
    return boundary_figure(mesh, cases)


def _with_wall(mesh: TetMesh, scene: Scene) -> tuple[TetMesh, NDArray[np.bool_]]:
    """Add the wall of the resected tumour as facets `cavity`; also give the mask (N,) of its nodes."""
    on_wall = np.zeros(len(mesh.nodes), dtype=bool)
    if scene.resection == "none":
        return mesh, on_wall
    submesh, _ = solved_elements(mesh, resected=True, septa=scene.septa)
    facets = submesh.parent_node[submesh.mesh.facets[CAVITY]].astype(np.int32)
    on_wall[facets] = True
    return replace(mesh, facets={**mesh.facets, CAVITY: facets}), on_wall


def _kinds(
    submesh: Submesh, boundary: Boundary, cap: NDArray[np.bool_], opening: NDArray[np.bool_] | None, skull: str
) -> NDArray[np.uint8]:
    """Kinds (N,) of the head's nodes; with contact, only the opening is free, and the cap beside it is one-sided."""
    in_opening = np.zeros(len(cap), dtype=bool) if opening is None else opening
    free = cap if skull == "free_cap" else cap | in_opening
    kinds = node_kinds(boundary, free[submesh.parent_node])
    if skull == "contact":
        one_sided = (kinds == NodeKind.FREE) & ~in_opening[submesh.parent_node]
        kinds[one_sided] = NodeKind.CONTACT
    return _of_head(submesh, kinds)


def _drained(
    patient: PatientModel, scene: Scene, direction: tuple[float, float, float], outer: NDArray[np.bool_]
) -> dict[str, NDArray[np.bool_]]:
    """Nodes at atmospheric pressure for each load of the scene."""
    nodes = patient.mesh.nodes
    drained = {}
    if scene.gravity is not None:
        for level in fluid_levels(scene.gravity.fluid_levels):
            drained[f"gravity, fluid level {level:.2f}"] = outer & in_cap(nodes, direction, level)
    if scene.mannitol is not None or scene.swelling is not None:
        drained["mannitol or swelling"] = outer & in_cap(nodes, direction, CAP_LEVEL)
    return drained


def _of_head(submesh: Submesh, values: NDArray) -> NDArray:
    """Values of the derived mesh's nodes at the head's."""
    return np.where(submesh.node_of >= 0, values[submesh.node_of], 0).astype(values.dtype)
