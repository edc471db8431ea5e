"""Instruments over the field: bare metal that hides the cortex, shines, and keeps the lamp's light off what lies below."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import tangent_frame, unit
from brainshift_ros.surface.surface import Surface

_SIDES = 96  # of a round section: a tube of 2 mm is then true to 1 micrometre


@dataclass(frozen=True)
class Instrument:
    """A closed metal body in the patient frame.

    Attributes
    ----------
    surface
        Triangles, outward normals, metres.
    reflectance
        Grey of the metal where it does not glint, 0 to 1.
    """

    surface: Surface
    reflectance: float = 0.42


def suction_tube(tip: ArrayLike, end: ArrayLike, radius_m: float = 1.75e-3) -> Instrument:
    """Build a round rod, or a suction tube, from its tip to its other end.

    Parameters
    ----------
    tip, end
        Shape (3,), metres, patient frame: ends of the axis.
    radius_m
        Outer radius, metres.
    """
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    along = np.subtract(end, tip)
    return Instrument(_prism(radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1), tip, end, tangent_frame(along)[:2]))


def spatula(tip: ArrayLike, end: ArrayLike, normal: ArrayLike, width_m: float = 12e-3, thickness_m: float = 1e-3) -> Instrument:
    """Build a flat blade from its tip to its other end.

    Parameters
    ----------
    tip, end
        Shape (3,), metres, patient frame: ends of the axis.
    normal
        Shape (3,): which way the flat side looks; its part across the axis counts.
    width_m, thickness_m
        Section, metres.
    """
    along = unit(np.subtract(end, tip))
    flat = np.asarray(normal, dtype=np.float64)
    flat = flat - (flat @ along) * along
    if not np.linalg.norm(flat) > 1e-9:
        raise InputError("spatula", "its normal lies along its axis", "give the direction that the flat side looks to")
    flat = unit(flat)
    # The upper side bulges by half the thickness, as blades do: a plane would throw one glint or none.
    across = np.linspace(-0.5, 0.5, 17)
    top = np.stack([width_m * across, thickness_m * (1.0 - 2.0 * across**2) - 0.5 * thickness_m], axis=-1)
    bottom = np.stack([width_m * across, np.full_like(across, -0.5 * thickness_m)], axis=-1)
    return Instrument(_prism(np.concatenate([bottom, top[::-1]]), tip, end, np.stack([np.cross(flat, along), flat])))


def _prism(section: NDArray[np.float64], start: ArrayLike, stop: ArrayLike, axes: NDArray[np.float64]) -> Surface:
    """Sweep a convex section (n, 2) from start to stop; `axes` (2, 3) carry it, right-handed with the sweep."""
    outline = section @ axes
    rings = [outline + np.asarray(at, dtype=np.float64) for at in (start, stop)]
    n = len(section)
    # Each part has vertices of its own, so that normals stay sharp at the edges.
    i = np.arange(n)
    j = (i + 1) % n
    wall = np.concatenate([np.stack([i, j, j + n], -1), np.stack([i, j + n, i + n], -1)])
    fan = np.stack([np.zeros(n - 2, dtype=int), i[1:-1], i[2:]], axis=-1)
    vertices = np.concatenate(rings + rings)
    faces = np.concatenate([wall, fan[:, ::-1] + 2 * n, fan + 3 * n])
    return Surface(vertices, faces.astype(np.int32))
