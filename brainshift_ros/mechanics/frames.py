"""Local frames of boundary nodes: normals of the surfaces they lie on, then tangents."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mechanics.scatter import sum_at

#: Surfaces that meet at less than this angle give a node one normal, not two: the second would be mostly mesh noise, and
#: constraining it would lock a tangent.
MIN_ANGLE_DEG = 30.0


class LocalFrames:
    """Orthonormal axes of n nodes, found surface by surface.

    Attributes
    ----------
    rank
        Shape (n,), how many axes of each node are normals so far.
    """

    def __init__(self, count: int) -> None:
        self._axes = np.zeros((count, 3, 3))
        self.rank = np.zeros(count, dtype=np.int64)

    def add(self, normals: NDArray[np.float64], present: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Take a surface's unit normals (n, 3), where they are present (n,), made orthogonal to those already there.

        Returns
        -------
        Nodes (n,) that got one: not those whose normal was, nearly, there before.
        """
        nodes = np.flatnonzero(present & (self.rank < 3))
        axes = self._axes[nodes]
        residual = normals[nodes] - np.einsum("nak,nai,ni->nk", axes, axes, normals[nodes])
        length = np.linalg.norm(residual, axis=1)
        new = length > np.sin(np.radians(MIN_ANGLE_DEG))
        chosen = nodes[new]
        self._axes[chosen, self.rank[chosen]] = residual[new] / length[new, None]
        self.rank[chosen] += 1
        added = np.zeros(len(self.rank), dtype=bool)
        added[chosen] = True
        return added

    def completed(self) -> NDArray[np.float64]:
        """Frames (n, 3, 3), rows are axes: unused ones are filled with the coordinate axes that stand out most.

        Identity at nodes without normals.
        """
        frames = self._axes.copy()
        frames[self.rank == 0] = np.eye(3)
        for axis in (1, 2):
            open_ = np.flatnonzero((self.rank > 0) & (self.rank <= axis))
            used = frames[open_]
            candidates = np.eye(3) - np.einsum("nai,naj->nij", used, used)
            length = np.linalg.norm(candidates, axis=2)
            # A bias towards the axis of the same index keeps axis-aligned frames in order.
            best = np.argmax(length + 1e-9 * np.eye(3)[axis], axis=1)
            pick = np.arange(len(open_))
            frames[open_, axis] = candidates[pick, best] / length[pick, best, None]
        return frames


def nodal_normals(nodes: NDArray[np.float64], facets: NDArray[np.integer]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Area-weighted unit normal at each node of a surface, and which nodes lie on it.

    Where both sides of a sheet share a node, on its rim, their normals cancel; there the axis that is normal to both is
    taken instead: the principal axis of the sum of A n n^T, which has no sign.

    Parameters
    ----------
    nodes
        Shape (n, 3).
    facets
        Shape (F, 3) or (F, 6): corners, then mid-edges.

    Returns
    -------
    Normals (n, 3), zero off the surface, and a mask (n,).
    """
    corners = nodes[facets[:, :3]]
    area_normal = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(area_normal, axis=1)
    total = _at_nodes(facets, area_normal, len(nodes))
    total_area = _at_nodes(facets, area[:, None], len(nodes))[:, 0]
    present = total_area > 0.0
    length = np.linalg.norm(total, axis=1)
    normals = np.where(length[:, None] > 0.0, total / np.where(length > 0.0, length, 1.0)[:, None], 0.0)
    cancelled = present & (length < 0.5 * total_area)
    if np.any(cancelled):
        dyads = area_normal[:, :, None] * area_normal[:, None, :] / area[:, None, None]
        summed = _at_nodes(facets, dyads.reshape(-1, 9), len(nodes)).reshape(-1, 3, 3)
        normals[cancelled] = np.linalg.eigh(summed[cancelled])[1][:, :, 2]
    return normals, present


def _at_nodes(facets: NDArray[np.integer], values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Sum of the values (F, c) of the facets around each node, (n, c)."""
    repeated = np.repeat(values, facets.shape[1], axis=0)
    return np.stack([sum_at(facets, column, count) for column in repeated.T], axis=1)
