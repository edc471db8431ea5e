"""Seeded trees of cortical arteries and veins, grown in the plane of the craniotomy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_STEP_M = 0.4e-3
_THINNEST_M = 0.4e-3
_FINE_LEVEL = 4
_SULCAL_CURVATURE = 220.0  # 1/m a unit slope of the relief


@dataclass(frozen=True)
class VesselStyle:
    """How vessels run.

    Attributes
    ----------
    sulcal_pull
        How strongly veins, and arteries half as much, are drawn into sulci: 0 not at all, 1 strongly.
    end_width
        Width at a vessel's end over that at its origin.
    fine_per_cm2
        Fine arterioles and venules of 0.2 to 0.4 mm, as many on a square centimetre.
    """

    sulcal_pull: float = 0.0
    end_width: float = 0.6
    fine_per_cm2: float = 0.0


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
        0 for trunks, 1 for their branches, and so on; 4 for fine vessels, which hang on no tree.
    """

    path: NDArray[np.float64]
    width: NDArray[np.float64]
    vein: bool
    level: int


class SulcalRelief:
    """Which way the sulci lie.

    Parameters
    ----------
    depth_m
        Shape (k, k), metres below the smooth hull on ``linspace(-half_width, half_width, k)``, first index y.
    half_width_m
        Half the side of that square, metres.
    """

    def __init__(self, depth_m: NDArray[np.float64], half_width_m: float) -> None:
        smooth = ndimage.gaussian_filter(np.clip(depth_m, 0.0, 6e-3), 1.5)
        self._spacing_m = 2.0 * half_width_m / (len(depth_m) - 1)
        self._slope = np.gradient(smooth, self._spacing_m)
        self._half_width_m = half_width_m

    def turn(self, at: NDArray[np.float64], heading: float, pull: float) -> float:
        """Curvature, 1/m, that turns a vessel at craniotomy xy `at` towards the nearest sulcus."""
        index = np.round((at[::-1] + self._half_width_m) / self._spacing_m).astype(int)
        row, column = np.clip(index, 0, len(self._slope[0]) - 1)
        down_y, down_x = (slope[row, column] for slope in self._slope)
        return float(pull * _SULCAL_CURVATURE * (np.cos(heading) * down_y - np.sin(heading) * down_x))


def _walk(
    rng: np.random.Generator,
    start: NDArray[np.float64],
    heading: float,
    width: float,
    vein: bool,
    length: float,
    reach: float,
    style: VesselStyle,
    relief: SulcalRelief | None,
    thinnest: float = _THINNEST_M,
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
        pull = relief.turn(path[-1], heading, (1.0 if vein else 0.5) * style.sulcal_pull) if relief else 0.0
        heading += (curvature + pull) * _STEP_M
        path.append(path[-1] + _STEP_M * np.array([np.cos(heading), np.sin(heading)]))
        headings.append(heading)
        if np.hypot(*path[-1]) > reach:
            break
    taper = np.linspace(1.0, style.end_width, steps + 1)[: len(path)]
    return np.array(path), np.maximum(width * taper, thinnest), np.array(headings)


def grow_vessels(
    radius_m: float, rng: np.random.Generator, style: VesselStyle | None = None, relief: SulcalRelief | None = None
) -> tuple[PaintedVessel, ...]:
    """Trunks that cross the opening, each with branches that branch again down to 0.4 mm.

    Parameters
    ----------
    radius_m
        Radius of the opening; trunks start outside it and density follows its area.
    rng
        Source of all randomness.
    style
        How they run.
    relief
        The sulci; None: vessels run straight over them.

    Returns
    -------
    tuple of PaintedVessel
        Arteries first: painted in this order, veins run over arteries.
    """
    style = style or VesselStyle()
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
            path, widths, headings = _walk(rng, origin, direction, caliber, vein, length, reach, style, relief)
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
    vessels += _fine_vessels(reach, style, relief, rng)
    return tuple(sorted(vessels, key=lambda vessel: (vessel.vein, -vessel.level)))


def _fine_vessels(
    reach: float, style: VesselStyle, relief: SulcalRelief | None, rng: np.random.Generator
) -> list[PaintedVessel]:
    """Arterioles and venules that fill the field between the trees."""
    found = []
    for _ in range(round(style.fine_per_cm2 * np.pi * reach**2 * 1e4)):
        away, azimuth = reach * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
        start = away * np.array([np.cos(azimuth), np.sin(azimuth)])
        vein, width, length = bool(rng.uniform() < 0.4), rng.uniform(0.2e-3, 0.4e-3), rng.uniform(4e-3, 16e-3)
        heading = rng.uniform(0.0, 2.0 * np.pi)
        path, widths, _ = _walk(rng, start, heading, width, vein, length, reach, style, relief, thinnest=0.15e-3)
        found.append(PaintedVessel(path, widths, vein, _FINE_LEVEL))
    return found
