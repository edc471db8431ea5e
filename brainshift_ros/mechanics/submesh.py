"""Meshes derived from the patient's: without the tumour, or with the septa joined again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.faces import ElementFaces
from brainshift_ros.mesh.tetmesh import TetMesh

SHEETS = ("falx", "tentorium")

#: Name of the facets of the wall that resection opens.
CAVITY = "cavity"


@dataclass(frozen=True)
class Submesh:
    """A mesh made from part of another.

    Attributes
    ----------
    mesh
        The derived mesh.
    node_of
        Shape (N of the parent,), the derived node at each parent node, -1 where none is left.
    parent_node
        Shape (N of the derived,), one parent node at each derived node.
    parent_element
        Shape (M of the derived,), the parent's element.
    """

    mesh: TetMesh
    node_of: NDArray[np.integer]
    parent_node: NDArray[np.integer]
    parent_element: NDArray[np.integer]


def whole(mesh: TetMesh) -> Submesh:
    """Take the mesh as it is."""
    nodes = np.arange(len(mesh.nodes))
    return Submesh(mesh, nodes, nodes, np.arange(len(mesh.elements)))


def remove_elements(mesh: TetMesh, removed: NDArray[np.bool_], faces: ElementFaces | None = None) -> Submesh:
    """Leave out elements with the nodes and named facets that only they carry; the walls that appear are the `cavity`.

    Parameters
    ----------
    mesh
        N nodes, M elements.
    removed
        Shape (M,).
    faces
        Those of the mesh, if they are known already.
    """
    faces = ElementFaces(mesh.elements) if faces is None else faces
    kept = np.flatnonzero(~removed)
    parent_node = np.flatnonzero(np.bincount(mesh.elements[kept].ravel(), minlength=len(mesh.nodes)))
    node_of = np.full(len(mesh.nodes), -1, dtype=np.int64)
    node_of[parent_node] = np.arange(len(parent_node))
    facets = {}
    for name, triples in mesh.facets.items():
        owners = faces.owners(triples)
        facets[name] = node_of[triples[(owners >= 0) & ~removed[owners]]].astype(np.int32)
    one, other = faces.shared.T
    wall = np.concatenate([one[~removed[one // 4] & removed[other // 4]], other[removed[one // 4] & ~removed[other // 4]]])
    if len(wall):
        facets[CAVITY] = node_of[faces.triples[wall]].astype(np.int32)
    sets = {name: node_of[ids][node_of[ids] >= 0].astype(np.int32) for name, ids in mesh.node_sets.items()}
    elements = node_of[mesh.elements[kept]].astype(np.int32)
    return Submesh(TetMesh(mesh.nodes[parent_node], elements, mesh.region[kept], facets, sets), node_of, parent_node, kept)


def join_septa(mesh: TetMesh) -> Submesh:
    """Merge the doubled nodes of the septa, so that tissue is continuous across them; the sheets and their rims vanish."""
    on_sheet = np.unique(np.concatenate([np.zeros(0, np.int32), *(mesh.facets[s].ravel() for s in SHEETS if s in mesh.facets)]))
    representative = np.arange(len(mesh.nodes))
    if len(on_sheet):
        _, first, inverse = np.unique(mesh.nodes[on_sheet], axis=0, return_index=True, return_inverse=True)
        representative[on_sheet] = on_sheet[first[inverse.ravel()]]
    parent_node, inverse_of = np.unique(representative, return_inverse=True)
    node_of = inverse_of.astype(np.int64)
    facets = {name: node_of[triples].astype(np.int32) for name, triples in mesh.facets.items() if name not in SHEETS}
    sets = {
        name: np.unique(node_of[ids]).astype(np.int32)
        for name, ids in mesh.node_sets.items()
        if name not in {f"{sheet}_rim" for sheet in SHEETS}
    }
    joined = TetMesh(mesh.nodes[parent_node], node_of[mesh.elements].astype(np.int32), mesh.region, facets, sets)
    return Submesh(joined, node_of, parent_node, np.arange(len(mesh.elements)))


def compose(first: Submesh, second: Submesh) -> Submesh:
    """`second`, which was derived from `first.mesh`, as derived from the parent of `first`."""
    node_of = np.where(first.node_of >= 0, second.node_of[first.node_of], -1)
    return Submesh(second.mesh, node_of, first.parent_node[second.parent_node], first.parent_element[second.parent_element])


def unsupported_elements(mesh: TetMesh, removed: NDArray[np.bool_], faces: ElementFaces | None = None) -> NDArray[np.bool_]:
    """Mask of kept elements that share no face, directly or through others, with an element on the fixed brainstem.

    Their rigid motion would be undetermined (an edge is a hinge, a node a ball joint). Arguments as in
    :func:`remove_elements`.

    Raises
    ------
    InputError
        The brainstem set is missing or empty: nothing holds the brain.
    """
    brainstem = mesh.node_sets.get("brainstem", np.zeros(0, dtype=np.int32))
    if len(brainstem) == 0:
        raise InputError("mesh", "its brainstem node set is empty, so nothing holds the brain", "give a brainstem label")
    faces = ElementFaces(mesh.elements) if faces is None else faces
    count = len(mesh.elements)
    neighbours = faces.shared // 4
    neighbours = neighbours[~removed[neighbours].any(axis=1)]
    graph = sp.coo_matrix((np.ones(len(neighbours), dtype=np.int8), neighbours.T), shape=(count, count))
    _, component = connected_components(graph, directed=False)
    is_fixed = np.zeros(len(mesh.nodes), dtype=bool)
    is_fixed[brainstem] = True
    fixed = ~removed & (is_fixed[mesh.elements].sum(axis=1) >= 3)
    held = np.zeros(count, dtype=bool)
    held[component[fixed]] = True
    return ~removed & ~held[component]
