"""Dural septa of a patient from the template's, carried over by a registration (spec P2; thesis, figures 3 and 19)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import unit
from brainshift_ros.image.template import template_labels, template_landmarks
from brainshift_ros.image.volume import Volume
from brainshift_ros.septa.sheets import Septum, septa_from_landmarks
from brainshift_ros.septa.strip import STRIP_MM, blurred_brain, out_of_brain, with_strip
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import mm_to_m

#: How far from the attached edge into the brain a map is asked for the direction in which it goes on outside.
_STEP_MM = 4.0

Map = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def septa_from_template(to_patient: Map, spacing_mm: float, *, strip_mm: float = STRIP_MM) -> tuple[Septum, ...]:
    """Carry the template's falx, left and right tentorium over to a patient.

    A registration is held by the brain and says little about what lies outside. So the sheets are mapped up to their attached
    edges, and strips carry these on as straight lines, in the direction in which the map arrives there.

    Parameters
    ----------
    to_patient
        Maps points, shape (n, 3), metres, from the template to the patient; must not mirror.
    spacing_mm
        Distance between neighbouring vertices, before mapping.
    strip_mm
        Width of the strips.

    Raises
    ------
    InputError
        The map gives something other than finite points, or mirrors.
    """
    originals = septa_from_landmarks(template_landmarks().septa, spacing_mm)
    _check_map(to_patient, np.vstack([septum.surface.vertices for septum in originals]))
    septa = []
    for septum in originals:
        edge = septum.surface.vertices[septum.attached]
        within = edge - mm_to_m(_STEP_MM) * out_of_brain(_template_brain(), edge)
        surface = Surface(to_patient(septum.surface.vertices), septum.surface.faces)
        outward = unit(surface.vertices[septum.attached] - to_patient(within))
        mapped = Septum(septum.name, surface, septum.attached)
        septa.append(with_strip(mapped, outward, float(mm_to_m(strip_mm)), float(mm_to_m(spacing_mm))))
    return tuple(septa)


def _check_map(to_patient: Map, points: NDArray[np.float64]) -> None:
    mapped = np.asarray(to_patient(points))
    if mapped.shape != points.shape or not np.isfinite(mapped).all():
        problem = f"maps {len(points)} points of the template's septa to {np.isfinite(mapped).all(axis=-1).sum()} finite ones"
        raise InputError("template to patient map", problem, "register again")
    homogeneous = np.column_stack([points, np.ones(len(points))])
    affine, *_ = np.linalg.lstsq(homogeneous, mapped)
    if np.linalg.det(affine[:3]) <= 0.0:
        problem = "mirrors: left and right change places"
        raise InputError("template to patient map", problem, "check the image's orientation (qform, sform)")


@cache
def _template_brain() -> Volume:
    return blurred_brain(template_labels(template_landmarks()))
