"""Paired-point registration: fiducials touched in tracker space, known in the MR; FRE, and the TRE that it predicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import rigid, transform_points
from brainshift_ros.units import m_to_mm

_LARGE_FRE_MM = 5.0
_MOST_MM = 20.0
_COLLINEAR_M = 5e-3  # fiducials closer than this (RMS) to one line do not fix the turn about it
_LARGEST_EXTENT_M = 1.0
_OUTLIER = 3.0  # times the RMS of the others


@dataclass(frozen=True)
class FiducialRegistration:
    """A rigid registration from paired points, and how well it is expected to hold elsewhere.

    Attributes
    ----------
    T_patient_tracker
        4x4 rigid transform.
    fiducials
        Shape (n, 3), patient frame, metres.
    residuals_m
        Shape (n,), distance of each fiducial to its partner after registration.
    fre_m
        Fiducial registration error: root mean square of the residuals. It says nothing about the error at a target:
        the two are uncorrelated (Fitzpatrick 2009).
    fle_m
        Fiducial localisation error, root mean square of its length, both spaces together: as given, or estimated from FRE.
    warnings
        What a person should know.
    """

    T_patient_tracker: NDArray[np.float64]
    fiducials: NDArray[np.float64]
    residuals_m: NDArray[np.float64]
    fre_m: float
    fle_m: float
    warnings: tuple[str, ...]

    def predicted_tre_m(self, target: ArrayLike) -> float:
        """Predict the root mean square target registration error, metres (Fitzpatrick, West, Maurer 1998, equation 46).

        Parameters
        ----------
        target
            Shape (3,), patient frame, metres.
        """
        centred = self.fiducials - self.fiducials.mean(axis=0)
        _, axes = np.linalg.eigh(centred.T @ centred)
        along, at = centred @ axes, (np.asarray(target, dtype=np.float64) - self.fiducials.mean(axis=0)) @ axes
        squared, at_squared = np.mean(along**2, axis=0), at**2
        # Distances of target and fiducials from each principal axis.
        ratio = (at_squared.sum() - at_squared) / (squared.sum() - squared)
        return float(np.sqrt(self.fle_m**2 / len(centred) * (1.0 + ratio.sum() / 3.0)))


def register_fiducials(
    tracker: ArrayLike, patient: ArrayLike, fle_m: float | None = None, names: Sequence[str] | None = None
) -> FiducialRegistration:
    """Find the rigid transform that brings paired points together in the least-squares sense (Kabsch 1976).

    Parameters
    ----------
    tracker, patient
        Shape (n, 3), n >= 3, metres: the same fiducials in the tracker's and the patient's frame, in the same order.
    fle_m
        Fiducial localisation error, metres, where the devices' is known. By default it is estimated from the residuals:
        E[FRE^2] = (1 - 2/n) FLE^2 (Sibson 1979), which few fiducials do poorly.
    names
        What to call them in warnings; their numbers from 1 by default.

    Raises
    ------
    InputError
        Fewer than three fiducials, unpaired or not finite, nearly on one line, or so far from congruent that they cannot
        be pairs in metres.
    """
    a, b = (np.asarray(points, dtype=np.float64) for points in (tracker, patient))
    _check(a, b)
    count = len(a)
    rotation, _ = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
    T = rigid(rotation, b.mean(axis=0) - rotation.apply(a.mean(axis=0)))
    residuals = np.linalg.norm(transform_points(T, a) - b, axis=1)
    fre = float(np.sqrt(np.mean(residuals**2)))
    if m_to_mm(fre) > _MOST_MM:
        raise InputError(
            "fiducials",
            f"do not match: FRE is {m_to_mm(fre):.1f} mm",
            "check their order, units and handedness (a mirrored set cannot be matched)",
        )
    warnings = _doubts(residuals, fre, fle_m is None, names or [str(number) for number in range(1, count + 1)])
    fle = fre * float(np.sqrt(count / (count - 2))) if fle_m is None else float(fle_m)
    return FiducialRegistration(T, b, residuals, fre, fle, warnings)


def _check(tracker: NDArray[np.float64], patient: NDArray[np.float64]) -> None:
    if tracker.ndim != 2 or tracker.shape != patient.shape or tracker.shape[1] != 3:
        shapes = f"shapes {tracker.shape} and {patient.shape}"
        raise InputError("fiducials", shapes, "give each fiducial three coordinates in both frames")
    if len(tracker) < 3:
        raise InputError("fiducials", f"only {len(tracker)} pairs", "give at least 3, better 6 or more")
    for frame, points in (("tracker", tracker), ("patient", patient)):
        source = f"fiducials, {frame} frame"
        if not np.isfinite(points).all():
            raise InputError(source, "not finite", "leave out what was not measured")
        centred = points - points.mean(axis=0)
        if np.ptp(centred, axis=0).max() > _LARGEST_EXTENT_M:
            extent = np.ptp(centred, axis=0).max()
            raise InputError(source, f"they extend over {extent:.3g} m", "give metres (millimetres in files, keys *_mm)")
        spread = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(points))
        if spread[1] < _COLLINEAR_M:
            raise InputError(
                source,
                "they lie on one line, or in one place",
                "spread them around the head: the turn about a line is not fixed",
            )


def _doubts(residuals: NDArray[np.float64], fre: float, estimated: bool, names: Sequence[str]) -> tuple[str, ...]:
    count, warnings = len(residuals), []
    if m_to_mm(fre) > _LARGE_FRE_MM:
        warnings.append(f"FRE of {m_to_mm(fre):.1f} mm: check the fiducials")
    worst = int(np.argmax(residuals))
    others = float(np.sqrt(np.mean(np.delete(residuals, worst) ** 2)))
    if count > 4 and residuals[worst] > _OUTLIER * max(others, 1e-4):
        warnings.append(
            f"fiducial {names[worst]} is off by {m_to_mm(residuals[worst]):.1f} mm: was it touched, or has it moved?"
        )
    if estimated and count < 5:
        warnings.append(f"the localisation error is estimated from {count} fiducials only, and so is the predicted TRE")
    return tuple(warnings)
