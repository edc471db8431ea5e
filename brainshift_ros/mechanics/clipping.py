"""Integrals of shape functions over the part of each tetrahedron above a plane, exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skfem.refdom import RefTet

#: Vertices at the ends of the mid-edge nodes of a quadratic tetrahedron.
_FIRST, _SECOND = np.array(RefTet.edges).T

#: Column of the mid-edge node between two vertices.
_MIDDLE = np.zeros((4, 4), dtype=int)
_MIDDLE[_FIRST, _SECOND] = _MIDDLE[_SECOND, _FIRST] = range(4, 10)

#: The part above a plane as tetrahedra, by how many of the corners (a, b, c, d) are above it; those that are come first.
#: A pair of corners stands for the point where the plane cuts their edge. Two corners above leave a prism: three tetrahedra.
#: Three above are the whole less the tetrahedron around the fourth.
_PIECES: dict[int, tuple[tuple[str, ...], ...]] = {
    1: (("a", "ab", "ac", "ad"),),
    2: (("a", "ac", "ad", "bd"), ("a", "ac", "bc", "bd"), ("a", "b", "bc", "bd")),
}

#: Volume of each piece over the element's, the determinant of its corners' barycentric coordinates: a product of the places
#: where the plane cuts the edges. "ad" is the cut's distance from a, as a share of the edge; "-ad" is that from d.
_VOLUMES: dict[int, tuple[tuple[str, ...], ...]] = {
    1: (("ab", "ac", "ad"),),
    2: (("ac", "ad", "-bd"), ("ac", "-bc", "bd"), ("bc", "bd")),
}


def whole_integrals(volume: NDArray[np.float64], order: int) -> NDArray[np.float64]:
    """Integrals of the shape functions over whole elements, (M, 4) or, for order 2, (M, 10), m^3."""
    shares = np.full(4, 0.25) if order == 1 else np.repeat([-0.05, 0.2], [4, 6])
    return volume[:, None] * shares


def integrals_above(height: NDArray[np.float64], volume: NDArray[np.float64], order: int = 1) -> NDArray[np.float64]:
    """Integrate each element's shape functions over its part with positive height.

    The part above the plane is cut into tetrahedra. On each the mean of a linear shape function is the mean of its corner
    values, and that of a product of two follows from the same values, so the result is exact for both orders; the
    integrals add up to the volume above the plane.

    Parameters
    ----------
    height
        Shape (M, 4), signed height of each corner over the plane, m.
    volume
        Shape (M,), volume of each element, m^3.
    order
        1, or 2 for quadratic shape functions.

    Returns
    -------
    Shape (M, 4) in the order of the corners, or (M, 10) with scikit-fem's mid-edges after them, m^3.
    """
    above = height > 0.0
    pattern = above @ np.array([1, 2, 4, 8])
    integrals = whole_integrals(np.where(above.sum(axis=1) >= 3, volume, 0.0), order)
    for code in range(1, 15):
        chosen = np.flatnonzero(pattern == code)
        high = [corner for corner in range(4) if code >> corner & 1]
        low = [corner for corner in range(4) if corner not in high]
        sign, corners = (-1.0, low + high) if len(high) == 3 else (1.0, high + low)
        parts = _of_pieces(sign * height[chosen][:, corners].T, volume[chosen], min(len(high), len(low)), order)
        columns = corners if order == 1 else corners + [_MIDDLE[corners[i], corners[j]] for i, j in RefTet.edges]
        integrals[chosen[:, None], columns] += sign * parts.T
    return integrals


def _of_pieces(height: NDArray[np.float64], volume: NDArray[np.float64], count: int, order: int) -> NDArray[np.float64]:
    """Integrals (4 or 10, m) over the positive part of elements whose first `count` corners, 1 or 2, are on that side.

    `height` has shape (4, m): the corners come first, since all arithmetic is along the elements.
    """
    cuts = {}
    for pair in {corner for piece in _PIECES[count] for corner in piece if len(corner) == 2}:
        near, far = height["abcd".index(pair[0])], height["abcd".index(pair[1])]
        cuts[pair] = near / (near - far)
    integrals = np.zeros((4 if order == 1 else 10, len(volume)))
    for piece, factors in zip(_PIECES[count], _VOLUMES[count], strict=True):
        part = volume.copy()
        for factor in factors:
            part *= 1.0 - cuts[factor[1:]] if factor[0] == "-" else cuts[factor]
        coordinates = np.zeros((4, 4, len(volume)))  # of each corner of the piece in the element
        for corner, coordinate in zip(piece, coordinates, strict=True):
            share = cuts[corner] if len(corner) == 2 else 0.0
            coordinate["abcd".index(corner[0])] = 1.0 - share
            coordinate["abcd".index(corner[-1])] += share
        mean = coordinates.mean(axis=0)
        if order == 1:
            integrals += part * mean
            continue
        # On a tetrahedron with corner values f_p, g_p the mean of f g is (sum f_p sum g_p + sum f_p g_p) / 20.
        square = (16.0 * mean**2 + (coordinates**2).sum(axis=0)) / 20.0
        product = (16.0 * mean[_FIRST] * mean[_SECOND] + (coordinates[:, _FIRST] * coordinates[:, _SECOND]).sum(axis=0)) / 20.0
        integrals[:4] += part * (2.0 * square - mean)
        integrals[4:] += part * 4.0 * product
    return integrals
