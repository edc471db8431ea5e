"""How far tissue that moved is from the rigid inner skull: true distance, not the rest position's tangent plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter

from brainshift_ros.surface.queries import closest_points, inside
from brainshift_ros.surface.surface import Surface

#: Grid of the distance field, and its blur: the skull is smooth at this scale, the mesh's facets are not.
SPACING_M = 4e-3

#: The field reaches this far beyond the surface on all sides.
MARGIN_M = 0.02


class SkullGap:
    """Penetration of moved nodes into the skull.

    The skull's distance field phi, positive outside, is sampled on a grid, blurred by one spacing, and interpolated by
    cubic splines. A node at rest at X touches the skull with the outward normal n; moved by u it penetrates by

        g(u) = n . u + [phi(X + u) - phi(X) - grad phi(X) . u],

    the tangent plane's value plus what the skull's curvature adds. So small displacements meet exactly the linear theory's
    contact, and the blur changes only the second-order part.

    Parameters
    ----------
    skull
        Closed surface of the brain at rest, outward.
    points, normals
        Shape (k, 3), m: the nodes at rest, and their outward unit normals.
    """

    def __init__(self, skull: Surface, points: NDArray[np.float64], normals: NDArray[np.float64]) -> None:
        low, high = skull.vertices.min(axis=0) - MARGIN_M, skull.vertices.max(axis=0) + MARGIN_M
        axes = [np.arange(a, b + SPACING_M, SPACING_M) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        distance = closest_points(skull, grid).distance
        signed = np.where(inside(skull, grid), -distance, distance).reshape([len(axis) for axis in axes])
        self._phi = RegularGridInterpolator(tuple(axes), gaussian_filter(signed, 1.0), method="cubic")
        self._points, self._normals = points, normals
        self._rest, self._rest_gradient = self._phi(points), self._gradient(points)

    def __call__(self, u: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Penetration (k,), m, positive in the skull, and its gradient (k, 3), for displacements u (k, 3), m."""
        moved = self._points + u
        curved = self._phi(moved) - self._rest - np.einsum("ni,ni->n", self._rest_gradient, u)
        return (
            np.einsum("ni,ni->n", self._normals, u) + curved,
            self._normals + self._gradient(moved) - self._rest_gradient,
        )

    def curvature(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Second derivatives of the penetration, shape (k, 3, 3), 1/m."""
        moved, axes = self._points + u, np.eye(3, dtype=int)
        hessian = np.empty((len(u), 3, 3))
        for i in range(3):
            for j in range(i, 3):
                hessian[:, i, j] = hessian[:, j, i] = self._phi(moved, nu=tuple(axes[i] + axes[j]))
        return hessian

    def _gradient(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([self._phi(points, nu=tuple(np.eye(3, dtype=int)[axis])) for axis in range(3)], axis=1)
