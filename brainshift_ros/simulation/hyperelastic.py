"""Internal forces and tangent stiffness of a neo-Hookean body on tetrahedra, total Lagrangian."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from skfem import Basis

from brainshift_ros.mechanics.blocks import block_pattern
from brainshift_ros.mechanics.elasticity import lame_parameters
from brainshift_ros.mechanics.materials import Material
from brainshift_ros.simulation import neo_hookean

#: Exact for the linear limit on quadratic tetrahedra, four points each; more change a sag of 12 mm by nothing that matters.
QUADRATURE_ORDER = 2

#: Elements whose tangents are held at once: about 100 MB.
_CHUNK = 8192


class HyperelasticBody:
    """Forces and stiffness as functions of the nodes' displacement.

    scikit-fem gives quadrature, shape gradients and numbering; the contraction with the tangent is one batched product here,
    because its form would be called for each of the 900 pairs of local dofs of a quadratic element.

    Parameters
    ----------
    basis
        Vector-valued displacement basis on linear or quadratic tetrahedra; dof 3 i + c is component c at node i.
    material
        Elastic properties of the M elements.
    growth
        Shape (M,), ratio of stress-free to reference volume of each element.
    """

    def __init__(self, basis: Basis, material: Material, growth: NDArray[np.float64]) -> None:
        own = Basis(basis.mesh, basis.elem, intorder=QUADRATURE_ORDER)
        self.node_count = own.N // 3
        self._nodes = own.element_dofs[::3].T // 3
        gradients = [own.basis[3 * a][0].grad[0] for a in range(self._nodes.shape[1])]
        self._gradients = np.ascontiguousarray(np.stack(gradients).transpose(2, 3, 0, 1))  # (M, q, a, J)
        self._weights = own.dx
        lam, mu = lame_parameters(material.youngs_modulus, material.poissons_ratio)
        self._law = tuple(np.repeat(value[:, None], own.dx.shape[1], axis=1) for value in (lam, mu, growth))
        self._pattern = block_pattern(self._nodes, self.node_count)

    def deformation_gradients(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """F = I + Grad u at the quadrature points, shape (M, q, 3, 3), for displacements u (n, 3)."""
        return np.eye(3) + np.einsum("mai,mqaJ->mqiJ", u[self._nodes], self._gradients, optimize=True)

    def smallest_jacobian(self, u: NDArray[np.float64]) -> float:
        """Smallest det F at the quadrature points."""
        return float(np.linalg.det(self.deformation_gradients(u)).min())

    def energy(self, u: NDArray[np.float64]) -> float:
        """Sum of the stored energy, J."""
        return float(np.sum(self._weights * neo_hookean.energy(self.deformation_gradients(u), *self._law)))

    def internal_force(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Gradient of the energy with respect to u, shape (n, 3), N."""
        P = neo_hookean.first_piola(self.deformation_gradients(u), *self._law)
        local = np.einsum("mq,mqiJ,mqaJ->mai", self._weights, P, self._gradients, optimize=True)
        index = self._nodes.ravel()
        columns = [np.bincount(index, weights=local[:, :, c].ravel(), minlength=self.node_count) for c in range(3)]
        return np.stack(columns, axis=1)

    def tangent(self, u: NDArray[np.float64], frames: NDArray[np.float64]) -> sp.csr_matrix:
        """Hessian of the energy in local components, sparse (3n, 3n), N/m.

        Parameters
        ----------
        u
            Shape (n, 3), m.
        frames
            Shape (n, 3, 3), rows are each node's local axes.
        """
        F = self.deformation_gradients(u)
        pairs = np.empty((9, *self._pattern.slot.shape))
        for start in range(0, len(F), _CHUNK):
            part = slice(start, start + _CHUNK)
            pairs[..., part] = self._element_blocks(F[part], self._gradients[part], self._weights[part], part)
        blocks = np.stack([self._pattern.add(entry) for entry in pairs], axis=1).reshape(-1, 3, 3)
        rows, columns = self._pattern.rows, self._pattern.columns
        return self._pattern.matrix(frames[rows] @ blocks @ np.swapaxes(frames[columns], 1, 2))

    def _element_blocks(
        self, F: NDArray[np.float64], gradients: NDArray[np.float64], weights: NDArray[np.float64], part: slice
    ) -> NDArray[np.float64]:
        """Stiffness of some elements as 3x3 blocks of node pairs, (9, a, b, m): sum_q w dN_a/dX_J A_iJkL dN_b/dX_L."""
        m, q, a, _ = gradients.shape
        A = neo_hookean.tangent(F, *(value[part] for value in self._law)) * weights[:, :, None, None, None, None]
        left = np.matmul(gradients, A.transpose(0, 1, 3, 2, 4, 5).reshape(m, q, 3, 27))  # (m, q, a, ikL)
        left = left.reshape(m, q, a * 9, 3).transpose(0, 2, 1, 3).reshape(m, a * 9, q * 3)
        right = gradients.transpose(0, 1, 3, 2).reshape(m, q * 3, a)
        return np.matmul(left, right).reshape(m, a, 9, a).transpose(2, 1, 3, 0)
