"""Continue a displacement field into resected tissue, so that it is defined and continuous on the whole mesh."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.mechanics.elasticity import assemble_laplacian
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.solvers.direct import SolverName, factorize

Extend = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def harmonic_extension(mesh: TetMesh, known: NDArray[np.bool_], solver: SolverName = "auto") -> Extend:
    """Prepare the extension from known nodes to all others.

    Each component solves Laplace's equation in the elements that have an unknown node, with the values at the known nodes
    as Dirichlet data and no flux through the rest of their boundary. No tissue is there any more: the values only carry
    the cavity wall's motion smoothly across, for interpolation and for warping images.

    Parameters
    ----------
    mesh
        The whole mesh, N nodes.
    known
        Shape (N,), nodes whose displacement the model gives; every connected gap must touch one.

    Returns
    -------
    A function from displacements (N, k), arbitrary at unknown nodes, to the extended (N, k).
    """
    unknown = np.flatnonzero(~known)
    if len(unknown) == 0:
        return lambda values: values
    gap = mesh.elements[(~known)[mesh.elements].any(axis=1)]
    local_nodes, local_gap = np.unique(gap, return_inverse=True)
    laplacian = assemble_laplacian(mesh.nodes[local_nodes], local_gap.reshape(-1, 4).astype(np.int32))
    inner, wall = np.flatnonzero(~known[local_nodes]), np.flatnonzero(known[local_nodes])
    factorization = factorize(laplacian[inner][:, inner].tocsr(), solver)
    coupling = laplacian[inner][:, wall].tocsr()

    def extend(values: NDArray[np.float64]) -> NDArray[np.float64]:
        extended = values.copy()
        extended[local_nodes[inner]] = -factorization.solve(coupling @ values[local_nodes[wall]])
        return extended

    return extend
