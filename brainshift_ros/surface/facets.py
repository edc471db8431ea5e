"""Faces of tetrahedra: who owns them, who shares them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

#: Local faces of a positive tetrahedron, ordered so that the right-hand normal points outward; face i lacks vertex i.
LOCAL_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])


@dataclass(frozen=True)
class FaceTable:
    """Interior and boundary faces of a mesh.

    Attributes
    ----------
    interior
        Shape (F, 3), node indices, normal pointing out of the first owner.
    owners
        Shape (F, 2), the two elements that share each interior face.
    boundary
        Shape (B, 3), node indices, normal pointing outward.
    boundary_owner
        Shape (B,), the element of each boundary face.
    """

    interior: NDArray[np.int32]
    owners: NDArray[np.int64]
    boundary: NDArray[np.int32]
    boundary_owner: NDArray[np.int64]


def face_table(elements: NDArray[np.int32]) -> FaceTable:
    """Pair the faces of elements of shape (M, 4)."""
    faces = elements[:, LOCAL_FACES].reshape(-1, 3)
    owner = np.repeat(np.arange(len(elements)), 4)
    key = np.sort(faces, axis=1)
    order = np.lexsort(key.T[::-1])
    same = np.all(key[order[1:]] == key[order[:-1]], axis=1)
    first = np.flatnonzero(same)
    paired = np.zeros(len(faces), dtype=bool)
    paired[first] = paired[first + 1] = True
    alone = order[~paired]
    one, two = order[first], order[first + 1]
    return FaceTable(faces[one], np.stack([owner[one], owner[two]], axis=1), faces[alone], owner[alone])


def components(count: int, pairs: NDArray) -> NDArray[np.int32]:
    """Find the connected component of each of `count` items joined by pairs of shape (P, 2)."""
    graph = coo_array((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def facet_areas(nodes: NDArray[np.float64], facets: NDArray[np.int32]) -> NDArray[np.float64]:
    """Area of each facet, m^2."""
    a, b, c = np.moveaxis(nodes[facets], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def compact(nodes: NDArray[np.float64], elements: NDArray[np.int32]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Drop nodes that no element uses."""
    used, renumbered = np.unique(elements, return_inverse=True)
    return nodes[used], renumbered.reshape(elements.shape).astype(np.int32)
