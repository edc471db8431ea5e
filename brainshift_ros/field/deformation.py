"""The shift as a map of space: forward and inverse, inside the brain and around it.

Inside, the map is the mesh's own piecewise-linear field, so both directions are exact: the inverse is the displacement
drawn on the deformed mesh. Around the brain the field continues its nearest value, smoothed, and fades to zero over a
reach so long that space never folds; there the inverse comes from a fixed-point iteration. Both live on a grid of the
deformation's own, so that they do not depend on the image they are applied to.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.field.raster import interpolate, rasterise
from brainshift_ros.image.grid import Grid, reached, trilinear
from brainshift_ros.mesh.locate import PointLocator

#: The field fades to zero over at least this distance from the brain, metres...
LEAST_REACH = 0.03

#: ...and over this multiple of the largest displacement. The fade's steepest slope is 1.5 / reach, hence its gradient at
#: most 1.5 / 4 = 0.375 of a fold.
REACH_PER_SHIFT = 4.0

#: The extension is smoothed over this many voxels of the deformation's grid (standard deviation).
_SMOOTHING = 3.0

_MAX_ITERATIONS = 40
_CONVERGED = 1e-6


@dataclass(frozen=True)
class InversionError:
    """How well forward after inverse gives identity, measured by interpolation on the deformation's grid; metres.

    Attributes
    ----------
    mean, p95, largest
        Over the brain and its surroundings. The largest values sit at the septa, where the field jumps.
    unconverged
        Number of grid points whose fixed-point iteration did not converge.
    """

    mean: float
    p95: float
    largest: float
    unconverged: int


@dataclass(frozen=True)
class Jacobian:
    """Volume change of the map: 1 keeps volume, 0 and below folds.

    Attributes
    ----------
    smallest_in_brain
        Smallest determinant over the mesh's elements.
    folded_elements
        Number of elements turned inside out.
    smallest_around
        Smallest determinant in the surroundings of the brain.
    """

    smallest_in_brain: float
    folded_elements: int
    smallest_around: float


class Deformation:
    """Forward and inverse displacement at any point of space.

    Parameters
    ----------
    field
        Forward displacement at the nodes.
    spacing
        Voxel edge of the deformation's own grid, metres.
    """

    def __init__(self, field: DisplacementField, spacing: float = 0.002) -> None:
        self.field = field
        mesh = field.mesh
        self.deformed_nodes = mesh.nodes + field.displacement
        largest = float(np.linalg.norm(field.displacement, axis=1).max(initial=0.0))
        self.reach = max(LEAST_REACH, REACH_PER_SHIFT * largest)
        self.grid = Grid.around(np.concatenate([mesh.nodes, self.deformed_nodes]), spacing, self.reach + 2 * spacing)

    def forward_on(self, grid: Grid) -> NDArray[np.float32]:
        """Forward displacement u at voxel centres, shape (I, J, K, 3), metres: tissue at x is now at x + u(x)."""
        return self._on(grid, self.field.mesh.nodes, self.field.displacement, self._forward)

    def inverse_on(self, grid: Grid) -> NDArray[np.float32]:
        """Inverse displacement v at voxel centres, shape (I, J, K, 3), metres: what is now at y was at y + v(y).

        This is what resampling needs: the updated image at y is the old image at y + v(y).
        """
        return self._on(grid, self.deformed_nodes, -self.field.displacement, self._inverse[0])

    def forward_at(self, points: ArrayLike, locator: PointLocator | None = None) -> NDArray[np.float64]:
        """Forward displacement at points, shape (n, 3) in and out, metres: of the mesh inside, of its extension outside."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        locator = locator or PointLocator(self.field.mesh)
        located = locator.locate(points)
        displacement = trilinear(self._forward, self.grid.to_voxels(points)).astype(np.float64)
        displacement[located.inside] = located.interpolate(self.field.mesh, self.field.displacement)[located.inside]
        return displacement

    def inside(self, grid: Grid) -> NDArray[np.bool_]:
        """Voxels of a grid whose centre lies in the brain before the shift."""
        return rasterise(self.field.mesh.nodes, self.field.mesh.elements, grid) >= 0

    @property
    def inversion_error(self) -> InversionError:
        """Error of forward after inverse."""
        return self._inverse[1]

    @cached_property
    def jacobian(self) -> Jacobian:
        """Determinants of the deformation gradient, of each element and around the brain."""
        mesh = self.field.mesh
        corners = self.deformed_nodes[mesh.elements]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0 / mesh.volumes
        return Jacobian(float(np.nanmin(ratio)), int(np.count_nonzero(ratio <= 0.0)), self._smallest_jacobian_around())

    def _on(self, grid: Grid, nodes: NDArray, nodal: NDArray, around: NDArray) -> NDArray[np.float32]:
        elements = self.field.mesh.elements
        owner = rasterise(nodes, elements, grid)
        result = interpolate(nodes, elements, nodal, grid, owner)
        T_own_grid = np.linalg.solve(self.grid.T_patient_voxel, grid.T_patient_voxel)
        moves = ndimage.binary_dilation(around.any(axis=-1), iterations=2)
        in_plane = np.indices(grid.shape[1:]).reshape(2, -1).T
        across = in_plane @ T_own_grid[:3, 1:3].T + T_own_grid[:3, 3]
        for i in range(grid.shape[0]):  # a plane at a time stays in the cache
            position = across + i * T_own_grid[:3, 0]
            near = np.flatnonzero((owner[i].reshape(-1) < 0) & reached(position, self.grid.shape, 0.0))
            near = near[moves[tuple(np.rint(position[near]).astype(np.intp).T)]]
            result[i].reshape(-1, 3)[near] = trilinear(around, position[near])
        return result

    @cached_property
    def _owner(self) -> NDArray[np.int32]:
        return rasterise(self.field.mesh.nodes, self.field.mesh.elements, self.grid)

    @cached_property
    def _forward(self) -> NDArray[np.float32]:
        """The forward field with its extension, on the deformation's grid."""
        inside = self._owner >= 0
        field = interpolate(self.field.mesh.nodes, self.field.mesh.elements, self.field.displacement, self.grid, self._owner)
        spacing = float(self.grid.voxel_edges[0])
        distance, nearest = ndimage.distance_transform_edt(~inside, return_indices=True)
        # Distance to the brain's surface rather than to the nearest voxel centre, which lies about half a voxel inside.
        s = np.clip((distance - 0.5) * spacing / self.reach, 0.0, 1.0).astype(np.float32)
        fade = 1.0 - s * s * (3.0 - 2.0 * s)
        # The nearest value meets the brain without a jump; farther out, where it jumps between the values of opposite
        # sides of a fissure, its smoothed version takes over.
        near = np.exp(-np.square((distance - 0.5) / _SMOOTHING)).astype(np.float32)
        for component in range(3):
            filled = field[..., component][tuple(nearest)]
            smooth = ndimage.gaussian_filter(filled, _SMOOTHING, truncate=3.0)
            field[..., component] = np.where(inside, filled, (near * filled + (1.0 - near) * smooth) * fade)
        return field

    @cached_property
    def _inverse(self) -> tuple[NDArray[np.float32], InversionError]:
        """The inverse field on the deformation's grid, with its error."""
        mesh, forward = self.field.mesh, self._forward
        owner = rasterise(self.deformed_nodes, mesh.elements, self.grid)
        inverse = interpolate(self.deformed_nodes, mesh.elements, -self.field.displacement, self.grid, owner)
        index = np.argwhere(owner < 0)
        answer, unconverged = _fixed_point(forward, index.astype(np.float64), self.grid)
        inverse[tuple(index.T)] = answer
        probe = np.argwhere(np.ones(tuple(-(-n // 2) for n in self.grid.shape), dtype=bool)) * 2
        at_probe = inverse[tuple(probe.T)].astype(np.float64)
        returned = trilinear(forward, probe + at_probe / self.grid.voxel_edges) + at_probe
        error = np.linalg.norm(returned, axis=1)[np.linalg.norm(at_probe, axis=1) > 0.0]
        if error.size == 0:
            return inverse, InversionError(0.0, 0.0, 0.0, unconverged)
        p95 = float(np.percentile(error, 95))
        return inverse, InversionError(float(error.mean()), p95, float(error.max()), unconverged)

    def _smallest_jacobian_around(self) -> float:
        outside = ~ndimage.binary_dilation(self._owner >= 0)
        if not outside.any():
            return 1.0
        spacing = float(self.grid.voxel_edges[0])
        gradient = np.stack([*np.gradient(self._forward, spacing, axis=(0, 1, 2))], axis=-1)  # (I, J, K, component, axis)
        F = gradient[outside] + np.eye(3, dtype=np.float32)
        return float(np.linalg.det(F).min())


def _fixed_point(forward: NDArray, voxels: NDArray[np.float64], grid: Grid) -> tuple[NDArray[np.float64], int]:
    """Iterate ``v <- -u(y + v)`` at voxels (n, 3) of an axis-parallel grid; also the number that did not converge."""
    edges = grid.voxel_edges
    v = -trilinear(forward, voxels).astype(np.float64)
    moving = np.flatnonzero(np.any(v != 0.0, axis=1))
    for _ in range(_MAX_ITERATIONS):
        if moving.size == 0:
            break
        update = -trilinear(forward, voxels[moving] + v[moving] / edges)
        change = np.linalg.norm(update - v[moving], axis=1)
        v[moving] = update
        moving = moving[change > _CONVERGED]
    return v, int(moving.size)
