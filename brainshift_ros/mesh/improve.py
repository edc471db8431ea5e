"""Repair of the few flat elements of a mesh, by moving their nodes (optimisation-based smoothing)."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.geometry import unit
from brainshift_ros.mesh.quality import dihedral_angles_deg

#: A repaired element's smallest dihedral angle, degrees: above the gate's limit, which a restored volume may come near.
GOAL_DEG = 14.0

#: Surface nodes may leave their surface by this share of the shortest edge around them.
_LEASH = 0.1

#: A direction lies in a surface if the facets around the node are steeper than this across it: the squared sine, averaged.
_IN_SURFACE = 0.1

_DIRECTIONS = unit(np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)]))
_SWEEPS = 8
_FIRST_STEP, _LAST_STEP = 0.3, 0.01


def raise_angles(
    nodes: NDArray[np.float64],
    elements: NDArray[np.integer],
    surfaces: Iterable[NDArray[np.integer]],
    curves: Iterable[NDArray[np.integer]] = (),
    goal_deg: float = GOAL_DEG,
) -> NDArray[np.float64]:
    """Move nodes of the elements whose smallest dihedral angle is below a goal, until none is or nothing helps.

    One node after the other goes to where the smallest angle of the elements around it is largest (Freitag and
    Ollivier-Gooch 1997), found by a compass search, as that function has kinks. Nodes of a surface slide in its tangent
    plane, those where surfaces meet slide along the common line, and corners stay: the free directions of a node are
    the eigenvectors of its facets' normal tensor with small eigenvalues. All may leave their surface by a tenth of an
    edge. Nodes at the same place, on both sides of a split sheet, move together.

    Parameters
    ----------
    nodes
        Shape (N, 3), metres.
    elements
        Shape (M, 4), all positive.
    surfaces
        Facets, each of shape (F, 3), that the mesh shall go on following.
    curves
        Node sets that stay, such as the free edges of sheets.
    goal_deg
        Elements above this angle are left alone.

    Returns
    -------
    ndarray
        Nodes, shape (N, 3), metres.
    """
    places, place_of = np.unique(nodes, axis=0, return_inverse=True)
    place_of = place_of.ravel()
    cells = place_of[elements]
    angles = dihedral_angles_deg(places, cells).min(axis=1)
    if angles.min() >= goal_deg:
        return nodes
    normal_tensor = _normal_tensors(places, [place_of[facets] for facets in surfaces])
    still = np.zeros(len(places), dtype=bool)
    for curve in curves:
        still[place_of[curve]] = True
    around, first = _stars(cells, len(places))
    for _ in range(_SWEEPS):
        flat = np.flatnonzero(angles < goal_deg)
        before = angles[flat].sum()
        for place in dict.fromkeys(cells[flat[np.argsort(angles[flat])]].ravel().tolist()):
            if still[place]:
                continue
            star = around[first[place] : first[place + 1]]
            places[place] = _best_place(places, cells[star], place, normal_tensor[place], goal_deg)
            angles[star] = dihedral_angles_deg(places, cells[star]).min(axis=1)
        if not np.any(angles < goal_deg) or angles[flat].sum() - before < 0.1:
            break
    return places[place_of]


def _best_place(
    places: NDArray[np.float64],
    star: NDArray[np.int64],
    place: int,
    normal_tensor: NDArray[np.float64],
    goal_deg: float,
) -> NDArray[np.float64]:
    """Compass search for the place of a node that makes the smallest angle of its star, shape (k, 4), largest."""
    corners = places[star]
    moving = star == place
    start = places[place]
    spokes = corners[~moving].reshape(len(star), 3, 3) - start
    edge = float(np.linalg.norm(spokes, axis=2).min())
    values, axes = np.linalg.eigh(normal_tensor)
    held = axes[:, values > _IN_SURFACE]
    P_held = held @ held.T
    P_free = np.eye(3) - P_held

    def lowest(trials: NDArray[np.float64]) -> NDArray[np.float64]:
        x = np.where(moving[None, :, :, None], trials[:, None, None], corners[None])
        flat = x.reshape(-1, 4, 3)
        volumes = np.linalg.det(flat[:, 1:] - flat[:, :1])
        angles = np.zeros(len(flat))
        positive = volumes > 1e-3 * np.median(np.abs(volumes))
        ids = np.arange(4 * np.count_nonzero(positive)).reshape(-1, 4)
        angles[positive] = dihedral_angles_deg(flat[positive].reshape(-1, 3), ids).min(axis=1)
        return np.minimum(angles.reshape(len(trials), -1).min(axis=1), goal_deg)

    here, value, step = start, lowest(start[None])[0], _FIRST_STEP
    while step > _LAST_STEP and value < goal_deg:
        trials = here + step * edge * _DIRECTIONS
        off = (trials - start) @ P_held
        length = np.linalg.norm(off, axis=1, keepdims=True)
        off *= np.minimum(1.0, _LEASH * edge / np.maximum(length, 1e-12))
        trials = start + (trials - start) @ P_free + off
        found = lowest(trials)
        best = int(np.argmax(found))
        if found[best] > value + 1e-3:
            here, value = trials[best], found[best]
        else:
            step *= 0.5
    return here


def _normal_tensors(places: NDArray[np.float64], surfaces: list[NDArray[np.int64]]) -> NDArray[np.float64]:
    """Mean of n n^T over the facets around each node, weighted by area, shape (N, 3, 3); zero inside the mesh."""
    tensors = np.zeros((len(places), 3, 3))
    weight = np.zeros(len(places))
    for facets in surfaces:
        a, b, c = np.moveaxis(places[facets], 1, 0)
        normal = np.cross(b - a, c - a)
        area = np.maximum(np.linalg.norm(normal, axis=1), 1e-30)
        np.add.at(tensors, facets.ravel(), np.repeat(np.einsum("fi,fj->fij", normal, normal) / area[:, None, None], 3, axis=0))
        np.add.at(weight, facets.ravel(), np.repeat(area, 3))
    return tensors / np.maximum(weight, 1e-30)[:, None, None]


def _stars(cells: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Elements around each node: those of node i are ``around[first[i]:first[i + 1]]``."""
    order = np.argsort(cells.ravel(), kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(cells.ravel(), minlength=count))])
    return order // 4, first
