"""Faces of tetrahedra, found by their nodes: who owns a facet, who shares a face."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.surface.facets import LOCAL_FACES

#: Node ids are packed three to a 64-bit key.
_BITS = 21


class ElementFaces:
    """Sorted table of the faces of elements (M, 4); it answers all questions about one mesh.

    Attributes
    ----------
    triples
        Shape (4M, 3), nodes of each face, normal pointing out of its element; face f belongs to element f // 4.
    """

    def __init__(self, elements: NDArray[np.integer]) -> None:
        self.triples = elements[:, LOCAL_FACES].reshape(-1, 3)
        keys = _keys(self.triples)
        self._order = np.argsort(keys)
        self._keys = keys[self._order]

    @cached_property
    def shared(self) -> NDArray[np.int64]:
        """Pairs of faces (P, 2) that lie on each other."""
        first = np.flatnonzero(self._keys[1:] == self._keys[:-1])
        return np.stack([self._order[first], self._order[first + 1]], axis=1)

    def owners(self, facets: NDArray[np.integer]) -> NDArray[np.int64]:
        """Element whose outward face each facet (F, 3) is, shape (F,); -1 where there is none.

        Orientation tells the two elements of an inner facet apart.
        """
        keys, owner = _keys(facets), np.full(len(facets), -1, dtype=np.int64)
        start = np.searchsorted(self._keys, keys)
        for position in (start, start + 1):
            inside = np.minimum(position, len(self._keys) - 1)
            face = self._order[inside]
            found = (position < len(self._keys)) & (self._keys[inside] == keys) & (_even(self.triples[face]) == _even(facets))
            owner[found] = face[found] // 4
        return owner


def _keys(triples: NDArray[np.integer]) -> NDArray[np.int64]:
    ordered = np.sort(triples, axis=1).astype(np.int64)
    return (ordered[:, 0] << 2 * _BITS) | (ordered[:, 1] << _BITS) | ordered[:, 2]


def _even(triples: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Whether each triple is an even permutation of its sorted self."""
    a, b, c = triples.T
    return ((a < b).astype(np.int8) + (b < c) + (c < a)) == 2
