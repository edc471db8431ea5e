r"""A term that keeps the pressure of consolidation from oscillating, whatever the time step and the permeability.

Just after a load is applied, or where hardly any fluid flows, (3.2) only says that the solid keeps its volume. A linear
pressure then oscillates beside drained surfaces and jumps of the permeability, with linear and with quadratic displacement
alike. Rodrigo, Gaspar, Hu and Zikatanov (Comput. Methods Appl. Mech. Eng. 298, 2016) add, to the rate of the fluid content,
h^2 / (c (lambda + 2 mu)) grad(dp/dt) . grad q, a Brezzi-Pitkaranta term, and prove that it makes the pressure monotone in
one dimension for c = 4 with linear and c = 6 with quadratic displacement.

On an interval that term is the difference of two mass matrices: the lumped one, and the one that the elements' own
displacement can produce, of pressures projected to the divergences: constants (linear) or all linear functions (quadratic).
This difference is what is used on tetrahedra too:

.. math:: \frac{\alpha^2}{\lambda + 2 \mu} \frac{V}{4} \left(I - \tfrac{1}{4} 1 1^T\right)

for each linear element of volume V, and 4/5 of it for quadratic ones. It vanishes for constant pressures, and needs no length
h, which flat and long tetrahedra do not have. Its entries off the diagonal are negative for elements of any shape, as a
maximum principle needs; those of grad p . grad q are not where an angle between faces is obtuse. With the longest edge as h
that classical term does as well in columns and balls of linear elements, but smears the pressure of a real brain more.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from brainshift_ros.mechanics.elasticity import lame_parameters
from brainshift_ros.mechanics.fluid import Fluid

#: Multiples of the difference of masses. In one dimension 1 is enough; on tetrahedra the divergences of neighbours are not
#: independent, and a little more is needed. Measured by `brainshift experiment consolidation`.
SAFETY = {1: 1.5, 2: 1.25}

#: Difference between the lumped mass and that of projected pressures, as a multiple of V / 4 (I - 1 1^T / 4).
_DIFFERENCE = {1: 1.0, 2: 0.8}


def stabilization(fluid: Fluid, safety: float | None = None) -> sp.csr_matrix:
    """Matrix (N, N), m^3/Pa, that joins the storage 1/S in the rate of the fluid content.

    It has no effect on steady pressures. The error that it adds to others is of second order in the elements' size, as that of
    a linear pressure itself.

    Parameters
    ----------
    fluid
        Pressure and the displacement it goes with.
    safety
        Multiple of the difference of masses; None takes :data:`SAFETY`, 0 leaves the pressure unstabilised.
    """
    material, order = fluid.material, fluid.displacement.elem.elem.maxdeg
    first, shear = lame_parameters(material.youngs_modulus, material.poissons_ratio)
    multiple = (SAFETY[order] if safety is None else safety) * _DIFFERENCE[order]
    weight = multiple * material.biot**2 / (first + 2.0 * shear) * fluid.volume / 4.0
    elements, count = fluid.elements, len(fluid)
    local = weight[:, None, None] * (np.eye(4) - 0.25)
    rows, columns = np.repeat(elements, 4, axis=1), np.tile(elements, (1, 4))
    return sp.coo_matrix((local.ravel(), (rows.ravel(), columns.ravel())), shape=(count, count)).tocsr()
