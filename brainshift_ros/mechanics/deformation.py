"""How far a displacement field strains the tissue: det F of each element, the limit of linear theory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mesh.tetmesh import TetMesh

#: Elements and fields that are worked on at once: their edges fit into the processor's cache.
_ELEMENTS, _FIELDS = 256, 64


@dataclass(frozen=True)
class Jacobians:
    """Volume ratios of some displacement fields.

    Attributes
    ----------
    smallest
        Shape (k,), each field's smallest det F over the elements.
    inverted
        Shape (k,), the number of elements with det F <= 0, which the field turns inside out.
    """

    smallest: NDArray[np.float32]
    inverted: NDArray[np.int32]


class JacobianOfElements:
    """Evaluate det F = det(I + grad u) on linear elements.

    There F maps the element's edges to their deformed selves, so det F is the deformed volume over the volume. Linear
    elasticity knows no barrier at zero: where a field inverts elements it has left the range in which it means anything.

    Parameters
    ----------
    mesh
        Of the fields.
    elements
        Ids or mask of the elements that count; None takes all. Where tissue was resected a field is a mere continuation.
    """

    def __init__(self, mesh: TetMesh, elements: NDArray | None = None) -> None:
        self._corners = mesh.elements if elements is None else mesh.elements[elements]
        self._nodes = mesh.nodes.astype(np.float32)[:, :, None]
        x = mesh.nodes[self._corners]
        self._per_volume = (1.0 / np.linalg.det(x[:, 1:] - x[:, :1])).astype(np.float32)[:, None]

    def __call__(self, displacement: NDArray) -> Jacobians:
        """Smallest det F and inverted elements of each of k fields.

        Parameters
        ----------
        displacement
            Shape (N, 3, k), m. Single precision is used: with edges of millimetres it leaves det F four digits.
        """
        count = displacement.shape[2]
        smallest = np.full(count, np.inf, dtype=np.float32)
        inverted = np.zeros(count, dtype=np.int32)
        for first in range(0, count, _FIELDS):
            fields = slice(first, first + _FIELDS)
            # The fields of a node side by side, whatever the order they come in: nodes are picked below.
            y = np.add(self._nodes, displacement[:, :, fields], dtype=np.float32, casting="same_kind", order="C")
            for start in range(0, len(self._corners), _ELEMENTS):
                ratio = self._ratio(y, slice(start, start + _ELEMENTS))
                np.minimum(smallest[fields], ratio.min(axis=0), out=smallest[fields])
                if (smallest[fields] <= 0.0).any():
                    inverted[fields] += np.count_nonzero(ratio <= 0.0, axis=0).astype(np.int32)
        return Jacobians(smallest, inverted)

    def _ratio(self, y: NDArray[np.float32], chosen: slice) -> NDArray[np.float32]:
        """Deformed over undeformed volume of some elements, (elements, fields), from the deformed nodes."""
        corners = self._corners[chosen]
        origin = y[corners[:, 0]]
        a, b, c = (y[corners[:, i]] - origin for i in (1, 2, 3))
        triple = a[:, 0] * (b[:, 1] * c[:, 2] - b[:, 2] * c[:, 1])
        triple += a[:, 1] * (b[:, 2] * c[:, 0] - b[:, 0] * c[:, 2])
        triple += a[:, 2] * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
        return triple * self._per_volume[chosen]
