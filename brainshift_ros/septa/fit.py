"""Whether dural septa and a brain belong together: asked before meshing, which takes minutes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brainshift_ros.errors import InputError
from brainshift_ros.septa.sheets import Septum, sheet_surfaces
from brainshift_ros.surface.queries import closest_points, inside
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import face_areas
from brainshift_ros.units import m_to_mm

#: Share of a sheet's area inside the brain. On the template it is 0.83 (falx) and 0.92 (tentorium); with landmarks in LPS
#: 0.56 and 0.35. Wide fissures that are not labelled as brain lower it, so only very little is refused.
_LEAST_INSIDE, _USUAL_INSIDE = 0.1, 0.6

#: Share of an attached edge that may end inside the brain without a word: the petrous apex does.
_ENDING_INSIDE = 0.1


def check_septa(septa: Sequence[Septum], brain: Surface) -> tuple[str, ...]:
    """Compare sheets with the brain they should divide; returns what a person should know.

    Parameters
    ----------
    septa
        Any number.
    brain
        Closed surface, same frame.

    Raises
    ------
    InputError
        Nearly all of a sheet lies outside the brain: wrong frame or patient.
    """
    warnings = []
    for name, sheet in sheet_surfaces(septa).items():
        area = face_areas(sheet)
        within = inside(brain, sheet.vertices[sheet.faces].mean(axis=1))
        share = float(area[within].sum() / area.sum())
        if share < _LEAST_INSIDE:
            problem = f"only {share:.0%} of the {name} lies in the brain"
            raise InputError("septa", problem, "give landmarks of this patient, in mm, RAS")
        if share < _USUAL_INSIDE:
            warnings.append(f"only {share:.0%} of the {name} lies in the brain: look at it on the MR")
        edge = np.vstack([septum.surface.vertices[septum.attached] for septum in septa if septum.name == name])
        ends = edge[inside(brain, edge)] if len(edge) else edge
        if len(ends) > _ENDING_INSIDE * len(edge):
            gap_mm = float(m_to_mm(closest_points(brain, ends).distance.max()))
            warnings.append(
                f"{len(ends) / len(edge):.0%} of the {name}'s attached edge ends inside the brain, up to {gap_mm:.1f} mm "
                "from its surface: a gap is left there"
            )
    return tuple(warnings)
