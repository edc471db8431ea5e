"""Where an estimate is compared with the truth: groups of nodes, because an average hides the far field (spec E1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from brainshift_ros.image.volume import Region
from brainshift_ros.mesh.tetmesh import TetMesh

#: Nodes this close to the craniotomy's centre count as subsurface targets; the thesis validates within the surgical field.
SUBSURFACE_REACH_M = 0.06

#: Nodes this close to the tumour's surface, on the brain's side, are its margin.
MARGIN_M = 0.01

#: Nodes this close to the falx are midline.
MIDLINE_M = 0.01


def target_groups(mesh: TetMesh, center: ArrayLike, radius_m: float) -> dict[str, NDArray[np.intp]]:
    """Name the nodes of a mesh by where they lie.

    Parameters
    ----------
    mesh
        With facets ``skull`` and, if present, ``falx`` and ``tumor``.
    center, radius_m
        The craniotomy, metres, patient frame.

    Returns
    -------
    dict
        Node ids of ``surface`` (cortex under the craniotomy), ``subsurface`` (interior nodes within 60 mm of the craniotomy's
        centre), ``tumor_margin``, ``deep`` (interior nodes farther than 60 mm), ``midline`` and ``contralateral``. Groups
        overlap; a group without nodes is left out.
    """
    distance = np.linalg.norm(mesh.nodes - np.asarray(center, dtype=np.float64), axis=1)
    outer = np.zeros(len(mesh.nodes), dtype=bool)
    outer[np.unique(mesh.facets["skull"])] = True
    inside_head = ~outer
    groups = {
        "surface": outer & (distance <= radius_m),
        "subsurface": inside_head & (distance <= SUBSURFACE_REACH_M),
        "deep": inside_head & (distance > SUBSURFACE_REACH_M),
        "tumor_margin": _near_facets(mesh, "tumor", MARGIN_M) & inside_head,
        "midline": _near_facets(mesh, "falx", MIDLINE_M) & inside_head,
        "contralateral": _in_region(mesh, _other_side(mesh, np.asarray(center, dtype=np.float64))) & inside_head,
    }
    return {name: np.flatnonzero(mask) for name, mask in groups.items() if mask.any()}


def _in_region(mesh: TetMesh, region: Region) -> NDArray[np.bool_]:
    mask = np.zeros(len(mesh.nodes), dtype=bool)
    mask[mesh.elements[mesh.region == region]] = True
    return mask


def _near_facets(mesh: TetMesh, name: str, reach_m: float) -> NDArray[np.bool_]:
    facets = mesh.facets.get(name)
    if facets is None or len(facets) == 0:
        return np.zeros(len(mesh.nodes), dtype=bool)
    distance, _ = cKDTree(mesh.nodes[np.unique(facets)]).query(mesh.nodes)
    return distance <= reach_m


def _other_side(mesh: TetMesh, center: NDArray[np.float64]) -> Region:
    """Tell which cerebral hemisphere lies away from the craniotomy."""
    centroids = mesh.nodes[mesh.elements].mean(axis=1)
    reach = {
        side: np.linalg.norm(centroids[mesh.region == side] - center, axis=1).min(initial=np.inf)
        for side in (Region.LEFT_CEREBRUM, Region.RIGHT_CEREBRUM)
    }
    return max(reach, key=lambda side: reach[side])
