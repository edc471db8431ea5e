"""The fluid phase of biphasic consolidation, equation (3.2): linear pressure, its masses and its coupling to the solid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from skfem import Basis, BilinearForm, ElementTetP0, ElementTetP1
from skfem.helpers import div, dot, grad

from brainshift_ros.mechanics.materials import Material
from brainshift_ros.mesh.tetmesh import tetrahedron_volumes


def darcy_form() -> BilinearForm:
    """Weak form of Darcy flow, k grad(p) . grad(q), parameter `k`."""

    @BilinearForm
    def form(p, q, w):  # type: ignore[no-untyped-def]
        return w.k * dot(grad(p), grad(q))

    return form


def coupling_form() -> BilinearForm:
    """Weak form of the coupling, alpha p div(v), trial function p and test function v, parameter `alpha`."""

    @BilinearForm
    def form(p, v, w):  # type: ignore[no-untyped-def]
        return w.alpha * p * div(v)

    return form


@dataclass(frozen=True)
class Fluid:
    """Linear pressure on the vertices of a mesh, in Pa: N vertices, M elements.

    The terms without derivatives in space, k_c p and (1/S) dp/dt, have lumped masses. With consistent ones the pressure
    would overshoot beside a drained surface wherever sqrt(k / k_c) is shorter than an element.

    Attributes
    ----------
    displacement
        Vector basis of the displacement, linear or quadratic, dof 3 i + c for component c at node i, n nodes.
    material
        Properties of the elements.
    """

    displacement: Basis
    material: Material

    def __len__(self) -> int:
        return self.displacement.mesh.nvertices

    @property
    def elements(self) -> NDArray[np.integer]:
        """Vertices of each element, shape (M, 4)."""
        return self.displacement.mesh.t.T

    @cached_property
    def volume(self) -> NDArray[np.float64]:
        """Volume of each element, m^3, shape (M,)."""
        return tetrahedron_volumes(self.displacement.mesh.p.T, self.elements)

    @cached_property
    def conductance(self) -> sp.csr_matrix:
        """The integral of k grad p . grad q, shape (N, N), m^4 s/kg."""
        basis = Basis(self.displacement.mesh, ElementTetP1(), intorder=1)
        conductivity = basis.with_element(ElementTetP0()).interpolate(self.material.conductivity)
        return sp.csr_matrix(darcy_form().assemble(basis, k=conductivity))

    @cached_property
    def coupling(self) -> sp.csr_matrix:
        """Q of shape (3n, N), m^2: ``Q @ p`` is the integral of alpha p div v, a nodal force in N, patient components.

        Its transpose gives the fluid alpha div u, in m^3, that a displacement draws into each vertex's share.
        """
        pressure = self.displacement.with_element(ElementTetP1())
        biot = self.displacement.with_element(ElementTetP0()).interpolate(self.material.biot)
        return sp.csr_matrix(coupling_form().assemble(pressure, self.displacement, alpha=biot))

    def lumped(self, per_element: NDArray[np.float64]) -> NDArray[np.float64]:
        """Diagonal (N,) of the lumped mass matrix weighted by a value per element: a quarter of it goes to each vertex."""
        share = np.repeat(per_element * self.volume / 4.0, 4)
        return np.bincount(self.elements.ravel(), weights=share, minlength=len(self)).astype(np.float64, copy=False)

    def helmholtz(self, exchange: NDArray[np.float64]) -> sp.csr_matrix:
        """Steady (3.2), k grad p . grad q + k_c p q, shape (N, N), for a capillary permeability (M,) in 1/(Pa s)."""
        return (self.conductance + sp.diags_array(self.lumped(exchange))).tocsr()

    def source(self, exchange: NDArray[np.float64], capillary_pressure: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fluid that the capillaries would give at p = 0, k_c p_c q: shape (N,), m^3/s, from per-element values (M,)."""
        return self.lumped(exchange * capillary_pressure)


def fluid_of(displacement: Basis, material: Material) -> Fluid:
    """Linear pressure on the vertices of a displacement basis, such as :attr:`~.space.Space.basis`.

    Parameters
    ----------
    displacement
        Vector basis on linear or quadratic tetrahedra.
    material
        Properties of its elements.
    """
    return Fluid(displacement, material)
