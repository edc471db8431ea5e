"""How well a mesh keeps the shapes that it should follow: volumes, areas of sheets, distances of surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mesh.quality import relative_error_percent
from brainshift_ros.mesh.shapes import Shapes
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.septa.sheets import sheet_surfaces
from brainshift_ros.surface.facets import facet_areas
from brainshift_ros.surface.queries import closest_points, inside
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import face_areas
from brainshift_ros.units import m3_to_ml, m_to_mm

#: A facet leaves its sheet if a corner is this many edge lengths off: twice what the mesher is allowed.
STRAYING = 0.3

#: Centres of the 64 equal triangles into which edges cut in eight divide one, barycentric: faces of sheets are large.
_SUBCENTRES = np.array(
    [
        ((i + shift) / 8.0, (j + shift) / 8.0, 1.0 - (i + j + 2.0 * shift) / 8.0)
        for shift, last in ((1.0 / 3.0, 8), (2.0 / 3.0, 7))
        for i in range(last)
        for j in range(last - i)
    ]
)


def fidelity(mesh: TetMesh, piece: NDArray[np.int32], shapes: Shapes) -> dict[str, float]:
    """Compare a mesh with the shapes it was made from.

    Parameters
    ----------
    mesh
        Split, with named facets.
    piece
        Shape (M,), number of the tumour's piece from 1 that each element belongs to, else 0.
    shapes
        From the labels.

    Returns
    -------
    dict
        Errors of volume and area in per cent, the tumour's being the largest over its pieces; distances of facets from
        the smooth surfaces in mm; millilitres of each piece.
    """
    volumes = mesh.volumes
    figures = {
        "edge_target_mm": float(m_to_mm(shapes.edge_length)),
        "volume_error_percent": relative_error_percent(float(volumes.sum()), shapes.brain_volume),
        "skull_distance_mm_mean": float(m_to_mm(_distances(mesh, "skull", [shapes.brain]).mean())),
    }
    if shapes.tumors:
        meshed = [float(volumes[piece == number].sum()) for number in range(1, len(shapes.tumors) + 1)]
        errors = [relative_error_percent(got, tumor.volume) for got, tumor in zip(meshed, shapes.tumors, strict=True)]
        figures["tumor_ml"] = float(m3_to_ml(sum(tumor.volume for tumor in shapes.tumors)))
        figures["tumor_pieces"] = float(len(shapes.tumors))
        if len(shapes.tumors) > 1:
            figures |= {f"tumor_{number}_ml": float(m3_to_ml(got)) for number, got in enumerate(meshed, start=1)}
        figures["tumor_volume_error_percent"] = max(errors)
        if "tumor" in mesh.facets:
            distance = m_to_mm(_distances(mesh, "tumor", [tumor.surface for tumor in shapes.tumors]))
            figures["tumor_distance_mm_mean"], figures["tumor_distance_mm_max"] = float(distance.mean()), float(distance.max())
    for name, sheet in sheet_surfaces(shapes.septa).items():
        expected = _area_inside(sheet, shapes)
        if expected > 0.0:
            one_side = 0.5 * float(facet_areas(mesh.nodes, mesh.facets[name]).sum())
            figures[f"{name}_area_error_percent"] = relative_error_percent(one_side, expected)
            figures[f"{name}_stray_percent"] = _stray_percent(mesh, name, sheet, STRAYING * shapes.edge_length)
    return figures


def _area_inside(sheet: Surface, shapes: Shapes) -> float:
    """Area of a sheet inside the brain but outside the tumour, which stays whole where it grew through; m^2."""
    centres = np.einsum("sc,fck->fsk", _SUBCENTRES, sheet.vertices[sheet.faces])
    within = inside(shapes.brain, centres.reshape(-1, 3))
    for tumor in shapes.tumors:
        within &= ~inside(tumor.surface, centres.reshape(-1, 3))
    return float(face_areas(sheet) @ within.reshape(centres.shape[:2]).mean(axis=1))


def _stray_percent(mesh: TetMesh, name: str, sheet: Surface, limit: float) -> float:
    """Share of a sheet's meshed area whose facets have a corner farther than `limit` from the sheet."""
    facets = mesh.facets[name]
    distance = closest_points(sheet, mesh.nodes[facets].reshape(-1, 3)).distance.reshape(-1, 3)
    areas = facet_areas(mesh.nodes, facets)
    return float(100.0 * areas[distance.max(axis=1) > limit].sum() / max(float(areas.sum()), 1e-30))


def _distances(mesh: TetMesh, name: str, surfaces: list[Surface]) -> NDArray[np.float64]:
    """Distances of the named facets' corners and centres from the nearest of the surfaces, metres."""
    facets = mesh.facets[name]
    points = np.vstack([mesh.nodes[np.unique(facets)], mesh.nodes[facets].mean(axis=1)])
    return np.min([closest_points(surface, points).distance for surface in surfaces], axis=0)
