"""Draw a tetrahedral mesh into a voxel grid: which element holds each voxel centre, and nodal values there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.image.grid import Grid

#: Voxel centres this far outside an element, in barycentric coordinates, still count: faces leave no gaps.
_TOLERANCE = 1e-7

_ELEMENTS_AT_ONCE = 8_000
_VOXELS_AT_ONCE = 200_000


def rasterise(nodes: NDArray[np.float64], elements: NDArray, grid: Grid) -> NDArray[np.int32]:
    """Element that holds each voxel centre.

    Each element is cut by the voxel lines along the last index axis; the four face planes bound an interval on each
    line, so only voxels that lie inside are ever touched.

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
    voxels = grid.to_voxels(nodes)
    owner = np.full(int(np.prod(grid.shape)), -1, dtype=np.int32)
    for first in range(0, len(elements), _ELEMENTS_AT_ONCE):
        part = elements[first : first + _ELEMENTS_AT_ONCE]
        element, flat = _voxels_inside(voxels[part], grid.shape)
        owner[flat] = first + element
    return owner.reshape(grid.shape)


def interpolate(
    nodes: NDArray[np.float64], elements: NDArray, nodal: NDArray, grid: Grid, owner: NDArray[np.int32]
) -> NDArray[np.float32]:
    """Nodal values at the voxel centres inside the mesh, by linear interpolation.

    Parameters
    ----------
    nodes, elements, grid
        As given to :func:`rasterise`.
    nodal
        Shape (N, C).
    owner
        The answer of :func:`rasterise`.

    Returns
    -------
    Shape (I, J, K, C), zero outside the mesh.
    """
    constant, slope = _affine_maps(grid.to_voxels(nodes)[elements], nodal[elements])
    result = np.zeros((owner.size, nodal.shape[1]), dtype=np.float32)
    flat = owner.reshape(-1)
    inside = np.flatnonzero(flat >= 0)
    for first in range(0, inside.size, _VOXELS_AT_ONCE):
        index = inside[first : first + _VOXELS_AT_ONCE]
        element = flat[index]
        voxel = np.stack(np.unravel_index(index, grid.shape), axis=1).astype(np.float64)
        result[index] = constant[element] + np.einsum("nc,ncd->nd", voxel, slope[element])
    return result.reshape(*grid.shape, nodal.shape[1])


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


def _affine_maps(corners: NDArray, values: NDArray) -> tuple[NDArray, NDArray]:
    """Interpolated values as affine functions of position: constants (M, C) and slopes (M, 3, C)."""
    constant, slope = _barycentric_maps(corners)
    return np.einsum("na,nac->nc", constant, values), np.einsum("nab,nac->nbc", slope, values)


def _voxels_inside(corners: NDArray, shape: tuple[int, int, int]) -> tuple[NDArray, NDArray]:
    """(element, flat voxel index) pairs of the voxel centres inside elements with corners (m, 4, 3) in voxel units."""
    limits = np.array(shape) - 1
    first = np.maximum(np.ceil(corners.min(axis=1) - 1e-6), 0).astype(np.int64)
    last = np.minimum(np.floor(corners.max(axis=1) + 1e-6), limits).astype(np.int64)
    count = np.maximum(last - first + 1, 0)
    constant, slope = _barycentric_maps(corners)
    usable = (count > 0).all(axis=1) & np.isfinite(slope).all(axis=(1, 2))
    lines = np.where(usable, count[:, 0] * count[:, 1], 0)
    element, step = _runs(lines)
    i = first[element, 0] + step // np.maximum(count[element, 1], 1)
    j = first[element, 1] + step % np.maximum(count[element, 1], 1)
    low, high = first[element, 2].astype(np.float64), last[element, 2].astype(np.float64)
    for corner in range(4):
        at_zero = constant[element, corner] + slope[element, corner, 0] * i + slope[element, corner, 1] * j + _TOLERANCE
        along = slope[element, corner, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -at_zero / along
        low = np.where(along > 0, np.maximum(low, crossing), low)
        high = np.where(along < 0, np.minimum(high, crossing), high)
        high = np.where((along == 0) & (at_zero < 0), -1.0, high)
    start = np.ceil(low).astype(np.int64)
    length = np.maximum(np.floor(high).astype(np.int64) - start + 1, 0)
    line, offset = _runs(length)
    k = start[line] + offset
    return element[line], (i[line] * shape[1] + j[line]) * shape[2] + k


def _runs(length: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Expand runs: owner index and position within the run, for runs of the given lengths."""
    owner = np.repeat(np.arange(length.size), length)
    return owner, np.arange(owner.size) - np.repeat(np.cumsum(length) - length, length)
