"""Gravity as a nodal load: the right side of (3.1), with buoyancy by fluid level (spec P8)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mechanics.clipping import shape_integrals_above
from brainshift_ros.mechanics.materials import FLUID_DENSITY, GRAVITY, Material


def gravity_load(
    elements: NDArray[np.int32],
    volume: NDArray[np.float64],
    material: Material,
    gravity_direction: NDArray[np.float64],
    height: NDArray[np.float64],
    fluid_density: float = FLUID_DENSITY,
) -> NDArray[np.float64]:
    """Nodal forces of the tissue's weight less its buoyancy.

    Above the fluid level tissue weighs rho_t g, since the fluid that carried it drained away; below it (rho_t - rho_f) g.
    Elements that the level cuts are integrated exactly on both sides, so the load is continuous in the level and its sum
    is the weight of the exposed volume to round-off.

    Parameters
    ----------
    elements, volume, material
        Node indices (M, 4), volume in m^3 (M,), and properties of the elements.
    gravity_direction
        Unit vector, shape (3,).
    height
        Shape (N,), signed height of each node over the fluid, m.
    fluid_density
        kg/m^3.

    Returns
    -------
    Shape (N, 3), N.
    """
    above = shape_integrals_above(height[elements], volume)
    below = volume[:, None] / 4.0 - above
    mass = material.density[:, None] * above + (material.density - fluid_density)[:, None] * below
    nodal_mass = np.bincount(elements.ravel(), weights=mass.ravel(), minlength=len(height))
    return GRAVITY * nodal_mass[:, None] * gravity_direction
