"""Seeded trees of cortical arteries and veins, grown in the plane of the craniotomy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_STEP_M = 0.4e-3
_THINNEST_M = 0.4e-3


@dataclass(frozen=True)
class PaintedVessel:
    """One vessel from its origin to its end.

    Attributes
    ----------
    path
        Shape (n, 2), metres, craniotomy xy.
    width
        Shape (n,), full width, metres.
    vein
        True for veins (wide, dark), False for arteries (narrow, bright).
    level
        0 for trunks, 1 for their branches, and so on.
    """

    path: NDArray[np.float64]
    width: NDArray[np.float64]
    vein: bool
    level: int


def _walk(
    rng: np.random.Generator, start: NDArray[np.float64], heading: float, width: float, vein: bool, length: float, reach: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Path whose curvature is an Ornstein-Uhlenbeck process (tortuous, without kinks), its width and headings."""
    steps = max(round(length / _STEP_M), 4)
    persistence = 5e-3 if vein else 3e-3
    spread = 70.0 if vein else 130.0  # standard deviation of curvature, 1/m
    decay = np.exp(-_STEP_M / persistence)
    curvature = rng.normal(0.0, spread)
    home = heading
    path, headings = [start], [heading]
    for kick in rng.normal(0.0, spread * np.sqrt(1 - decay**2), steps):
        curvature = decay * curvature + kick - 12.0 * (heading - home) * (1 - decay)
        heading += curvature * _STEP_M
        path.append(path[-1] + _STEP_M * np.array([np.cos(heading), np.sin(heading)]))
        headings.append(heading)
        if np.hypot(*path[-1]) > reach:
            break
    taper = np.linspace(1.0, 0.6, steps + 1)[: len(path)]
    return np.array(path), np.maximum(width * taper, _THINNEST_M), np.array(headings)


def grow_vessels(radius_m: float, rng: np.random.Generator) -> tuple[PaintedVessel, ...]:
    """Trunks that cross the opening, each with branches that branch again down to 0.4 mm.

    Parameters
    ----------
    radius_m
        Radius of the opening; trunks start outside it and density follows its area.
    rng
        Source of all randomness.

    Returns
    -------
    tuple of PaintedVessel
        Arteries first: painted in this order, veins run over arteries.
    """
    reach = 1.35 * radius_m
    trunks = max(4, round(9 * radius_m / 35e-3))
    start_angles = rng.uniform(0, 2 * np.pi) + 2 * np.pi * (np.arange(trunks) + rng.uniform(-0.3, 0.3, trunks)) / trunks
    vessels: list[PaintedVessel] = []
    for number, angle in enumerate(start_angles):
        vein = number % 3 == 0
        width = rng.uniform(1.3e-3, 2.0e-3) if vein else rng.uniform(0.9e-3, 1.4e-3)
        start = 1.3 * radius_m * np.array([np.cos(angle), np.sin(angle)])
        heading = angle + np.pi + rng.uniform(-0.5, 0.5)
        queue = [(start, heading, width, 0, 2.4 * radius_m * rng.uniform(0.6, 1.0))]
        while queue:
            origin, direction, caliber, level, length = queue.pop()
            path, widths, headings = _walk(rng, origin, direction, caliber, vein, length, reach)
            vessels.append(PaintedVessel(path, widths, vein, level))
            if level == 3:
                continue
            position = rng.uniform(3e-3, 9e-3)
            side = rng.choice([-1.0, 1.0])
            while position < _STEP_M * (len(path) - 8):
                at = round(position / _STEP_M)
                child = widths[at] * rng.uniform(0.4, 0.75)
                if child >= _THINNEST_M:
                    turn = side * np.deg2rad(rng.uniform(30, 75))
                    queue.append(
                        (path[at], headings[at] + turn, child, level + 1, rng.uniform(10e-3, 35e-3) / (1 + 0.5 * level))
                    )
                side = -side if rng.uniform() < 0.7 else side
                position += rng.uniform(5e-3, 11e-3)
    return tuple(sorted(vessels, key=lambda vessel: (vessel.vein, -vessel.level)))
