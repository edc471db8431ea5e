"""What lies under the scanner: cortex with its vessels in a craniotomy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import transform_points
from brainshift_ros.simulation.craniotomy import Craniotomy, Surround, hull_height, make_surround, place_craniotomy
from brainshift_ros.simulation.texture import CortexTexture, paint_texture
from brainshift_ros.simulation.vessels import PaintedVessel, SulcalRelief, VesselStyle, grow_vessels
from brainshift_ros.surface.surface import Surface

_HIDDEN_M = 20e-3  # cortex beside the opening that a tilted scanner can see under the bone


@dataclass(frozen=True)
class SurgicalScene:
    """What the scanner sees of the patient, before any shift, in the patient frame.

    Attributes
    ----------
    cortex
        Surface around the opening.
    vertex_ids
        Shape (V,), index of each vertex in the surface that the scene was made from.
    """

    cortex: Surface
    vertex_ids: NDArray[np.intp]
    craniotomy: Craniotomy
    surround: Surround
    texture: CortexTexture
    vessels: tuple[PaintedVessel, ...]


def make_scene(
    cortex: Surface,
    center: NDArray[np.float64],
    diameter_m: float,
    seed: int,
    *,
    painted_margin_m: float = 0.0,
    vessel_style: VesselStyle | None = None,
) -> SurgicalScene:
    """Open a craniotomy over `cortex`, paint the brain and cover the rest.

    Parameters
    ----------
    cortex
        The true surface, patient frame, metres; edges of 1 to 2 mm or finer show gyri.
    center, diameter_m
        Where and how wide the opening is, metres.
    seed
        Decides vessels, mottling, edge and drape.
    painted_margin_m
        How much farther than usual cortex and vessels reach beyond the opening: as far as tissue may slide into it, metres.
    vessel_style
        How vessels run; straight over sulci by default.
    """
    rng = np.random.default_rng(seed)
    craniotomy = place_craniotomy(cortex, center, diameter_m)
    local = transform_points(craniotomy.T_craniotomy_patient, cortex.vertices)
    painted_m = craniotomy.radius_m + painted_margin_m
    # What the opening can show; brain farther out would stick out beyond the drape's edge.
    reach_m = painted_m + _HIDDEN_M if painted_margin_m > 0 else 1.7 * craniotomy.radius_m
    keep = (np.hypot(local[:, 0], local[:, 1]) < reach_m) & (local[:, 2] > -0.045 - painted_margin_m)
    faces = cortex.faces[keep[cortex.faces].all(axis=1)]
    ids = np.unique(faces)
    if len(ids) < 100:
        raise InputError("cortex", f"only {len(ids)} vertices around the craniotomy", "give a finer surface or another centre")
    renumber = np.full(len(cortex.vertices), -1, dtype=np.int32)
    renumber[ids] = np.arange(len(ids))
    half_width = 1.4 * painted_m
    height, hull = hull_height(craniotomy, cortex, half_width)
    vessels = grow_vessels(painted_m, rng, vessel_style, SulcalRelief(hull - height, half_width))
    texture = paint_texture(vessels, hull - height, half_width, rng)
    return SurgicalScene(
        cortex=Surface(cortex.vertices[ids], renumber[faces]),
        vertex_ids=ids.astype(np.intp),
        craniotomy=craniotomy,
        surround=make_surround(craniotomy, cortex, rng),
        texture=texture,
        vessels=vessels,
    )
