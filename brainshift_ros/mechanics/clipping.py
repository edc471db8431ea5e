"""Integrals of linear shape functions over the part of each tetrahedron above a plane, exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: The part above a plane as tetrahedra, by how many of the corners (a, b, c, d), sorted from high to low, are above it.
#: A pair of corners stands for the point where the plane cuts their edge. Two corners above leave a prism: three tetrahedra.
_PIECES: dict[int, tuple[tuple[str, ...], ...]] = {
    1: (("a", "ab", "ac", "ad"),),
    2: (("a", "ac", "ad", "bd"), ("a", "ac", "bc", "bd"), ("a", "b", "bc", "bd")),
    3: (("a", "b", "c", "ad"), ("b", "c", "ad", "bd"), ("c", "ad", "bd", "cd")),
}


def shape_integrals_above(height: NDArray[np.float64], volume: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integrate each element's four linear shape functions over its part with positive height.

    The part above the plane is cut into tetrahedra; on each the mean of a shape function is the mean of its corner values,
    so the result is exact, and the four integrals add up to the volume above the plane.

    Parameters
    ----------
    height
        Shape (M, 4), signed height of each corner over the plane, m.
    volume
        Shape (M,), volume of each element, m^3.

    Returns
    -------
    Shape (M, 4), m^3, in the order of the corners.
    """
    above = (height > 0.0).sum(axis=1)
    integrals = np.where(above == 4, volume / 4.0, 0.0)[:, None].repeat(4, axis=1)
    for count, pieces in _PIECES.items():
        chosen = np.flatnonzero(above == count)
        order = np.argsort(-height[chosen], axis=1)
        h = np.take_along_axis(height[chosen], order, axis=1)
        part = np.zeros((len(chosen), 4))
        for piece in pieces:
            corners = np.stack([_barycentric(label, h) for label in piece], axis=1)
            fraction = np.abs(np.linalg.det(corners))
            part += (fraction * volume[chosen])[:, None] * corners.mean(axis=1)
        integrals[chosen[:, None], order] = part
    return integrals


def _barycentric(label: str, height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Barycentric coordinates (n, 4) of a corner ("a") or of the cut through an edge ("ad")."""
    coordinates = np.zeros_like(height)
    first, last = "abcd".index(label[0]), "abcd".index(label[-1])
    if first == last:
        coordinates[:, first] = 1.0
    else:
        share = height[:, first] / (height[:, first] - height[:, last])
        coordinates[:, first] = 1.0 - share
        coordinates[:, last] = share
    return coordinates
