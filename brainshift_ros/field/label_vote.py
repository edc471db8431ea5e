"""Labels between voxels: the label wins whose indicator, interpolated linearly, is largest.

As ITK's LabelImageGenericInterpolateImageFunction decides, but at a cost that does not grow with the number of labels: only
the eight voxels around a point have a vote.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.image.grid import Grid, reached
from brainshift_ros.image.volume import Volume
from brainshift_ros.parallel import threaded

_CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))


def vote(image: Volume, inverse: NDArray[np.float32], T_patient_voxel: NDArray[np.float64]) -> NDArray:
    """Labels at ``y + v(y)``, shape (I, J, K), for the voxels y of a grid; 0 more than half a voxel outside the image.

    Parameters
    ----------
    image
        Labels, of any type.
    inverse
        Shape (I, J, K, 3), v, metres.
    T_patient_voxel
        Affine of the grid on which v lies.
    """
    grid = Grid(inverse.shape[:3], T_patient_voxel)
    result = np.zeros(grid.shape, dtype=image.data.dtype)
    data = np.ascontiguousarray(image.data)
    T_image_patient = np.linalg.inv(image.T_patient_voxel)
    T_image_grid = T_image_patient @ T_patient_voxel
    in_plane = np.indices(grid.shape[1:]).reshape(2, -1).T
    across = in_plane @ T_image_grid[:3, 1:3].T + T_image_grid[:3, 3]

    def plane(i: int) -> None:
        source = across + i * T_image_grid[:3, 0] + inverse[i].reshape(-1, 3) @ T_image_patient[:3, :3].T
        inside = np.flatnonzero(reached(source, data.shape, 0.5))
        result[i].reshape(-1)[inside] = _winners(data, source[inside])

    for _ in threaded(plane, range(grid.shape[0])):
        pass
    return result


def _winners(data: NDArray, voxels: NDArray[np.float64]) -> NDArray:
    """Labels at continuous voxel indices, shape (n, 3); beyond the outermost voxel centres their label holds."""
    limit = np.array(data.shape) - 1
    low = np.floor(voxels).astype(np.int32)
    first, second = np.clip(low, 0, limit), np.clip(low + 1, 0, limit)
    per_voxel = np.array([data.shape[1] * data.shape[2], data.shape[2], 1])
    parts = [first * per_voxel, second * per_voxel]
    voters = np.stack([data.ravel()[sum(parts[c][:, axis] for axis, c in enumerate(corner))] for corner in _CORNERS], axis=1)
    winners = voters[:, 0].copy()
    mixed = np.flatnonzero((voters[:, 1:] != winners[:, None]).any(axis=1))
    share = voxels[mixed] - low[mixed]
    weight = np.prod(np.where(_CORNERS[None], share[:, None], 1.0 - share[:, None]), axis=2)
    voters = voters[mixed]
    support = np.stack([(weight * (voters == voters[:, corner, None])).sum(axis=1) for corner in range(8)], axis=1)
    winners[mixed] = voters[np.arange(mixed.size), support.argmax(axis=1)]
    return winners
