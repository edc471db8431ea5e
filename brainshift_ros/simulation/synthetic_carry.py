"""Carry the template's images to a patient's grid by a known map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.geometry import transform_points
from brainshift_ros.image.volume import Volume
from brainshift_ros.simulation.synthetic_noise import interpolation_matrix, tensor_product
from brainshift_ros.simulation.synthetic_warp import SyntheticWarp
from brainshift_ros.units import m_to_mm, mm_to_m

_FINE_MM = 1.5  # thick voxels are means over samples about this far apart
_NODE_MM = 4.0  # the map is computed at this spacing, cubic splines between


def carried(t1: Volume, labels: Volume, warp: SyntheticWarp, spacing_mm: float | Sequence[float]) -> tuple[Volume, Volume]:
    """Image the deformed template: the T1 as means over voxels, the labels as found at their middles.

    Parameters
    ----------
    t1, labels
        Of the template, on one axis-aligned grid, whose box the patient's images get.
    warp
        The map.
    spacing_mm
        Voxel edges of the patient's images along x, y, z.
    """
    grid, fine, block = _grids(t1, spacing_mm)
    index = _template_index(t1, fine, warp)
    bright = block_mean(ndimage.map_coordinates(t1.data, index, order=1), block)
    if fine.shape != grid.shape:
        index = _template_index(t1, grid, warp)
    region = ndimage.map_coordinates(labels.data, index, order=0)
    return Volume(bright, grid.T_patient_voxel), Volume(region, grid.T_patient_voxel)


def block_mean(data: NDArray[np.float32], block: Sequence[int]) -> NDArray[np.float32]:
    """Mean over blocks of voxels; axes must be multiples of the block."""
    (i, j, k), (a, b, c) = data.shape, block
    return data.reshape(i // a, a, j // b, b, k // c, c).mean(axis=(1, 3, 5), dtype=np.float32)


def _grids(template: Volume, spacing_mm: float | Sequence[float]) -> tuple[Volume, Volume, tuple[int, ...]]:
    """Make the image's grid over the template's box, and the finer one whose blocks are its voxels."""
    edges_mm = np.broadcast_to(np.asarray(spacing_mm, dtype=np.float64), 3)
    extent_mm = m_to_mm(np.diag(template.T_patient_voxel)[:3] * template.shape)
    block = np.maximum(np.rint(edges_mm / _FINE_MM), 1.0).astype(int)
    shape = np.floor(extent_mm / edges_mm).astype(int)

    def grid(shape: NDArray, edges_mm: NDArray, shift: NDArray) -> Volume:
        T_patient_voxel = np.diag([*mm_to_m(edges_mm), 1.0])
        T_patient_voxel[:3, 3] = template.T_patient_voxel[:3, 3] + mm_to_m(edges_mm * shift)
        return Volume(np.broadcast_to(np.uint8(0), tuple(shape)), T_patient_voxel)

    coarse = grid(shape, edges_mm, 0.5 * (block - 1.0) / block)
    return coarse, grid(shape * block, edges_mm / block, np.zeros(3)), tuple(block.tolist())


def _template_index(template: Volume, grid: Volume, warp: SyntheticWarp) -> NDArray[np.float32]:
    """Template voxel index, (3, I, J, K), that belongs at each voxel of the patient's grid: the true map, splines between."""
    edges_mm = m_to_mm(np.diag(grid.T_patient_voxel)[:3])
    sparse = [interpolation_matrix(n, _NODE_MM / edge) for n, edge in zip(grid.shape, edges_mm, strict=True)]
    at_nodes = np.stack(np.meshgrid(*(nodes for nodes, _ in sparse), indexing="ij"), axis=-1)
    template_points = warp.to_template(transform_points(grid.T_patient_voxel, at_nodes.reshape(-1, 3)))
    index = transform_points(np.linalg.inv(template.T_patient_voxel), template_points).reshape(at_nodes.shape)
    return np.stack([tensor_product([matrix for _, matrix in sparse], index[..., axis]) for axis in range(3)])
