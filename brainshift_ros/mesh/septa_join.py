"""Septa that end short of the skull, as earlier meshes had them: for asking what such a gap does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mesh.split import rim_nodes
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.surface.facets import components
from brainshift_ros.surface.queries import closest_points
from brainshift_ros.surface.surface import Surface


def with_gap(mesh: TetMesh, gap: float) -> tuple[TetMesh, NDArray[np.int64]]:
    """Join septa again near the skull, and the falx near the tentorium.

    A facet whose centre lies within `gap` of the skull, or of the tentorium for the falx, is no longer cut: its nodes on
    both sides become one. Everything else of the mesh stays, so two solutions differ by the gap alone.

    Parameters
    ----------
    mesh
        Split along the septa.
    gap
        Metres; 0 joins nothing.

    Returns
    -------
    mesh : TetMesh
    node_of : ndarray
        Shape (N of the given mesh,), the node of the new mesh at each given one.
    """
    skull = Surface(mesh.nodes, mesh.facets["skull"])
    kept: dict[str, NDArray[np.int32]] = {}
    pairs = [np.empty((0, 2), dtype=np.int64)]
    for name in ("falx", "tentorium"):
        below, above = np.split(mesh.facets[name], 2)
        centres = mesh.nodes[below].mean(axis=1)
        near = closest_points(skull, centres).distance < gap
        if name == "falx":
            near |= closest_points(Surface(mesh.nodes, mesh.facets["tentorium"]), centres).distance < gap
        # The two sides list the nodes of a facet in opposite orders.
        pairs.append(np.stack([below[near].ravel(), above[near][:, ::-1].ravel()], axis=1))
        kept[name] = np.vstack([below[~near], above[~near]])
    node_of = components(len(mesh.nodes), np.vstack(pairs)).astype(np.int64)
    first = np.unique(node_of, return_index=True)[1]
    facets = {name: node_of[triples].astype(np.int32) for name, triples in mesh.facets.items()}
    node_sets = {name: np.unique(node_of[ids]).astype(np.int32) for name, ids in mesh.node_sets.items()}
    for name, triples in kept.items():
        below, above = np.split(node_of[triples].astype(np.int32), 2)
        parted = np.any(below != above[:, ::-1], axis=1)  # a facet whose nodes have all been joined parts nothing
        facets[name] = np.vstack([below[parted], above[parted]])
        node_sets[f"{name}_rim"] = rim_nodes(below[parted], above[parted])
    joined = TetMesh(mesh.nodes[first], node_of[mesh.elements].astype(np.int32), mesh.region, facets, node_sets)
    return joined, node_of
