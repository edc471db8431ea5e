"""Smooth shifts of the cortex in a craniotomy: sag, sliding along the skull, and a turn about the opening's axis."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from brainshift_ros.geometry import invert_rigid, transform_points
from brainshift_ros.simulation.craniotomy import Craniotomy

_BRAIN_RADIUS_M = 0.070  # tissue slides on a sphere: a straight slide would push through the bone
_MOST_STRAIN = 0.16
_LARGEST_TURN_RAD = np.deg2rad(15.0)
_TURN_SHARE = 0.6  # of the peak shift that the turn may make up at the edge of the opening


@dataclass(frozen=True)
class OpeningShift:
    """Displacement of points, patient frame: ``shift(points (n, 3)) -> (n, 3)``, metres.

    Attributes
    ----------
    craniotomy
        Whose coordinates the next ones use.
    sag_m
        Inward, at the middle of the bump.
    slide_m
        Along the surface, craniotomy x and y.
    turn_rad
        About the opening's axis.
    middle_m
        Craniotomy xy where the sag is deepest.
    length_m
        Gaussian radius over which all fade.
    """

    craniotomy: Craniotomy
    sag_m: float
    slide_m: tuple[float, float]
    turn_rad: float
    middle_m: tuple[float, float]
    length_m: float

    def __call__(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Displacement of points (n, 3), metres."""
        T_craniotomy_patient = self.craniotomy.T_craniotomy_patient
        local = transform_points(T_craniotomy_patient, points)
        fade = np.exp(-0.5 * np.sum((local - [*self.middle_m, 0.0]) ** 2, axis=1) / self.length_m**2)[:, None]
        slide_x, slide_y = self.slide_m
        deep = np.array([0.0, 0.0, -_BRAIN_RADIUS_M])
        # Turned by a part of the angle where the motion fades: the whole stays as smooth as the fading.
        angles = fade * np.array([-slide_y / _BRAIN_RADIUS_M, slide_x / _BRAIN_RADIUS_M, self.turn_rad])
        moved = Rotation.from_rotvec(angles).apply(local - deep) + deep
        moved[:, 2] -= self.sag_m * fade[:, 0]
        return np.asarray((moved - local) @ invert_rigid(T_craniotomy_patient)[:3, :3].T)

    def scaled(self, factor: float) -> OpeningShift:
        """Sag and slide times `factor`; the turn stays."""
        slide_x, slide_y = self.slide_m
        return replace(self, sag_m=factor * self.sag_m, slide_m=(factor * slide_x, factor * slide_y))


def draw_shift(
    craniotomy: Craniotomy, in_opening: NDArray[np.float64], peak_m: float, rng: np.random.Generator
) -> OpeningShift:
    """Draw a shift whose greatest length over the opening is `peak_m`.

    Parameters
    ----------
    craniotomy
        The opening.
    in_opening
        Shape (n, 3), metres, patient frame: points of the cortex inside it.
    peak_m
        Greatest displacement over those points.
    rng
        Decides directions, their shares, the turn (up to 15 degrees) and the length over which all fade.
    """
    radius = craniotomy.radius_m
    slope = rng.uniform(0.2, 1.2)  # slide over sag
    direction = rng.uniform(0.0, 2.0 * np.pi)
    slide = slope / np.hypot(1.0, slope) * peak_m
    turn = rng.uniform(-1.0, 1.0) * min(_LARGEST_TURN_RAD, _TURN_SHARE * peak_m / radius)
    shift = OpeningShift(
        craniotomy=craniotomy,
        sag_m=peak_m / np.hypot(1.0, slope),
        slide_m=(slide * np.cos(direction), slide * np.sin(direction)),
        turn_rad=turn,
        middle_m=tuple(0.3 * radius * rng.uniform(-1.0, 1.0, 2)),
        # The steepest slope of a Gaussian bump is 0.61 peak / length.
        length_m=max(rng.uniform(1.1, 1.8) * radius, 0.61 * peak_m / _MOST_STRAIN),
    )

    def excess(factor: float) -> float:
        return float(np.linalg.norm(shift.scaled(factor)(in_opening), axis=1).max()) - peak_m

    return shift.scaled(float(brentq(excess, 0.0, 3.0)))
