"""Whether falx and tentoria stand to each other as in an upright head in RAS, in millimetres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brainshift_ros.errors import InputError
from brainshift_ros.septa.sheets import Septum
from brainshift_ros.surface.surfacing import face_areas
from brainshift_ros.units import m_to_mm

#: A head's falx measures 130 to 250 mm from end to end, each tentorium 60 to 150 mm; these leave room to children and to
#: sheets that go on outside.
_EXTENT_MM = {"falx": (80.0, 350.0), "tentorium": (40.0, 250.0)}


def check_frame(source: object, septa: Sequence[Septum]) -> None:
    """Refuse septa in another frame or unit than they should be in; asks no image.

    The tentorium lies below and behind the falx, its left side on the left.

    Parameters
    ----------
    source
        Where they come from, for messages.
    septa
        Falx, left and right tentorium, in this order.

    Raises
    ------
    InputError
        Wrong unit, LPS or another frame, or left and right exchanged.
    """
    for septum in septa:
        extent_mm = float(m_to_mm(np.linalg.norm(np.ptp(septum.surface.vertices, axis=0))))
        low, high = _EXTENT_MM[septum.name]
        if not low <= extent_mm <= high:
            problem = f"the {septum.name} measures {extent_mm:.3g} mm from end to end, expected {low:g} to {high:g}"
            raise InputError(source, problem, "give coordinates in mm (not metres, not voxels)")
    falx, left, right = (np.average(_centres(s), axis=0, weights=face_areas(s.surface)) for s in septa)
    tentorium = 0.5 * (left + right)
    mirrored, behind, below = left[0] >= right[0], tentorium[1] < falx[1], tentorium[2] < falx[2]
    if not below:
        raise InputError(
            source, "the tentorium lies above the falx", "give coordinates in RAS: x right, y anterior, z superior"
        )
    if not behind:
        frame = "LPS" if mirrored else "another frame than RAS"
        problem = f"the tentorium lies in front of the falx: the coordinates seem to be in {frame}"
        raise InputError(source, problem, "give coordinates in RAS: x right, y anterior, z superior")
    if mirrored:
        problem = "the left tentorium lies right of the right one: the septa are mirrored"
        raise InputError(source, problem, "exchange left and right, or give coordinates in RAS (x to the right)")


def _centres(septum: Septum) -> np.ndarray:
    return septum.surface.vertices[septum.surface.faces].mean(axis=1)
