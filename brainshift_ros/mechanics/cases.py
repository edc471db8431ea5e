"""One forward problem of an atlas, and what acts in it (spec P9)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from brainshift_ros.errors import InputError
from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.system import System
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.units import mm_to_m

MECHANISMS = ("gravity", "mannitol", "swelling")

#: Capillary pressure under mannitol, table 1's p_c, Pa: below that of the tissue, so that fluid is drawn out of it.
MANNITOL_PRESSURE = -3633.0

#: Largest capillary pressure of swelling, Pa: the thesis gives none, so it is mannitol's with the opposite sign.
SWELLING_PRESSURE = 3633.0

#: Tissue this close to the tumour swells.
SWELLING_MARGIN_MM = 20.0


@dataclass(frozen=True)
class Case:
    """One forward problem on given elements.

    Attributes
    ----------
    mechanism
        ``gravity``, ``mannitol`` or ``swelling``: what acts, alone.
    gravity_direction
        How the head lies, patient frame: decides the boundary conditions, and the load of gravity.
    fluid_level
        As a fraction of the head's extent along up. Only gravity depends on it.
    intensity
        From 0 to 1: where between k_c1 and k_c3 the drug puts the capillary permeability, or the fraction of the largest
        swelling pressure. Gravity has none.
    margin_mm
        Tissue this close to the tumour swells. Only swelling depends on it.
    """

    mechanism: str
    gravity_direction: tuple[float, float, float]
    fluid_level: float
    intensity: float = 0.0
    margin_mm: float = SWELLING_MARGIN_MM

    def __post_init__(self) -> None:
        if self.mechanism not in MECHANISMS:
            raise InputError("case", f"unknown mechanism {self.mechanism!r}", f"choose from {', '.join(MECHANISMS)}")
        if not 0.0 <= self.intensity <= 1.0:
            raise InputError("case", f"its intensity is {self.intensity}", "give a fraction, 0 to 1")

    @property
    def exchange_fraction(self) -> float:
        """Where between k_c1 and k_c3 the capillary permeability is; only mannitol raises it."""
        return self.intensity if self.mechanism == "mannitol" else 0.0


class Capillaries:
    """What capillaries do in each case: k_c and p_c of (3.2) on a system's elements.

    Mannitol draws fluid out of all tissue. Swelling gives fluid to the tissue around the tumour, and to the tumour; the
    capillaries elsewhere, at p_c = 0, take up what reaches them.
    """

    def __init__(self, system: System) -> None:
        self._system = system
        self._peritumoral: dict[float, NDArray[np.bool_]] = {}

    def exchange(self, case: Case) -> NDArray[np.float64]:
        """Capillary permeability k_c, shape (M,), 1/(Pa s)."""
        return self._system.material.exchange_at(case.exchange_fraction)

    def pressure(self, case: Case) -> NDArray[np.float64]:
        """Capillary pressure p_c, shape (M,), Pa.

        Raises
        ------
        InputError
            Swelling of a head without a tumour.
        """
        count = len(self._system.material)
        if case.mechanism == "mannitol":
            return np.full(count, MANNITOL_PRESSURE)
        if case.mechanism == "swelling":
            return np.where(self._swelling(case.margin_mm), SWELLING_PRESSURE * case.intensity, 0.0)
        return np.zeros(count)

    def _swelling(self, margin_mm: float) -> NDArray[np.bool_]:
        if margin_mm not in self._peritumoral:
            self._peritumoral[margin_mm] = peritumoral(self._system.head, margin_mm)[self._system.submesh.parent_element]
        return self._peritumoral[margin_mm]


def peritumoral(head: TetMesh, margin_mm: float = SWELLING_MARGIN_MM) -> NDArray[np.bool_]:
    """Elements (M,) of the tumour, and those whose centre is within a margin of one of its nodes.

    Raises
    ------
    InputError
        There is no tumour.
    """
    tumor = head.region == Region.TUMOR
    if not tumor.any():
        raise InputError("mesh", "it has no tumour whose surroundings could swell", "leave `swelling` out of the scene")
    nodes = head.nodes[np.unique(head.elements[tumor])]
    centres = head.nodes[head.elements].mean(axis=1)
    reach = float(mm_to_m(margin_mm))
    distance, _ = cKDTree(nodes).query(centres, distance_upper_bound=reach)
    return tumor | (distance <= reach)
