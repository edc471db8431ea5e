"""Analytic solutions of consolidation: Terzaghi's column and Cryer's sphere, for any alpha and 1/S."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class PorousMedium:
    """One homogeneous material of (3.1) and (3.2), without capillaries.

    Attributes
    ----------
    youngs_modulus, poissons_ratio
        E in Pa, nu, of the drained solid.
    conductivity
        k, m^3 s/kg.
    biot
        alpha.
    storage
        1/S, 1/Pa.
    """

    youngs_modulus: float
    poissons_ratio: float
    conductivity: float
    biot: float = 1.0
    storage: float = 0.0

    @property
    def shear_modulus(self) -> float:
        """G, Pa."""
        return self.youngs_modulus / (2.0 * (1.0 + self.poissons_ratio))

    @property
    def bulk_modulus(self) -> float:
        """K of the drained solid, Pa."""
        return self.youngs_modulus / (3.0 * (1.0 - 2.0 * self.poissons_ratio))

    @property
    def confined_modulus(self) -> float:
        """Oedometric modulus lambda + 2 mu = K + 4 G / 3, Pa."""
        return self.bulk_modulus + 4.0 * self.shear_modulus / 3.0

    @property
    def consolidation(self) -> float:
        """Coefficient of consolidation k / (alpha^2 / (lambda + 2 mu) + 1/S), m^2/s."""
        return self.conductivity / (self.biot**2 / self.confined_modulus + self.storage)


@dataclass(frozen=True)
class TerzaghiColumn:
    """A column on a rigid, sealed base, in a rigid sealed tube; its drained top carries a pressure from t = 0 on.

    Terzaghi (1923); Verruijt, *Theory and Problems of Poroelasticity* (2013), chapter 2.

    Attributes
    ----------
    medium
        The material.
    height
        H, m.
    load
        Pressure on the top, Pa.
    terms
        Of the series. It converges as exp(-(pi j / 2)^2 c t / H^2): 200 serve down to c t = 1e-4 H^2.
    """

    medium: PorousMedium
    height: float
    load: float
    terms: int = 200

    @property
    def undrained_pressure(self) -> float:
        """Pressure everywhere at t = 0+, Pa."""
        medium = self.medium
        return self.load * medium.biot / (medium.biot**2 + medium.storage * medium.confined_modulus)

    def pressure(self, z: ArrayLike, time_s: float) -> NDArray[np.float64]:
        """Pressure at heights z over the base, Pa, at a time above zero."""
        order, decay = self._modes(time_s)
        waves = np.cos(order * np.pi / 2.0 * np.asarray(z, dtype=np.float64)[..., None] / self.height)
        sign = np.where(order % 4 == 1, 1.0, -1.0)
        return self.undrained_pressure * (waves * sign * decay * 4.0 / (np.pi * order)).sum(axis=-1)

    def settlement(self, time_s: float) -> float:
        """How far the top has sunk, m."""
        order, decay = self._modes(time_s)
        mean_pressure = self.undrained_pressure * float((decay * 8.0 / (np.pi * order) ** 2).sum())
        return self.height * (self.load - self.medium.biot * mean_pressure) / self.medium.confined_modulus

    def _modes(self, time_s: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        order = 2 * np.arange(self.terms) + 1
        return order, np.exp(-((order * np.pi / 2.0) ** 2) * self.medium.consolidation * time_s / self.height**2)


@dataclass(frozen=True)
class CryerSphere:
    """A ball whose drained surface carries a pressure from t = 0 on.

    The pressure at the centre rises above its first value before it falls (the Mandel-Cryer effect): the drained shell
    shrinks and squeezes the core. Cryer (1963); Verruijt (2013), section 3.2; here with all radii. The Laplace transform of
    the pressure is P (1 - sinh(x r / a) / ((r / a) sinh x)) with x^2 = s a^2 / c; its poles x = i xi are the roots of
    eta xi^2 + 2 (xi cot xi - 1) = 0, one in each interval (j pi, (j + 1) pi), and the residues there make the series.

    Attributes
    ----------
    medium
        The material.
    radius
        a, m.
    load
        Pressure on the surface, Pa.
    terms
        Of the series.
    """

    medium: PorousMedium
    radius: float
    load: float
    terms: int = 200

    @property
    def undrained_pressure(self) -> float:
        """Pressure everywhere at t = 0+, Pa."""
        medium = self.medium
        return self.load * medium.biot / (medium.biot**2 + medium.storage * medium.bulk_modulus)

    @property
    def eta(self) -> float:
        """Verruijt's parameter (lambda + 2 mu) / (2 G) (1 + K / (S alpha^2)); (1 - nu) / (1 - 2 nu) at 1/S = 0."""
        medium = self.medium
        stored = 1.0 + medium.storage * medium.bulk_modulus / medium.biot**2
        return stored * medium.confined_modulus / (2.0 * medium.shear_modulus)

    def roots(self) -> NDArray[np.float64]:
        """Find the first roots xi, by bisection to round-off."""
        high = np.pi * np.arange(1, self.terms + 1)
        # The function has no poles and alternates in sign at multiples of pi; near its triple root at 0 it is positive.
        low = np.maximum(high - np.pi, 0.1)
        for _ in range(100):
            middle = 0.5 * (low + high)
            same = np.sign(self._characteristic(middle)) == np.sign(self._characteristic(low))
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        return 0.5 * (low + high)

    def pressure(self, r: ArrayLike, time_s: float) -> NDArray[np.float64]:
        """Pressure at radii r, Pa, at a time above zero."""
        medium, xi = self.medium, self.roots()
        ratio = np.asarray(r, dtype=np.float64)[..., None] / self.radius
        # sin(xi rho) / rho, whose limit at the centre is xi.
        shape = 1.0 - xi * np.sinc(xi * ratio / np.pi) / np.sin(xi)
        slope = -1.0 / (xi * np.sin(xi) ** 2) - 1.0 / (xi**2 * np.tan(xi)) + 2.0 / xi**3
        residue = self.load * medium.confined_modulus / (2.0 * medium.shear_modulus * medium.biot * xi * slope)
        decay = np.exp(-(xi**2) * medium.consolidation * time_s / self.radius**2)
        return (shape * residue * decay).sum(axis=-1)

    def _characteristic(self, xi: NDArray[np.float64]) -> NDArray[np.float64]:
        return (self.eta * xi**2 - 2.0) * np.sin(xi) + 2.0 * xi * np.cos(xi)
