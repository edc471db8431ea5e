"""The shift as a map of space: forward and inverse, inside the brain and around it.

Inside, the map is the mesh's own piecewise-linear field, so both directions are exact: the inverse is the displacement
drawn on the deformed mesh. Around the brain it is the field of :class:`Surroundings`, whose inverse is a fixed point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.field.coarse import sampled_coarsely
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.raster import draw, rasterise
from brainshift_ros.field.surroundings import Surroundings
from brainshift_ros.image.grid import Grid
from brainshift_ros.mesh.locate import PointLocator


class Deformation:
    """Forward and inverse displacement at any point of space.

    Parameters
    ----------
    field
        Forward displacement at the nodes.
    spacing
        Voxel edge, metres, of the grid that holds the surroundings.

    Attributes
    ----------
    deformed_nodes
        Shape (N, 3), metres: where the nodes are now.
    """

    def __init__(self, field: DisplacementField, spacing: float = 0.004) -> None:
        self.field = field
        self.spacing = spacing
        self.deformed_nodes = field.mesh.nodes + field.displacement

    @cached_property
    def surroundings(self) -> Surroundings:
        """The field around the brain."""
        return Surroundings(self.field, self.spacing)

    def forward_on(self, grid: Grid) -> NDArray[np.float32]:
        """Forward displacement u at voxel centres, shape (I, J, K, 3), metres: tissue at x is now at x + u(x)."""
        return self._on(grid, self.field.mesh.nodes, self.field.displacement, self.surroundings.forward)

    def inverse_on(self, grid: Grid) -> NDArray[np.float32]:
        """Inverse displacement v at voxel centres, shape (I, J, K, 3), metres: what is now at y was at y + v(y).

        This is what resampling needs: the updated image at y is the old image at y + v(y).
        """
        return self._on(grid, self.deformed_nodes, -self.field.displacement, self.surroundings.inverse)

    def forward_at(self, points: ArrayLike) -> NDArray[np.float64]:
        """Forward displacement at points, shape (n, 3) in and out, metres: exact inside the mesh."""
        return self._at(points, self.locator, self.field.displacement, self.surroundings.forward)

    def inverse_at(self, points: ArrayLike) -> NDArray[np.float64]:
        """Inverse displacement at points of the present, shape (n, 3) in and out, metres: exact inside the mesh."""
        return self._at(points, self._deformed_locator, -self.field.displacement, self.surroundings.inverse)

    def inside(self, grid: Grid) -> NDArray[np.bool_]:
        """Voxels of a grid whose centre lies in the brain before the shift."""
        return rasterise(self.field.mesh.nodes, self.field.mesh.elements, grid) >= 0

    def owner_now(self, grid: Grid) -> NDArray[np.int32]:
        """Element that holds each voxel centre after the shift, -1 outside the brain."""
        return rasterise(self.deformed_nodes, self.field.mesh.elements, grid)

    def std_on(self, grid: Grid) -> NDArray[np.float32]:
        """Return the std, metres, of the tissue that is now at voxel centres, shape (I, J, K); NaN outside the brain."""
        std = np.full((*grid.shape, 1), np.nan, dtype=np.float32)
        draw(self.deformed_nodes, self.field.mesh.elements, self.field.std[:, None], grid, std)
        return std[..., 0]

    def _on(self, grid: Grid, nodes: NDArray, nodal: NDArray, around: Callable[[NDArray], NDArray]) -> NDArray[np.float32]:
        result = np.ascontiguousarray(sampled_coarsely(around, grid, self.spacing))
        draw(nodes, self.field.mesh.elements, nodal, grid, result)
        return result

    @staticmethod
    def _at(
        points: ArrayLike, locator: PointLocator, nodal: NDArray, around: Callable[[NDArray], NDArray]
    ) -> NDArray[np.float64]:
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        located = locator.locate(points)
        displacement = located.interpolate(locator.mesh, nodal)
        displacement[~located.inside] = around(points[~located.inside])
        return displacement

    @cached_property
    def locator(self) -> PointLocator:
        """Finds points in the mesh before the shift."""
        return PointLocator(self.field.mesh)

    @cached_property
    def _deformed_locator(self) -> PointLocator:
        return PointLocator(replace(self.field.mesh, nodes=self.deformed_nodes))
