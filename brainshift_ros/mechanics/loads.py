"""Gravity as a nodal load: the right side of (3.1), with buoyancy by fluid level (spec P8)."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from brainshift_ros.mechanics.clipping import integrals_above, whole_integrals
from brainshift_ros.mechanics.materials import FLUID_DENSITY
from brainshift_ros.mechanics.scatter import sum_at
from brainshift_ros.mechanics.space import Space

#: Cases whose elements are looked through at once.
_CHUNK = 16


class TissueWeight:
    """Mass that gravity acts on, spread over the nodes: that of the tissue less that of the fluid which carries it.

    Above the fluid level tissue weighs rho_t g, since the fluid that carried it drained away; below it (rho_t - rho_f) g.
    Elements that the level cuts are integrated exactly on both sides, so the load is continuous in the level and its sum
    is the weight of the exposed volume to round-off.

    Parameters
    ----------
    space
        Displacement space, n nodes, N of them vertices.
    volume, density
        Of each element, m^3 and kg/m^3, shape (M,).
    fluid_density
        kg/m^3.
    """

    def __init__(
        self,
        space: Space,
        volume: NDArray[np.float64],
        density: NDArray[np.float64],
        fluid_density: float = FLUID_DENSITY,
    ) -> None:
        self._space, self._volume, self._fluid_density = space, volume, fluid_density
        self._integrals = whole_integrals(volume, space.order)
        self._whole = self._at_nodes(np.ones(len(volume)))
        self._submerged = self._at_nodes(density - fluid_density)
        corners = space.mesh.elements
        starts = np.arange(0, corners.size + 1, 4)
        ones = np.ones(corners.size, dtype=np.float32)
        self._corners_of = sp.csr_matrix((ones, corners.ravel(), starts), shape=(len(corners), space.vertex_count))

    def masses(self, height: NDArray[np.float64]) -> NDArray[np.float64]:
        """Nodal masses, kg.

        Parameters
        ----------
        height
            Shape (N, k), height of each vertex over the fluid for k cases, m.

        Returns
        -------
        Shape (n, k).
        """
        masses = np.empty((len(self._space), height.shape[1]))
        for start in range(0, height.shape[1], _CHUNK):
            chunk = height[:, start : start + _CHUNK]
            masses[:, start : start + _CHUNK] = self._submerged[:, None] + self._fluid_density * self._exposed(chunk)
        return masses

    def _exposed(self, height: NDArray[np.float64]) -> NDArray[np.float64]:
        """Integral of each shape function over the tissue above the fluid, (n, k), m^3.

        Away from the level it is that over all tissue, or zero; only the elements that the level cuts are looked at.
        """
        space, count = self._space, height.shape[1]
        vertex_above = height > 0.0
        above = np.concatenate([vertex_above, vertex_above[space.edges].all(axis=1)])
        exposed = self._whole[:, None] * above
        corners_above = self._corners_of @ vertex_above.astype(np.float32)
        element, case = np.divmod(np.flatnonzero(np.abs(corners_above - 2.0) < 1.5), count)
        nodes = space.elements[element]
        exact = integrals_above(height[space.mesh.elements[element], case[:, None]], self._volume[element], space.order)
        excess = exact - self._integrals[element] * above[nodes, case[:, None]]
        slots = nodes * count + case[:, None]
        exposed += sum_at(slots, excess, exposed.size).reshape(exposed.shape)
        return exposed

    def _at_nodes(self, per_element: NDArray[np.float64]) -> NDArray[np.float64]:
        shares = per_element[:, None] * self._integrals
        return sum_at(self._space.elements, shares, len(self._space))
