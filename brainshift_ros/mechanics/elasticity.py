"""Linear elasticity of the solid, the left side of (3.1), in scikit-fem style."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from skfem import Basis, BilinearForm, ElementTetP1
from skfem.helpers import grad

from brainshift_ros.mechanics.blocks import block_pattern
from brainshift_ros.mechanics.materials import Material
from brainshift_ros.mechanics.space import Space, skfem_mesh


def lame_parameters(
    youngs_modulus: NDArray[np.float64], poissons_ratio: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lamé's first parameter and the shear modulus, Pa, from Young's modulus and Poisson's ratio."""
    shear = youngs_modulus / (2.0 * (1.0 + poissons_ratio))
    return 2.0 * shear * poissons_ratio / (1.0 - 2.0 * poissons_ratio), shear


def elasticity_form(i: int, j: int) -> BilinearForm:
    """Weak form of small-strain elasticity between component i of the test and component j of the trial function.

    For scalar u and v it is the integral of lambda div(u e_j) div(v e_i) + 2 mu eps(u e_j) : eps(v e_i), with the
    parameters `lam` and `mu`. A vector-valued form would spend most of its time on products with zero.
    """

    @BilinearForm
    def form(u, v, w):  # type: ignore[no-untyped-def]
        du, dv = grad(u), grad(v)
        coupled = w.lam * du[j] * dv[i] + w.mu * du[i] * dv[j]
        return coupled + w.mu * _dot(du, dv) if i == j else coupled

    return form


def laplace_form() -> BilinearForm:
    """Weak form of the Laplacian, grad(u) . grad(v)."""

    @BilinearForm
    def form(u, v, _):  # type: ignore[no-untyped-def]
        return _dot(grad(u), grad(v))

    return form


def _dot(a, b):  # type: ignore[no-untyped-def]
    """Dot product of two gradients: skfem.helpers.dot, three times as fast."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def assemble_stiffness(space: Space, material: Material, frames: NDArray[np.float64] | None = None) -> sp.csr_matrix:
    """Stiffness matrix (3n, 3n) in Pa m, dof 3 i + c at node i, without boundary conditions.

    Parameters
    ----------
    space
        Displacement space, n nodes.
    material
        Properties of its elements.
    frames
        Shape (n, 3, 3), rows are the nodes' local axes: the matrix then takes and gives local components.
    """
    basis = space.scalar_basis
    lam, mu = lame_parameters(material.youngs_modulus, material.poissons_ratio)
    parameters = {"lam": at_quadrature(basis, lam), "mu": at_quadrature(basis, mu)}
    pattern = block_pattern(space.elements, len(space))
    blocks = np.empty((len(pattern.rows), 3, 3))
    for i in range(3):
        for j in range(i, 3):
            # scikit-fem orders element matrices trial function first; symmetry gives the component below the diagonal.
            local = elasticity_form(i, j).elemental(basis, **parameters).data.reshape(pattern.slot.shape)
            blocks[:, j, i] = pattern.add(local)
            if i != j:
                blocks[:, i, j] = pattern.add(local.swapaxes(0, 1))
    if frames is not None:
        turned = (frames != np.eye(3)).any(axis=(1, 2))
        chosen = np.flatnonzero(turned[pattern.rows] | turned[pattern.columns])
        rows, columns = frames[pattern.rows[chosen]], frames[pattern.columns[chosen]]
        blocks[chosen] = rows @ blocks[chosen] @ columns.swapaxes(1, 2)
    return pattern.matrix(blocks)


def at_quadrature(basis: Basis, per_element: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values of each element (M,) at its quadrature points, (M, q), as parameters of weak forms."""
    return np.broadcast_to(per_element[:, None], basis.dx.shape)


def assemble_laplacian(nodes: NDArray[np.float64], elements: NDArray[np.int32]) -> sp.csr_matrix:
    """Stiffness matrix (N, N) of the Laplacian on linear tetrahedra."""
    return sp.csr_matrix(laplace_form().assemble(Basis(skfem_mesh(nodes, elements), ElementTetP1(), intorder=1)))
