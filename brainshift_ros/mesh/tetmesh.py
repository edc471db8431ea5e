"""Tetrahedral mesh with named facets and node sets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class TetMesh:
    """Linear tetrahedra in the patient frame.

    Attributes
    ----------
    nodes
        Shape (N, 3), metres, patient frame. Both copies of a node split by a septum have the same coordinates.
    elements
        Shape (M, 4), node indices, positive volume: ``dot(cross(x1-x0, x2-x0), x3-x0) > 0``.
    region
        Shape (M,), :class:`brainshift_ros.image.volume.Region` of each element.
    facets
        Named facets, each of shape (F, 3), node indices, ordered so that the right-hand normal points out of the
        element that owns the facet: ``skull``, the outer boundary; ``falx`` and ``tentorium``, both sides of the split
        sheets; ``tumor``, the interface between tumour and brain, oriented out of the tumour.
    node_sets
        Named node sets, each of shape (n,): ``brainstem``; ``falx_rim`` and ``tentorium_rim``, the free inner edges of
        the sheets, where the two sides stay joined.
    """

    nodes: NDArray[np.float64]
    elements: NDArray[np.int32]
    region: NDArray[np.uint8]
    facets: Mapping[str, NDArray[np.int32]] = field(default_factory=dict)
    node_sets: Mapping[str, NDArray[np.int32]] = field(default_factory=dict)

    @property
    def volumes(self) -> NDArray[np.float64]:
        """Signed volume of each element, m^3."""
        return tetrahedron_volumes(self.nodes, self.elements)


def tetrahedron_volumes(nodes: NDArray[np.float64], elements: NDArray[np.integer]) -> NDArray[np.float64]:
    """Signed volume of elements of shape (M, 4), m^3."""
    x = nodes[elements]
    return np.linalg.det(x[:, 1:] - x[:, :1]) / 6.0
