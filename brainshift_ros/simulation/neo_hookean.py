"""A compressible neo-Hookean solid at finite strain, with growth: stress and tangent from one energy.

The energy is Ciarlet's polyconvex one (Mathematical Elasticity I, 1988, section 4.10),

    Psi(F) = mu / 2 (tr(F^T F) - 3 - 2 ln J) + lambda / 4 (J^2 - 1 - 2 ln J),   J = det F,

which agrees with small-strain elasticity at F = I, and grows without bound as J goes to 0 or to infinity. The common
lambda / 2 (ln J)^2 softens beyond J = e, which a Newton iteration may visit.

Growth or shrinking multiplies the deformation, F = F_e F_g (Rodriguez, Hoger, McCulloch 1994), here isotropically: tissue
that is free to do so takes g times its volume without stress, F_g = g^(1/3) I, and the energy per volume at rest is g Psi(F_e).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def energy(F: Array, lam: Array, mu: Array, growth: Array) -> Array:
    """Energy per reference volume, Pa.

    Parameters
    ----------
    F
        Shape (..., 3, 3), deformation gradients, det F > 0.
    lam, mu
        Lamé's first parameter and the shear modulus, Pa; these and `growth` broadcast against the leading axes of F.
    growth
        Ratio g of stress-free to reference volume.

    Returns
    -------
    Shape (...).
    """
    Fe = F / np.cbrt(growth)[..., None, None]
    J = np.linalg.det(Fe)
    shear = 0.5 * mu * (np.einsum("...iJ,...iJ->...", Fe, Fe) - 3.0 - 2.0 * np.log(J))
    return growth * (shear + 0.25 * lam * (J**2 - 1.0 - 2.0 * np.log(J)))


def first_piola(F: Array, lam: Array, mu: Array, growth: Array) -> Array:
    """First Piola-Kirchhoff stress dPsi/dF, shape (..., 3, 3), Pa; parameters as in :func:`energy`."""
    s = np.cbrt(growth)
    Fe = F / s[..., None, None]
    J = np.linalg.det(Fe)
    inverse_T = np.swapaxes(np.linalg.inv(Fe), -1, -2)
    pressure = 0.5 * lam * (J**2 - 1.0) - mu
    return s[..., None, None] ** 2 * (mu[..., None, None] * Fe + pressure[..., None, None] * inverse_T)


def tangent(F: Array, lam: Array, mu: Array, growth: Array) -> Array:
    """Second derivative of the energy, ``A[..., i, J, k, L] = dP_iJ / dF_kL``, Pa; parameters as in :func:`energy`.

    With G = F_e^-T: A_iJkL = g^(1/3) (mu d_ik d_JL + (mu - lambda/2 (J^2 - 1)) G_iL G_kJ + lambda J^2 G_iJ G_kL).
    """
    s = np.cbrt(growth)
    Fe = F / s[..., None, None]
    J = np.linalg.det(Fe)
    G = np.swapaxes(np.linalg.inv(Fe), -1, -2)
    turned = s * (mu - 0.5 * lam * (J**2 - 1.0))
    A = (s * lam * J**2)[..., None, None, None, None] * (G[..., :, :, None, None] * G[..., None, None, :, :])
    A += turned[..., None, None, None, None] * np.einsum("...iL,...kJ->...iJkL", G, G)
    identity = np.einsum("ik,JL->iJkL", np.eye(3), np.eye(3))
    return A + (s * mu)[..., None, None, None, None] * identity
