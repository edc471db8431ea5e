"""The matrix M of (3.5): the atlas's solutions at the measured points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.inverse.appended import AppendedAtlas
from brainshift_ros.mesh.locate import Located, PointLocator
from brainshift_ros.units import m_to_mm, mm_to_m


@dataclass(frozen=True)
class SparseRows:
    """The atlas at those measured points that lie on the mesh.

    Attributes
    ----------
    M
        Shape (n, 3, m), metres per unit weight: column m of the atlas (then of the retraction) at each kept point.
    kept
        Shape (n,), indices of the kept points among the measured ones.
    located
        Where the kept points lie in the mesh.
    warnings
        What was dropped, and why.
    """

    M: NDArray[np.float64]
    kept: NDArray[np.int64]
    located: Located
    warnings: tuple[str, ...]


def rows_at_points(
    atlas: AppendedAtlas,
    measured: HomologousPoints,
    *,
    locator: PointLocator,
    max_outside_mm: float = 5.0,
) -> SparseRows:
    """Interpolate the atlas at measured points, reading only the rows of the nodes around them.

    Parameters
    ----------
    atlas
        The patient's atlas, with what was appended to it.
    measured
        Points before the shift, in the patient frame.
    locator
        Locator of the atlas's mesh.
    max_outside_mm
        Points outside the mesh take the nearest surface point if it is at most this far, else they are dropped.

    Raises
    ------
    InputError
        No measured point lies on the brain: wrong patient, wrong frame or wrong units.
    """
    located = locator.locate(measured.points, max_outside_m=float(mm_to_m(max_outside_mm)))
    kept = np.flatnonzero(located.found)
    if kept.size == 0:
        nearest = float(m_to_mm(np.min(located.distance_m, initial=np.inf)))
        raise InputError(
            "homologous points",
            f"none of {len(measured.points)} points lies within {max_outside_mm:g} mm of the brain (nearest: {nearest:.0f} mm)",
            "check that points and atlas belong to the same patient, and that the points are in the patient frame, RAS",
        )
    located = Located(located.element[kept], located.barycentric[kept], located.distance_m[kept], located.inside[kept])
    nodes, corner = np.unique(atlas.mesh.elements[located.element], return_inverse=True)
    corners_of = 4 * np.arange(kept.size + 1)
    # A sparse product: gathering four rows a point first would take four times M's memory.
    interpolation = sparse.csr_array((located.barycentric.ravel(), corner.ravel(), corners_of), (kept.size, nodes.size))
    rows = atlas.rows(nodes)
    M = (interpolation @ rows.reshape(nodes.size, -1)).reshape(kept.size, *rows.shape[1:])
    dropped = len(measured.points) - kept.size
    warnings = (
        (f"{dropped} of {len(measured.points)} points lie more than {max_outside_mm:g} mm outside the brain and were dropped",)
        if dropped
        else ()
    )
    return SparseRows(M, kept, located, warnings)
