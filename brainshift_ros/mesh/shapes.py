"""What a mesh must follow: smooth surfaces of brain and tumour from the labels, and the septa (spec P3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.image.labels import largest_component, voxel_volume
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.mesh.sizing import Craniotomy, edge_length_for, effective_radius
from brainshift_ros.mesh.tumors import TumorPiece, meshed_tumor, tumor_pieces
from brainshift_ros.septa.sheets import Septum
from brainshift_ros.surface.queries import closest_points
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import (
    decimate,
    enclosed_volume,
    face_areas,
    smooth_laplacian,
    smooth_taubin,
    surface_of_mask,
)
from brainshift_ros.units import m3_to_ml, m_to_mm

#: Blur that takes the voxels' steps off the brain's surface.
BLUR_M = 0.001

#: Share of the brain that may lie apart from the rest without a word: crumbs of a drawn mask.
CRUMBS = 0.02

#: Tissue between tumour and brain surface that is thinner than this, in edge lengths, goes to the tumour.
_THINNEST = 0.2

#: Edges of the surfaces that the mesher is given, in edge lengths (a small tumour's: in radii): finer than the mesh,
#: coarser than the voxels.
_BRAIN_EDGE, _TUMOR_EDGE = 0.8, 0.5

_HEALTHY = (Region.LEFT_CEREBRUM, Region.RIGHT_CEREBRUM, Region.CEREBELLUM, Region.BRAINSTEM)
_SAMPLED = 4000


@dataclass(frozen=True)
class Shapes:
    """What the mesh must follow.

    Attributes
    ----------
    labels
        In one piece, without crumbs.
    brain, brain_volume
        Its closed surface, and the volume of its voxels, m^3.
    tumors
        Each with surface and volume.
    septa
        Falx and tentorium.
    craniotomy
        None if it is not known.
    edge_length
        Far from tumour and craniotomy, metres.
    meshed_brain, meshed_tumors
        The same surfaces with fewer triangles, as the mesher gets them.
    """

    labels: Volume
    brain: Surface
    brain_volume: float
    tumors: tuple[TumorPiece, ...]
    septa: tuple[Septum, ...]
    craniotomy: Craniotomy | None
    edge_length: float
    meshed_brain: Surface
    meshed_tumors: tuple[Surface, ...]


def shapes_of(
    labels: Volume, septa: tuple[Septum, ...], nodes: int, craniotomy: Craniotomy | None = None
) -> tuple[Shapes, tuple[str, ...]]:
    """Find the surfaces, and the edge length that gives about so many nodes.

    Parameters
    ----------
    labels
        Cropped to the brain.
    septa, craniotomy
        As given.
    nodes
        Of the mesh.

    Returns
    -------
    shapes : Shapes
    warnings : tuple of str
        What of the labels was left out.

    Raises
    ------
    InputError
        There is tumour, but too little to mesh.
    """
    labels, pieces, warnings = _in_one_piece(labels)
    mask = brain_mask(labels)
    brain = smooth_taubin(surface_of_mask(mask, labels.T_patient_voxel, BLUR_M))
    rough = edge_length_for(nodes, brain, ())  # the tumour's refinement changes it little
    tumors = tumor_pieces(pieces, mask, labels, _THINNEST * rough)
    edge = edge_length_for(nodes, brain, [tumor.surface for tumor in tumors], craniotomy)
    shapes = Shapes(
        labels=labels,
        brain=brain,
        brain_volume=voxel_volume(labels) * np.count_nonzero(mask),
        tumors=tumors,
        septa=septa,
        craniotomy=craniotomy,
        edge_length=edge,
        meshed_brain=_with_edges(brain, _BRAIN_EDGE * edge),
        meshed_tumors=tuple(
            _with_edges(tumor.surface, _TUMOR_EDGE * min(edge, effective_radius(tumor.surface))) for tumor in tumors
        ),
    )
    return shapes, warnings


def brain_mask(labels: Volume) -> NDArray[np.bool_]:
    """Fill the labelled brain to one solid: largest part, no holes."""
    return ndimage.binary_fill_holes(largest_component(labels.data > 0))


def filled(labels: Volume, regions: tuple[Region, ...] = _HEALTHY) -> Volume:
    """Labels of the given regions spread to all voxels, each taking the nearest."""
    known = np.isin(labels.data, regions)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return Volume(labels.data[tuple(nearest)], labels.T_patient_voxel)


def surface_figures(shapes: Shapes) -> Mapping[str, float]:
    """Volume change and distance to the mask of the brain's surface, beside plain Laplacian smoothing as in the thesis.

    The reference is marching cubes of the voxels as they are. Distances are means over points of the smoothed surface.
    """
    steps = surface_of_mask(brain_mask(shapes.labels), shapes.labels.T_patient_voxel)
    figures = {}
    for name, surface in (("surface", shapes.brain), ("laplacian", smooth_laplacian(steps))):
        chosen = np.linspace(0, len(surface.vertices) - 1, _SAMPLED).astype(int)
        distance = closest_points(steps, surface.vertices[chosen]).distance
        figures[f"{name}_volume_change_percent"] = float(100.0 * (enclosed_volume(surface) / shapes.brain_volume - 1.0))
        figures[f"{name}_distance_mm_mean"] = float(m_to_mm(distance.mean()))
        figures[f"{name}_distance_mm_max"] = float(m_to_mm(distance.max()))
    return figures


def _in_one_piece(labels: Volume) -> tuple[Volume, NDArray[np.int32], tuple[str, ...]]:
    """Keep the largest piece of brain, which the mesh follows; crumbs of tumour become what surrounds them."""
    warnings: tuple[str, ...] = ()
    brain = labels.data > 0
    apart = brain & ~largest_component(brain)
    if np.count_nonzero(apart) > CRUMBS * np.count_nonzero(brain):
        millilitres = float(m3_to_ml(voxel_volume(labels) * np.count_nonzero(apart)))
        warnings = (f"{millilitres:.2g} ml of brain apart from its largest piece are left out",)
    labels = Volume(np.where(apart, np.uint8(Region.OUTSIDE), labels.data), labels.T_patient_voxel)
    pieces, crumbs = meshed_tumor(labels)
    lost = (labels.data == Region.TUMOR) & (pieces == 0)
    if lost.any():
        labels = Volume(np.where(lost, filled(labels).data, labels.data), labels.T_patient_voxel)
    return labels, pieces, warnings + crumbs


def _with_edges(surface: Surface, edge_length: float) -> Surface:
    """Decimate to about this edge length: the area of an equilateral triangle is sqrt(3) / 4 of its edge squared."""
    return decimate(surface, int(face_areas(surface).sum() / (0.433 * edge_length**2)))
