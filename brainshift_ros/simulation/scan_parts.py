"""What a scanner's rays can meet: cortex, surround, cavity and instruments as one geometry that knows which is which."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.geometry import unit
from brainshift_ros.surface.queries import RayCaster, RayHits
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import vertex_normals


class Seen(IntEnum):
    """What a pixel shows."""

    NOTHING = 0
    CORTEX = 1
    SURROUND = 2
    CAVITY = 3
    INSTRUMENT = 4


@dataclass(frozen=True)
class Part:
    """One surface of the scene.

    Attributes
    ----------
    label
        What it is.
    surface
        Where it is now.
    before
        Shape (V, 3), where its vertices were before the shift; None where nobody asks.
    color
        Shape (V, 3), linear RGB; None where a texture gives it.
    """

    label: Seen
    surface: Surface
    before: NDArray[np.float64] | None = None
    color: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Traced:
    """What each ray of a picture met; NaN where nothing, or where the part has no such value.

    Attributes
    ----------
    label
        Shape (H, W), uint8, values of :class:`Seen`.
    position, normal, material, color
        Shape (H, W, 3): where, its unit normal, where that was before the shift, and its reflectance.
    """

    label: NDArray[np.uint8]
    position: NDArray[np.float64]
    normal: NDArray[np.float64]
    material: NDArray[np.float64]
    color: NDArray[np.float64]


class RayScene:
    """Parts prepared for ray casting."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self._parts = parts
        first_vertex = np.cumsum([0, *(len(part.surface.vertices) for part in parts)])
        self._first_face = np.cumsum([0, *(len(part.surface.faces) for part in parts)])
        faces = [part.surface.faces + offset for part, offset in zip(parts, first_vertex[:-1], strict=True)]
        vertices = np.concatenate([part.surface.vertices for part in parts])
        self._caster = RayCaster(Surface(vertices, np.concatenate(faces).astype(np.int32)))

    def trace(self, origin: NDArray[np.float64], rays: NDArray[np.float64]) -> Traced:
        """Follow unit rays (H, W, 3) from one origin (3,)."""
        hits = self._caster.cast(origin, rays)
        label = np.full(hits.face.shape, Seen.NOTHING, dtype=np.uint8)
        position, normal, material, color = (np.full(rays.shape, np.nan) for _ in range(4))
        for part, first, beyond in zip(self._parts, self._first_face[:-1], self._first_face[1:], strict=True):
            where = (hits.face >= first) & (hits.face < beyond)
            vertices, faces = part.surface.vertices, part.surface.faces
            label[where] = part.label
            position[where] = _interpolate(vertices, faces, hits, first, where)
            normal[where] = unit(_interpolate(vertex_normals(vertices, faces), faces, hits, first, where))
            for values, into in ((part.before, material), (part.color, color)):
                if values is not None:
                    into[where] = _interpolate(values, faces, hits, first, where)
        return Traced(label, position, normal, material, color)

    def hidden(self, points: NDArray[np.float64], toward: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether something lies between points (..., 3) and a far lamp in the direction `toward` (3,)."""
        return np.asarray(self._caster.cast(points, toward).face >= 0)


def _interpolate(
    values: NDArray[np.float64], faces: NDArray[np.int32], hits: RayHits, first_face: int, where: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Interpolate vertex values at the hit points of the pixels `where`, shape (k, 3); `faces` begin at `first_face`."""
    return np.einsum("kc,kcd->kd", hits.barycentric[where], values[faces[hits.face[where] - first_face]])
