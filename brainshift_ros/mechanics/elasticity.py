"""Linear elasticity of the solid, the left side of (3.1), in scikit-fem style."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from skfem import Basis, BilinearForm, ElementTetP0, ElementTetP1, ElementVector, MeshTet
from skfem.helpers import ddot, div, grad, sym_grad

from brainshift_ros.mechanics.materials import Material
from brainshift_ros.mesh.tetmesh import TetMesh

#: Gradients of linear shape functions and properties are constant in an element: one quadrature point is exact.
GRADIENT_ORDER = 1


def lame_parameters(
    youngs_modulus: NDArray[np.float64], poissons_ratio: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lamé's first parameter and the shear modulus, Pa, from Young's modulus and Poisson's ratio."""
    shear = youngs_modulus / (2.0 * (1.0 + poissons_ratio))
    return 2.0 * shear * poissons_ratio / (1.0 - 2.0 * poissons_ratio), shear


def elasticity_form() -> BilinearForm:
    """Weak form of small-strain elasticity: lambda div(u) div(v) + 2 mu eps(u) : eps(v), parameters `lam` and `mu`."""

    @BilinearForm
    def form(u, v, w):  # type: ignore[no-untyped-def]
        return w.lam * div(u) * div(v) + 2.0 * w.mu * ddot(sym_grad(u), sym_grad(v))

    return form


def laplace_form() -> BilinearForm:
    """Weak form of the Laplacian, grad(u) . grad(v)."""

    @BilinearForm
    def form(u, v, _):  # type: ignore[no-untyped-def]
        return sum(grad(u)[i] * grad(v)[i] for i in range(3))

    return form


def _skfem_mesh(nodes: NDArray[np.float64], elements: NDArray[np.int32]) -> MeshTet:
    return MeshTet(np.ascontiguousarray(nodes.T), np.ascontiguousarray(elements.T, dtype=np.int64))


def vector_basis(mesh: TetMesh) -> Basis:
    """Linear displacement basis; dof 3 i + c is component c at node i."""
    return Basis(_skfem_mesh(mesh.nodes, mesh.elements), ElementVector(ElementTetP1()), intorder=GRADIENT_ORDER)


def assemble_stiffness(mesh: TetMesh, material: Material) -> sp.csr_matrix:
    """Stiffness matrix (3N, 3N) in Pa m, dof 3 i + c at node i, without boundary conditions."""
    basis = vector_basis(mesh)
    per_element = basis.with_element(ElementTetP0())
    lam, mu = lame_parameters(material.youngs_modulus, material.poissons_ratio)
    stiffness = elasticity_form().assemble(basis, lam=per_element.interpolate(lam), mu=per_element.interpolate(mu))
    return sp.csr_matrix(stiffness)


def assemble_laplacian(nodes: NDArray[np.float64], elements: NDArray[np.int32]) -> sp.csr_matrix:
    """Stiffness matrix (N, N) of the Laplacian on linear tetrahedra."""
    basis = Basis(_skfem_mesh(nodes, elements), ElementTetP1(), intorder=GRADIENT_ORDER)
    return sp.csr_matrix(laplace_form().assemble(basis))
