"""Displacement boundary conditions (spec P7; thesis, figures 5 and 31): fixed, slip, stress-free."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.mechanics.frames import LocalFrames, nodal_normals
from brainshift_ros.mechanics.heights import height_over_level
from brainshift_ros.mechanics.space import Space
from brainshift_ros.mechanics.submesh import CAVITY, SHEETS

#: Demarcation of the stress-free cap, as a fraction of the head's extent along up. The thesis sets it "empirically". Here it
#: is the highest level, in steps of 0.05, at which a frontal craniotomy of 7 cm, uppermost in a supine head, lies inside the
#: cap for the planned orientation. A lower level would free more of the orbital surface, where bone holds the brain.
CAP_LEVEL = 0.75


class NodeKind(IntEnum):
    """What a boundary node may do, for pictures such as figure 5."""

    INTERIOR = 0
    FIXED = 1
    SLIP = 2
    FREE = 3
    CAVITY = 4
    CONTACT = 5


@dataclass(frozen=True)
class Boundary:
    """Boundary of a displacement space, n nodes, as far as it does not depend on the head's orientation.

    Attributes
    ----------
    frames
        Shape (n, 3, 3); the rows are each node's local axes, septum normals first, then the skull's, then tangents.
        Identity at nodes without normals.
    fixed
        Shape (n,), the brainstem.
    always_slip
        Shape (n, 3), local axes that are always constrained: normals of septa, both sides and rims.
    skull_axis
        Shape (n,), the local axis that is the skull's outward normal (made orthogonal to the septa's), -1 where there is
        none: moving against the skull is a positive component.
    outer
        Shape (n,), nodes on the skull side.
    wall
        Shape (n,), nodes on the wall that resection opened.
    cavity
        Shape (n,), the part of `wall` that lies on no other surface and is not fixed.
    """

    frames: NDArray[np.float64]
    fixed: NDArray[np.bool_]
    always_slip: NDArray[np.bool_]
    skull_axis: NDArray[np.integer]
    outer: NDArray[np.bool_]
    wall: NDArray[np.bool_]
    cavity: NDArray[np.bool_]

    @cached_property
    def turned(self) -> NDArray[np.bool_]:
        """Nodes (n,) whose local axes are not the patient's."""
        return (self.frames != np.eye(3)).any(axis=(1, 2))

    def rotation(self) -> sp.csr_matrix:
        """Sparse R (3n, 3n) from patient to local components: ``u_local = R @ u``."""
        count = len(self.frames)
        return sp.bsr_matrix((self.frames, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count)).tocsr()


def boundary_of(space: Space) -> Boundary:
    """Find normals, local frames and fixed nodes.

    Parameters
    ----------
    space
        With facets `skull`, `falx`, `tentorium`, `cavity` and node set `brainstem`, as far as they exist.
    """
    count = len(space)
    local = LocalFrames(count)
    for sheet in SHEETS:
        local.add(*nodal_normals(space.points, _facets(space, sheet)))
    always_slip = np.arange(3) < local.rank[:, None]
    added = local.add(*nodal_normals(space.points, _facets(space, "skull")))
    skull_axis = np.where(added, local.rank - 1, -1)
    fixed = np.zeros(count, dtype=bool)
    fixed[space.node_sets.get("brainstem", np.zeros(0, np.int32))] = True
    outer, wall = _on(space, "skull"), _on(space, CAVITY)
    elsewhere = outer | fixed
    for sheet in SHEETS:
        elsewhere |= _on(space, sheet)
    return Boundary(local.completed(), fixed, always_slip, skull_axis, outer, wall, wall & ~elsewhere)


def in_cap(
    nodes: NDArray[np.float64],
    gravity_direction: ArrayLike,
    cap_level: float = CAP_LEVEL,
    points: NDArray[np.float64] | None = None,
) -> NDArray[np.bool_]:
    """Points above the demarcation plane of the stress-free cap; arguments as in :func:`.heights.height_over_level`."""
    return height_over_level(nodes, gravity_direction, cap_level, points) > 0.0


def constrained_dofs(boundary: Boundary, cap: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Local dofs (n, 3) whose displacement is zero, for a stress-free cap given as a mask of nodes."""
    constrained = boundary.always_slip.copy()
    slip = np.flatnonzero((boundary.skull_axis >= 0) & ~cap)
    constrained[slip, boundary.skull_axis[slip]] = True
    constrained[boundary.fixed] = True
    return constrained


def node_kinds(boundary: Boundary, cap: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """:class:`NodeKind` of each node, shape (n,)."""
    kinds = np.full(len(cap), NodeKind.INTERIOR, dtype=np.uint8)
    kinds[boundary.cavity] = NodeKind.CAVITY
    kinds[boundary.always_slip.any(axis=1)] = NodeKind.SLIP
    kinds[boundary.skull_axis >= 0] = np.where(cap, NodeKind.FREE, NodeKind.SLIP)[boundary.skull_axis >= 0]
    kinds[boundary.fixed] = NodeKind.FIXED
    return kinds


def _on(space: Space, name: str) -> NDArray[np.bool_]:
    """Nodes (n,) of a named surface."""
    mask = np.zeros(len(space), dtype=bool)
    mask[_facets(space, name)] = True
    return mask


def _facets(space: Space, name: str) -> NDArray[np.integer]:
    return space.facets.get(name, np.zeros((0, 3), dtype=np.int32))
