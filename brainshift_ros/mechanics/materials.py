"""Tissue properties (thesis, table 1) and their values per element."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.mesh.patient import Tissue

#: Gravitational acceleration, m/s^2.
GRAVITY = 9.81

#: Density of the cerebrospinal fluid that carries the tissue, kg/m^3.
FLUID_DENSITY = 1000.0

#: Properties of the fluid phase in white matter, table 1: the default where a material is made for the solid phase alone.
_WHITE_CONDUCTIVITY = 1e-10
_WHITE_EXCHANGE = (2.3e-9, 6.9e-9)


@dataclass(frozen=True)
class TissueProperties:
    """Properties of one tissue in (3.1) and (3.2).

    Attributes
    ----------
    youngs_modulus
        E, Pa.
    poissons_ratio
        nu.
    density
        rho_t, kg/m^3.
    conductivity
        Hydraulic conductivity k, m^3 s/kg.
    exchange
        Capillary permeability k_c without the drug and at its largest effect, table 1's k_c1 and k_c3, 1/(Pa s).
    biot
        alpha, the ratio of fluid volume squeezed out to the tissue's loss of volume.
    storage
        1/S, the fluid that enters a constant volume for each pascal, 1/Pa; 0 is an incompressible fluid.
    """

    youngs_modulus: float
    poissons_ratio: float
    density: float
    conductivity: float = _WHITE_CONDUCTIVITY
    exchange: tuple[float, float] = _WHITE_EXCHANGE
    biot: float = 1.0
    storage: float = 0.0

    def __post_init__(self) -> None:
        # Read from JSON the pair is a list, which would neither hash nor compare.
        object.__setattr__(self, "exchange", tuple(self.exchange))


#: Table 1 of the thesis. It is silent on the fluid in tumours: they take white matter's values.
TABLE_1: Mapping[Tissue, TissueProperties] = {
    Tissue.WHITE: TissueProperties(youngs_modulus=2100.0, poissons_ratio=0.45, density=1000.0),
    Tissue.GREY: TissueProperties(
        youngs_modulus=2100.0, poissons_ratio=0.45, density=1000.0, conductivity=5e-12, exchange=(11.5e-9, 34.5e-9)
    ),
    Tissue.TUMOR: TissueProperties(youngs_modulus=100_000.0, poissons_ratio=0.45, density=1000.0),
}


@dataclass(frozen=True)
class Material:
    """Properties per element: arrays of shape (M,), `exchange` (M, 2). See :class:`TissueProperties`.

    What only the fluid phase needs may be left out, or be one value for all elements; left out it is white matter's.
    """

    youngs_modulus: NDArray[np.float64]
    poissons_ratio: NDArray[np.float64]
    density: NDArray[np.float64]
    conductivity: NDArray[np.float64] = field(default_factory=lambda: np.array(_WHITE_CONDUCTIVITY))
    exchange: NDArray[np.float64] = field(default_factory=lambda: np.array(_WHITE_EXCHANGE))
    biot: NDArray[np.float64] = field(default_factory=lambda: np.array(1.0))
    storage: NDArray[np.float64] = field(default_factory=lambda: np.array(0.0))

    def __post_init__(self) -> None:
        shapes = {np.shape(self.youngs_modulus), np.shape(self.poissons_ratio), np.shape(self.density)}
        if len(shapes) != 1 or len(next(iter(shapes))) != 1:
            raise InputError("material", f"its arrays have shapes {sorted(shapes)}", "give one value per element in each")
        for name, shape in (("conductivity", ()), ("exchange", (2,)), ("biot", ()), ("storage", ())):
            self._spread(name, (len(self), *shape))
        if not np.all(self.youngs_modulus > 0.0):
            raise InputError("material", "a Young's modulus is not positive", "give stiffness in Pa, above zero")
        if not np.all((self.poissons_ratio > -1.0) & (self.poissons_ratio < 0.5)):
            raise InputError("material", "a Poisson's ratio is outside (-1, 0.5)", "give one below 0.5; 0.45 is table 1's")
        if not np.all(np.isfinite(self.density) & (self.density >= 0.0)):
            raise InputError("material", "a density is negative or not finite", "give densities in kg/m^3")
        if not np.all(np.isfinite(self.conductivity) & (self.conductivity > 0.0)):
            raise InputError("material", "a hydraulic conductivity is not positive", "give k in m^3 s/kg, above zero")
        if not np.all(np.isfinite(self.exchange) & (self.exchange >= 0.0)):
            raise InputError("material", "a capillary permeability is negative or not finite", "give k_c in 1/(Pa s)")
        if not np.all((self.biot >= 0.0) & (self.biot <= 1.0)):
            raise InputError("material", "a Biot coefficient is outside 0 to 1", "give alpha; 1 is table 1's")
        if not np.all(np.isfinite(self.storage) & (self.storage >= 0.0)):
            raise InputError("material", "a storage is negative or not finite", "give 1/S in 1/Pa; 0 is table 1's")

    def __len__(self) -> int:
        return len(self.youngs_modulus)

    def _spread(self, name: str, shape: tuple[int, ...]) -> None:
        value = np.asarray(getattr(self, name), dtype=np.float64)
        try:
            object.__setattr__(self, name, np.broadcast_to(value, shape))
        except ValueError as error:
            problem = f"its {name} has shape {value.shape}, not {shape}"
            raise InputError("material", problem, "give one value per element") from error

    def select(self, elements: NDArray) -> Material:
        """Properties of some elements, by mask or ids."""
        return Material(**{each.name: getattr(self, each.name)[elements] for each in fields(self)})

    def exchange_at(self, fraction: float) -> NDArray[np.float64]:
        """Capillary permeability (M,) at a fraction of the drug's effect: k_c1 at 0, k_c3 at 1; 1/(Pa s)."""
        lowest, highest = self.exchange.T
        return lowest + fraction * (highest - lowest)


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
    return Material(**{each.name: np.array([getattr(row, each.name) for row in rows])[index] for each in fields(Material)})
