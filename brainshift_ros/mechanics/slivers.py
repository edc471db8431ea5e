"""Elements so flat that the displacement in them is coarse: found and reported, since they are no error."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mesh.quality import dihedral_angles_deg

#: Flatter elements are reported, degrees. The patient model's own meshes are made with ten times as much; a direct solver
#: copes with far less, but what it solves for is then the mesh's displacement more than the tissue's.
SLIVER_DEG = 1.0


def sliver_warnings(nodes: NDArray[np.float64], elements: NDArray[np.integer], volume: NDArray[np.float64]) -> tuple[str, ...]:
    """Say how many elements have a dihedral angle below :data:`SLIVER_DEG`, if any has.

    With the longest edge l, two heights below it and the angle theta between two faces, six volumes are at most
    l^3 sin(theta): only elements below that bound need their angles measured, which are few.

    Parameters
    ----------
    nodes, elements, volume
        Shapes (N, 3), (M, 4) and (M,).
    """
    edges = [((nodes[elements[:, i]] - nodes[elements[:, j]]) ** 2).sum(axis=1) for i, j in combinations(range(4), 2)]
    longest = np.max(edges, axis=0) ** 1.5
    suspects = np.flatnonzero(6.0 * volume <= longest * np.sin(np.radians(SLIVER_DEG)))
    angles = dihedral_angles_deg(nodes, elements[suspects]).min(axis=1)
    flat = int((angles < SLIVER_DEG).sum())
    if flat == 0:
        return ()
    return (
        f"{flat} elements have a dihedral angle below {SLIVER_DEG:g} degree (smallest {angles.min():.2g}): "
        "the displacement is coarse there",
    )
