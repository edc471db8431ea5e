"""Finite element spaces of the displacement: linear (P1) or quadratic (P2) Lagrange elements on straight tetrahedra."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from skfem import Basis, ElementTetP1, ElementTetP2, ElementVector, MeshTet

from brainshift_ros.errors import InputError
from brainshift_ros.mesh.tetmesh import TetMesh

ElementName = Literal["P1", "P2"]

_ELEMENTS = {"P1": ElementTetP1, "P2": ElementTetP2}

#: Ends of a triangle's mid-edge nodes, in the order in which they follow its corners.
_FACET_EDGES = np.array([[0, 1], [1, 2], [2, 0]])


@dataclass(frozen=True)
class Space:
    """Nodes of the displacement on a mesh: its vertices, followed by the middles of its edges if quadratic.

    Attributes
    ----------
    mesh
        N vertices, M elements.
    element
        ``P1`` or ``P2``.
    points
        Shape (n, 3), m; the first N are the vertices.
    elements
        Shape (M, 4) or (M, 10): nodes of each element, vertices first, mid-edges in scikit-fem's order.
    edges
        Shape (n - N, 2), the vertices at the ends of each mid-edge node.
    facets
        Named facets of shape (F, 3) or (F, 6): corners, then the mid-edges between corners 0-1, 1-2, 2-0.
    node_sets
        Named sets of nodes. A mid-edge belongs to a set with both its ends, so the set's elements belong to it whole.
    """

    mesh: TetMesh
    element: ElementName
    points: NDArray[np.float64]
    elements: NDArray[np.integer]
    edges: NDArray[np.integer]
    facets: Mapping[str, NDArray[np.integer]]
    node_sets: Mapping[str, NDArray[np.integer]]

    def __len__(self) -> int:
        return len(self.points)

    @property
    def order(self) -> int:
        """Polynomial degree, 1 or 2."""
        return int(self.element[1])

    @property
    def vertex_count(self) -> int:
        """Number of vertices N, the nodes of a linear pressure."""
        return len(self.mesh.nodes)

    @property
    def skfem_mesh(self) -> MeshTet:
        """The mesh for scikit-fem."""
        return skfem_mesh(self.mesh.nodes, self.mesh.elements)

    @property
    def scalar_basis(self) -> Basis:
        """Basis of one component, dof i at node i, with a quadrature that is exact for products of two gradients."""
        return Basis(self.skfem_mesh, _ELEMENTS[self.element](), intorder=self._intorder)

    @property
    def basis(self) -> Basis:
        """Vector basis, dof 3 i + c for component c at node i, with the quadrature of :attr:`scalar_basis`."""
        return Basis(self.skfem_mesh, ElementVector(_ELEMENTS[self.element]()), intorder=self._intorder)

    @property
    def _intorder(self) -> int:
        return max(1, 2 * (self.order - 1))

    def spread(self, vertices: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mask of nodes (n,) from a mask of vertices (N,): a mid-edge counts if both its ends do."""
        return np.concatenate([vertices, vertices[self.edges].all(axis=1)])


def skfem_mesh(nodes: NDArray[np.float64], elements: NDArray[np.integer]) -> MeshTet:
    """Nodes (N, 3) and elements (M, 4) as scikit-fem takes them."""
    return MeshTet(np.ascontiguousarray(nodes.T), np.ascontiguousarray(elements.T, dtype=np.int64))


def space_of(mesh: TetMesh, element: ElementName = "P1") -> Space:
    """Displacement space of a mesh.

    Parameters
    ----------
    mesh
        May be split along sheets: mid-edges are doubled with the vertices at their ends.
    element
        ``P1`` or ``P2``.

    Raises
    ------
    InputError
        The element is unknown.
    """
    if element not in _ELEMENTS:
        raise InputError("element", f"unknown element {element!r}", "choose P1 or P2")
    if element == "P1":
        no_edges = np.zeros((0, 2), dtype=mesh.elements.dtype)
        return Space(mesh, element, mesh.nodes, mesh.elements, no_edges, mesh.facets, mesh.node_sets)
    triangulation = skfem_mesh(mesh.nodes, mesh.elements)
    count, edges = len(mesh.nodes), triangulation.edges.T.astype(np.int64)
    points = np.concatenate([mesh.nodes, mesh.nodes[edges].mean(axis=1)])
    elements = np.concatenate([mesh.elements, count + triangulation.t2e.T], axis=1)
    middles = _EdgeLookup(edges, count)
    facets = {
        name: np.concatenate([corners, middles.of(corners[:, _FACET_EDGES])], axis=1) for name, corners in mesh.facets.items()
    }
    node_sets = {}
    for name, ids in mesh.node_sets.items():
        inside = np.zeros(count, dtype=bool)
        inside[ids] = True
        node_sets[name] = np.concatenate([ids, count + np.flatnonzero(inside[edges].all(axis=1))])
    return Space(mesh, element, points, elements, edges, facets, node_sets)


class _EdgeLookup:
    """Mid-edge node between two vertices."""

    def __init__(self, edges: NDArray[np.int64], vertex_count: int) -> None:
        self._count = vertex_count
        keys = self._keys(edges)
        self._order = np.argsort(keys)
        self._sorted = keys[self._order]

    def of(self, pairs: NDArray[np.integer]) -> NDArray[np.int64]:
        """Nodes (...) between pairs of vertices (..., 2) that an edge joins."""
        return self._count + self._order[np.searchsorted(self._sorted, self._keys(pairs))]

    def _keys(self, pairs: NDArray[np.integer]) -> NDArray[np.int64]:
        return pairs.min(axis=-1).astype(np.int64) * self._count + pairs.max(axis=-1)
