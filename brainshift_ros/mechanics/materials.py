"""Tissue properties (thesis, table 1) and their values per element."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.mesh.patient import Tissue

#: Gravitational acceleration, m/s^2.
GRAVITY = 9.81

#: Density of the cerebrospinal fluid that carries the tissue, kg/m^3.
FLUID_DENSITY = 1000.0


@dataclass(frozen=True)
class TissueProperties:
    """Properties of one tissue: Young's modulus in Pa, Poisson's ratio, density in kg/m^3."""

    youngs_modulus: float
    poissons_ratio: float
    density: float


#: Table 1 of the thesis.
TABLE_1: Mapping[Tissue, TissueProperties] = {
    Tissue.WHITE: TissueProperties(youngs_modulus=2100.0, poissons_ratio=0.45, density=1000.0),
    Tissue.GREY: TissueProperties(youngs_modulus=2100.0, poissons_ratio=0.45, density=1000.0),
    Tissue.TUMOR: TissueProperties(youngs_modulus=100_000.0, poissons_ratio=0.45, density=1000.0),
}


@dataclass(frozen=True)
class Material:
    """Properties per element, each of shape (M,): Young's modulus in Pa, Poisson's ratio, density in kg/m^3."""

    youngs_modulus: NDArray[np.float64]
    poissons_ratio: NDArray[np.float64]
    density: NDArray[np.float64]

    def __post_init__(self) -> None:
        shapes = {np.shape(self.youngs_modulus), np.shape(self.poissons_ratio), np.shape(self.density)}
        if len(shapes) != 1 or len(next(iter(shapes))) != 1:
            raise InputError("material", f"its arrays have shapes {sorted(shapes)}", "give one value per element in each")
        if not np.all(self.youngs_modulus > 0.0):
            raise InputError("material", "a Young's modulus is not positive", "give stiffness in Pa, above zero")
        if not np.all((self.poissons_ratio > -1.0) & (self.poissons_ratio < 0.5)):
            raise InputError("material", "a Poisson's ratio is outside (-1, 0.5)", "give one below 0.5; 0.45 is table 1's")
        if not np.all(np.isfinite(self.density) & (self.density >= 0.0)):
            raise InputError("material", "a density is negative or not finite", "give densities in kg/m^3")

    def __len__(self) -> int:
        return len(self.youngs_modulus)

    def select(self, elements: NDArray) -> Material:
        """Properties of some elements, by mask or ids."""
        return Material(self.youngs_modulus[elements], self.poissons_ratio[elements], self.density[elements])


def material_of(tissue: NDArray[np.uint8], properties: Mapping[Tissue, TissueProperties] = TABLE_1) -> Material:
    """Spread tissue properties over elements.

    Parameters
    ----------
    tissue
        Shape (M,), :class:`~brainshift_ros.mesh.patient.Tissue` of each element.
    properties
        Properties of each tissue.

    Raises
    ------
    InputError
        An element has a tissue without properties.
    """
    classes, index = np.unique(np.asarray(tissue), return_inverse=True)
    known = {int(key): value for key, value in properties.items()}
    unknown = [int(c) for c in classes if int(c) not in known]
    if unknown:
        raise InputError("tissue", f"elements carry unknown tissue classes {unknown}", f"use the classes {sorted(known)}")
    rows = [known[int(c)] for c in classes]
    return Material(
        youngs_modulus=np.array([r.youngs_modulus for r in rows])[index],
        poissons_ratio=np.array([r.poissons_ratio for r in rows])[index],
        density=np.array([r.density for r in rows])[index],
    )
