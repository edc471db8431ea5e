"""Displacement boundary conditions (spec P7; thesis, figures 5 and 31): fixed, slip, stress-free."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.mechanics.heights import height_over_level
from brainshift_ros.mechanics.submesh import SHEETS
from brainshift_ros.mesh.tetmesh import TetMesh

#: Demarcation of the stress-free cap, as a fraction of the head's extent along up. The thesis sets it "empirically". Here it
#: is the highest level, in steps of 0.05, at which a frontal craniotomy of 7 cm, uppermost in a supine head, lies inside the
#: cap for the planned orientation. A lower level would free more of the orbital surface, where bone holds the brain.
CAP_LEVEL = 0.75

#: Surfaces that meet at less than this angle give a node one normal, not two: the second would be mostly mesh noise, and
#: constraining it would lock a tangent.
MIN_ANGLE_DEG = 30.0


class NodeKind(IntEnum):
    """What a boundary node may do, for pictures such as figure 5."""

    INTERIOR = 0
    FIXED = 1
    SLIP = 2
    FREE = 3
    CAVITY = 4


@dataclass(frozen=True)
class Boundary:
    """Boundary of a mesh as far as it does not depend on the head's orientation.

    Attributes
    ----------
    frames
        Shape (N, 3, 3); the rows are each node's local axes, septum normals first, then the skull's, then tangents.
        Identity at nodes without normals.
    fixed
        Shape (N,), the brainstem.
    always_slip
        Shape (N, 3), local axes that are always constrained: normals of septa, both sides and rims.
    skull_axis
        Shape (N,), the local axis that is the skull's normal (made orthogonal to the septa's), -1 where there is none.
    cavity
        Shape (N,), nodes on the wall that resection opened and on no other surface.
    """

    frames: NDArray[np.float64]
    fixed: NDArray[np.bool_]
    always_slip: NDArray[np.bool_]
    skull_axis: NDArray[np.int64]
    cavity: NDArray[np.bool_]

    def rotation(self) -> sp.csr_matrix:
        """Sparse R (3N, 3N) from patient to local components: ``u_local = R @ u``."""
        count = len(self.frames)
        return sp.bsr_matrix((self.frames, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count)).tocsr()


def nodal_normals(nodes: NDArray[np.float64], facets: NDArray[np.int32]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Area-weighted unit normal at each node of a surface, and which nodes lie on it.

    Where both sides of a sheet share a node, on its rim, their normals cancel; there the axis that is normal to both is
    taken instead: the principal axis of the sum of A n n^T, which has no sign.

    Returns
    -------
    Normals (N, 3), zero off the surface, and a mask (N,).
    """
    corners = nodes[facets]
    area_normal = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(area_normal, axis=1)
    total, total_area = np.zeros_like(nodes), np.zeros(len(nodes))
    np.add.at(total, facets, area_normal[:, None, :])
    np.add.at(total_area, facets, area[:, None])
    present = total_area > 0.0
    length = np.linalg.norm(total, axis=1)
    normals = np.where(length[:, None] > 0.0, total / np.where(length > 0.0, length, 1.0)[:, None], 0.0)
    cancelled = present & (length < 0.5 * total_area)
    if np.any(cancelled):
        dyads = np.zeros((len(nodes), 3, 3))
        np.add.at(dyads, facets, (area_normal[:, :, None] * area_normal[:, None, :] / area[:, None, None])[:, None])
        normals[cancelled] = np.linalg.eigh(dyads[cancelled])[1][:, :, 2]
    return normals, present


def boundary_of(mesh: TetMesh, wall: NDArray[np.bool_] | None = None) -> Boundary:
    """Find normals, local frames and fixed nodes of a mesh.

    Parameters
    ----------
    mesh
        With facets `skull`, `falx`, `tentorium` and node set `brainstem`, as far as they exist.
    wall
        Shape (N,), nodes that touched removed elements.
    """
    count = len(mesh.nodes)
    frames = np.zeros((count, 3, 3))
    rank = np.zeros(count, dtype=np.int64)
    for sheet in SHEETS:
        _add_normals(frames, rank, mesh, sheet)
    always_slip = np.arange(3) < rank[:, None]
    added = _add_normals(frames, rank, mesh, "skull")
    skull_axis = np.where(added, rank - 1, -1)
    on_surface = np.zeros(count, dtype=bool)
    for name in (*SHEETS, "skull"):
        on_surface[mesh.facets.get(name, np.zeros((0, 3), np.int32))] = True
    _complete_frames(frames, rank)
    fixed = np.zeros(count, dtype=bool)
    fixed[mesh.node_sets.get("brainstem", np.zeros(0, np.int32))] = True
    cavity = np.zeros(count, dtype=bool) if wall is None else wall & ~on_surface & ~fixed
    return Boundary(frames, fixed, always_slip, skull_axis, cavity)


def in_cap(nodes: NDArray[np.float64], gravity_direction: ArrayLike, cap_level: float = CAP_LEVEL) -> NDArray[np.bool_]:
    """Nodes (N,) above the demarcation plane of the stress-free cap; `nodes` are the whole head's."""
    return height_over_level(nodes, gravity_direction, cap_level) > 0.0


def constrained_dofs(boundary: Boundary, cap: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Local dofs (N, 3) whose displacement is zero, for a stress-free cap given as a mask of nodes."""
    constrained = boundary.always_slip.copy()
    slip = np.flatnonzero((boundary.skull_axis >= 0) & ~cap)
    constrained[slip, boundary.skull_axis[slip]] = True
    constrained[boundary.fixed] = True
    return constrained


def node_kinds(boundary: Boundary, cap: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """:class:`NodeKind` of each node, shape (N,)."""
    kinds = np.full(len(cap), NodeKind.INTERIOR, dtype=np.uint8)
    kinds[boundary.cavity] = NodeKind.CAVITY
    kinds[boundary.always_slip.any(axis=1)] = NodeKind.SLIP
    kinds[boundary.skull_axis >= 0] = np.where(cap, NodeKind.FREE, NodeKind.SLIP)[boundary.skull_axis >= 0]
    kinds[boundary.fixed] = NodeKind.FIXED
    return kinds


def _add_normals(frames: NDArray[np.float64], rank: NDArray[np.int64], mesh: TetMesh, name: str) -> NDArray[np.bool_]:
    """Append a surface's normals to the local frames, made orthogonal to those already there; which nodes got one."""
    facets = mesh.facets.get(name)
    if facets is None or len(facets) == 0:
        return np.zeros(len(rank), dtype=bool)
    normals, present = nodal_normals(mesh.nodes, facets)
    residual = normals - np.einsum("nak,nai,ni->nk", frames, frames, normals)
    length = np.linalg.norm(residual, axis=1)
    added = present & (rank < 3) & (length > np.sin(np.radians(MIN_ANGLE_DEG)))
    frames[added, rank[added]] = residual[added] / length[added, None]
    rank[added] += 1
    return added


def _complete_frames(frames: NDArray[np.float64], rank: NDArray[np.int64]) -> None:
    """Fill the unused axes with the coordinate axes that stand out most from the used ones; identity where none is used."""
    for axis in range(3):
        open_ = np.flatnonzero(rank <= axis)
        used = frames[open_]
        candidates = np.eye(3) - np.einsum("nai,naj->nij", used, used)
        length = np.linalg.norm(candidates, axis=2)
        # A bias towards the axis of the same index keeps untouched nodes in patient axes.
        best = np.argmax(length + 1e-9 * np.eye(3)[axis], axis=1)
        pick = np.arange(len(open_))
        frames[open_, axis] = candidates[pick, best] / length[pick, best, None]
