"""Mesh quality: figures, and the gate that a mesh must pass (spec P4)."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.surface.facets import components, face_table
from brainshift_ros.units import m3_to_ml, m_to_mm

#: Figure -> (lowest, highest) value that passes.
LIMITS: Mapping[str, tuple[float, float]] = {
    "inverted": (0.0, 0.0),
    "components": (1.0, 1.0),
    "dihedral_min_deg": (10.0, 71.0),
    "volume_error_percent": (0.0, 1.0),
    "tumor_volume_error_percent": (0.0, 3.0),
    "falx_area_error_percent": (0.0, 5.0),
    "tentorium_area_error_percent": (0.0, 5.0),
    # The mesher sometimes gives up following a part of a sheet; another attempt follows it.
    "falx_stray_percent": (0.0, 5.0),
    "tentorium_stray_percent": (0.0, 5.0),
}


def dihedral_angles_deg(nodes: NDArray[np.float64], elements: NDArray[np.integer]) -> NDArray[np.float64]:
    """Six dihedral angles of each element, shape (M, 6), degrees; 70.5 in a regular tetrahedron."""
    x = nodes[elements]
    # Normals of the four faces are the gradients of the barycentric coordinates.
    gradients = np.linalg.inv(x[:, 1:] - x[:, :1]).transpose(0, 2, 1)
    normals = np.concatenate([-gradients.sum(axis=1, keepdims=True), gradients], axis=1)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    cosines = [-np.einsum("mk,mk->m", normals[:, i], normals[:, j]) for i, j in combinations(range(4), 2)]
    return np.degrees(np.arccos(np.clip(np.stack(cosines, axis=1), -1.0, 1.0)))


def element_quality(mesh: TetMesh) -> dict[str, float]:
    """Figures that need the mesh alone: counts, inverted elements, dihedral angles, edge lengths, components."""
    volumes = mesh.volumes
    inverted = int(np.count_nonzero(volumes <= 0.0))
    angles = dihedral_angles_deg(mesh.nodes, mesh.elements[volumes > 0.0]).min(axis=1)
    pairs = mesh.elements[:, list(combinations(range(4), 2))].reshape(-1, 2)
    edges = np.linalg.norm(mesh.nodes[pairs[:, 0]] - mesh.nodes[pairs[:, 1]], axis=1)
    parts = components(len(mesh.elements), face_table(mesh.elements).owners)
    return {
        "nodes": float(len(mesh.nodes)),
        "elements": float(len(mesh.elements)),
        "inverted": float(inverted),
        "components": float(parts.max() + 1),
        "dihedral_min_deg": float(angles.min()),
        "dihedral_p01_deg": float(np.percentile(angles, 1.0)),
        "dihedral_median_deg": float(np.median(angles)),
        "edge_median_mm": float(m_to_mm(np.median(edges))),
        "volume_ml": float(m3_to_ml(volumes.sum())),
    }


def relative_error_percent(value: float, reference: float) -> float:
    """Absolute difference in per cent of the reference."""
    return float(100.0 * abs(value - reference) / reference)


def faults(quality: Mapping[str, float]) -> tuple[str, ...]:
    """Say which figures of :data:`LIMITS` lie outside their limits; figures that are not there pass."""
    return tuple(
        f"{name} is {quality[name]:.4g} (allowed: {low:g} to {high:g})"
        for name, (low, high) in LIMITS.items()
        if name in quality and not low <= quality[name] <= high
    )


def refuse_bad_mesh(quality: Mapping[str, float], source: object = "mesh") -> None:
    """Raise unless every figure of :data:`LIMITS` that is present lies within its limits.

    Raises
    ------
    InputError
        Names each figure that fails, with its limit.
    """
    if found := faults(quality):
        raise InputError(source, "; ".join(found), "try another number of nodes or seed, or smoother labels")
