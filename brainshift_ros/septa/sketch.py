"""Falx and tentorium by the thesis's semi-automatic method: a drawn periphery, clipped planes, a morph (figures 1 and 2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline, RBFInterpolator

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import tangent_frame
from brainshift_ros.image.landmarks import Plane, SeptaSketch, TentoriumSketch
from brainshift_ros.septa.sheets import Septum, resampled, septum_inside

#: Points drawn on the mid-sagittal slice lie on it, but for rounding and a slice's thickness.
_OFF_SLICE_MM = 10.0


def septa_from_sketch(sketch: SeptaSketch, spacing_mm: float) -> tuple[Septum, ...]:
    """Build falx, left and right tentorium.

    The falx is the flat sheet inside its periphery, which runs smoothly through the drawn points. Each tentorium is its plane
    clipped by the mid-sagittal plane (along the straight sinus), by the outline and by the notch, then morphed by a
    thin-plate spline that takes the projections of the target points, and of the straight sinus, onto the points themselves
    (Bookstein 1989). Since each lies straight above its projection, the spline moves the plane along its normal alone.

    Parameters
    ----------
    sketch
        In millimetres, patient frame.
    spacing_mm
        Distance between neighbouring vertices.

    Raises
    ------
    InputError
        Points lie off the mid-sagittal slice or on the wrong side of it, or span no sheet.
    """
    plane = sketch.midsagittal_plane
    sinus = resampled(_curve(_on_slice(plane, sketch.straight_sinus, "straight sinus")), spacing_mm)
    outer = _curve(np.vstack([sinus[-1], _on_slice(plane, sketch.falx.outer_edge, "falx")]))[1:]
    free = _curve(np.vstack([outer[-1], _on_slice(plane, sketch.falx.free_edge, "falx"), sinus[0]]))[1:-1]
    septa = [septum_inside("falx", sinus, outer, free, (), spacing_mm, normal=plane.normal)]
    for side, name, sign in zip(sketch.sides, ("left", "right"), (-1.0, 1.0), strict=True):
        if np.median(sign * plane.height_mm(np.asarray(side.targets))) <= 0.0:
            problem = f"the {name} tentorium's points lie on the other side of the mid-sagittal plane"
            raise InputError("septa", problem, "give points in RAS (x to the right), and a plane whose normal points right")
        septa.append(_tentorium(side, plane, sign, sinus, spacing_mm))
    return tuple(septa)


def _tentorium(side: TentoriumSketch, midsagittal: Plane, sign: float, sinus: NDArray[np.float64], spacing_mm: float) -> Septum:
    R = tangent_frame(side.normal_up)
    known = np.vstack([sinus, side.targets]) @ R.T
    if len(np.unique(known[:, :2].round(3), axis=0)) < len(known):
        raise InputError("septa", "two target points of the tentorium lie above each other", "remove repeated points")
    height = RBFInterpolator(known[:, :2], known[:, 2], kernel="thin_plate_spline")

    def morphed(points: ArrayLike) -> NDArray[np.float64]:
        clipped = np.asarray(points, dtype=np.float64)
        across = sign * midsagittal.height_mm(clipped)
        clipped = np.where(across[:, None] > 0.0, clipped, midsagittal.projected_mm(clipped))
        in_plane = clipped @ R[:2].T
        return np.column_stack([in_plane, height(in_plane)]) @ R

    outline = morphed(_curve(np.vstack([sinus[-1], side.outline]))[1:])
    notch = morphed(_curve(np.vstack([side.outline[-1], side.notch, sinus[0]]))[1:-1])
    return septum_inside("tentorium", sinus, outline, notch, side.targets, spacing_mm, normal=side.normal_up)


def _curve(points_mm: ArrayLike) -> NDArray[np.float64]:
    """Points about 1 mm apart on the natural cubic spline through given ones, shape (n, 3).

    Its parameter grows with the square root of the chords (centripetal; Lee 1989), so that it does not overshoot between
    points that lie far apart.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if np.any(chords == 0.0):
        raise InputError("septa", "a point is given twice in a row", "remove repeated points")
    knots = np.concatenate([[0.0], np.cumsum(np.sqrt(chords))])
    count = max(2, int(np.ceil(chords.sum())))
    return CubicSpline(knots, points, bc_type="natural")(np.linspace(0.0, knots[-1], count))


def _on_slice(plane: Plane, points_mm: ArrayLike, name: str) -> NDArray[np.float64]:
    points = np.asarray(points_mm, dtype=np.float64)
    off = float(np.abs(plane.height_mm(points)).max())
    if off > _OFF_SLICE_MM:
        raise InputError(
            "septa", f"a point of the {name} lies {off:.3g} mm off the mid-sagittal plane", "draw it on that slice"
        )
    return plane.projected_mm(points)
