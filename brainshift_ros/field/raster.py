"""Draw a tetrahedral mesh into a voxel grid: which element holds each voxel centre, and nodal values there.

Each element is cut by the voxel lines along the last index axis; the four face planes bound an interval on each line, so
only voxels that lie inside are ever touched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.image.grid import Grid
from brainshift_ros.parallel import threaded

#: Voxel centres this far outside an element, in barycentric coordinates, still count: faces leave no gaps.
_TOLERANCE = 1e-7

_ELEMENTS_AT_ONCE = 4_000


def rasterise(nodes: NDArray[np.float64], elements: NDArray, grid: Grid) -> NDArray[np.int32]:
    """Element that holds each voxel centre.

    Parameters
    ----------
    nodes
        Shape (N, 3), metres; pass deformed positions to draw a deformed mesh.
    elements
        Shape (M, 4). Elements of no volume are left out.
    grid
        Any affine: oblique, mirrored, sheared.

    Returns
    -------
    Shape of the grid, -1 outside the mesh. On shared faces the higher element index wins.
    """
    owner = np.full(int(np.prod(grid.shape)), -1, dtype=np.int32)
    voxels = grid.to_voxels(nodes)

    def piece(first: int) -> tuple[NDArray, NDArray]:
        corners = voxels[elements[first : first + _ELEMENTS_AT_ONCE]]
        runs = _runs_inside(corners, *_barycentric_maps(corners), grid.shape)
        voxel, _ = runs.voxels()
        return voxel, np.repeat(first + runs.element, runs.length)

    for voxel, element in _in_order(piece, len(elements)):
        owner[voxel] = element
    return owner.reshape(grid.shape)


def draw(nodes: NDArray[np.float64], elements: NDArray, nodal: NDArray, grid: Grid, into: NDArray[np.float32]) -> None:
    """Overwrite the voxels inside the mesh with nodal values, interpolated linearly at their centres.

    Parameters
    ----------
    nodes, elements, grid
        As given to :func:`rasterise`; where that names an element, this interpolates in it.
    nodal
        Shape (N, C).
    into
        Shape (I, J, K, C), contiguous.
    """
    flat = into.reshape(-1, nodal.shape[1])
    voxels = grid.to_voxels(nodes)

    def piece(first: int) -> tuple[NDArray, NDArray]:
        part = elements[first : first + _ELEMENTS_AT_ONCE]
        barycentric = _barycentric_maps(voxels[part])
        runs = _runs_inside(voxels[part], *barycentric, grid.shape)
        constant, slope = _affine_maps(*barycentric, nodal[part])
        ijk = np.stack(np.unravel_index(runs.start, grid.shape), axis=1).astype(np.float64)
        at_start = constant[runs.element] + np.einsum("na,nac->nc", ijk, slope[runs.element])
        voxel, offset = runs.voxels()
        values = np.repeat(slope[runs.element, 2].astype(np.float32), runs.length, axis=0)
        values *= offset.astype(np.float32)[:, None]
        values += np.repeat(at_start.astype(np.float32), runs.length, axis=0)
        return voxel, values

    for voxel, values in _in_order(piece, len(elements)):
        flat[voxel] = values


def _in_order(piece: Callable[[int], tuple[NDArray, NDArray]], count: int) -> Iterator[tuple[NDArray, NDArray]]:
    return threaded(piece, range(0, count, _ELEMENTS_AT_ONCE))


@dataclass(frozen=True)
class _Runs:
    """Voxels in a row that one element holds: the element, the flat index of the first, and how many; each shape (r,)."""

    element: NDArray[np.int64]
    start: NDArray[np.int64]
    length: NDArray[np.int64]

    def voxels(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Flat index of each voxel, and its position in its run."""
        offset = _positions(self.length)
        return np.repeat(self.start, self.length) + offset, offset


def _runs_inside(corners: NDArray, constant: NDArray, slope: NDArray, shape: tuple[int, int, int]) -> _Runs:
    """Find the voxel centres inside elements with corners (m, 4, 3) in voxel units, and their barycentric maps."""
    limits = np.array(shape) - 1
    first = np.maximum(np.ceil(corners.min(axis=1) - 1e-6), 0).astype(np.int64)
    last = np.minimum(np.floor(corners.max(axis=1) + 1e-6), limits).astype(np.int64)
    count = np.maximum(last - first + 1, 0)
    usable = (count > 0).all(axis=1) & np.isfinite(slope).all(axis=(1, 2))
    lines = np.where(usable, count[:, 0] * count[:, 1], 0)
    element, step = np.repeat(np.arange(len(lines)), lines), _positions(lines)
    across = np.maximum(count[element, 1], 1)
    i, j = first[element, 0] + step // across, first[element, 1] + step % across
    low, high = (np.repeat(end[:, 2].astype(np.float64), lines) for end in (first, last))
    # A face that a line runs along is crossed far away, on the side that leaves or cuts the line as a whole.
    along = np.where(slope[..., 2] == 0.0, 1e-30, slope[..., 2])
    with np.errstate(invalid="ignore", over="ignore"):
        at_origin, per_i, per_j = -(constant + _TOLERANCE) / along, -slope[..., 0] / along, -slope[..., 1] / along
    for corner in range(4):  # repeating is several times as fast as taking by index
        crossing = np.repeat(per_i[:, corner], lines) * i
        crossing += np.repeat(per_j[:, corner], lines) * j
        crossing += np.repeat(at_origin[:, corner], lines)
        enters = np.repeat(along[:, corner] > 0.0, lines)
        np.maximum(low, crossing, out=low, where=enters)
        np.minimum(high, crossing, out=high, where=~enters)
    np.maximum(high, -1.0, out=high)  # faces far away are no integers
    np.minimum(low, high + 1.0, out=low)
    k = np.ceil(low).astype(np.int64)
    length = np.floor(high).astype(np.int64) - k + 1
    kept = np.flatnonzero(length > 0)
    return _Runs(element[kept], ((i * shape[1] + j) * shape[2] + k)[kept], length[kept])


def _barycentric_maps(corners: NDArray) -> tuple[NDArray, NDArray]:
    """Barycentric coordinates as affine functions of position: constants (M, 4) and slopes (M, 4, 3)."""
    edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    a, b, c = edges[:, 0], edges[:, 1], edges[:, 2]
    # Rows of edges are a, b, c; the inverse's columns are their cross products over the determinant.
    columns = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = columns / np.einsum("na,na->n", a, columns[:, :, 0])[:, None, None]
    slope = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    constant = -np.einsum("nab,nb->na", slope, corners[:, 0])
    constant[:, 0] += 1.0
    return constant, slope


def _affine_maps(constant: NDArray, slope: NDArray, values: NDArray) -> tuple[NDArray, NDArray]:
    """Values (M, 4, C) at the corners as affine functions of position, by barycentric maps: (M, C) and (M, 3, C)."""
    return np.einsum("na,nac->nc", constant, values), np.einsum("nab,nac->nbc", slope, values)


def _positions(length: NDArray[np.int64]) -> NDArray[np.int64]:
    """Position within its run of each member of runs of the given lengths."""
    end = np.cumsum(length)
    return np.arange(end[-1] if end.size else 0) - np.repeat(end - length, length)
