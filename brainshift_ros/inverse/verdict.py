"""When an estimate is valid, and what a person should know about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from brainshift_ros.inverse.discrepancy import Amplitudes
from brainshift_ros.inverse.mechanisms import MechanismShare
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.inverse.problem import WeightSolution
from brainshift_ros.units import m_to_mm

#: Extents of the measured points below these are too small to tell directions apart, metres.
_SMALL_PATCH = 0.010
_THIN_LINE = 0.003

#: Noise alone gives displacements of 1.6 sigma in the mean (chi distribution, three degrees of freedom); a few points may
#: reach this many.
_NOISE_SIGMAS = 2.0

#: Nodes farther than this from all points are far, metres. Where their error exceeds this fraction of their shift, it is said.
_FAR, _UNSURE = 0.06, 0.5

#: A mechanism whose part of the shift is uncertain by more than this fraction of the whole is not told from another such one.
_VAGUE = 0.25

#: Points that scatter this many times as much as their sigma says are remarked on.
_NOISIER = 2.0


@dataclass(frozen=True)
class Fit:
    """The facts that the verdict rests on.

    Attributes
    ----------
    offered
        Number of measured points.
    used
        Shape (n,), of those on the brain; False for outliers.
    points, measured, estimated
        Shape (n, 3), metres.
    sigma
        Shape (n,), metres.
    solution
        The weights.
    shares
        Of each mechanism.
    amplitudes
        Of noise and model error.
    field_error
        Root mean square length of the error that is expected of the field over all nodes, metres.
    """

    offered: int
    used: NDArray[np.bool_]
    points: NDArray[np.float64]
    measured: NDArray[np.float64]
    estimated: NDArray[np.float64]
    sigma: NDArray[np.float64]
    solution: WeightSolution
    shares: Mapping[str, MechanismShare]
    amplitudes: Amplitudes
    field_error: float

    @property
    def on_brain(self) -> int:
        """Number of measured points that lie on the brain."""
        return len(self.points)

    @property
    def residuals(self) -> NDArray[np.float64]:
        """Length of the residual at the points in use, metres."""
        return np.linalg.norm(self.estimated - self.measured, axis=1)[self.used]

    @property
    def mean_shift(self) -> float:
        """Mean length of the measured displacement at the points in use, metres."""
        return float(np.mean(np.linalg.norm(self.measured[self.used], axis=1)))

    @property
    def rms_sigma(self) -> float:
        """Root mean square standard deviation of a displacement component at the points in use, metres."""
        return float(np.sqrt(np.mean(self.sigma[self.used] ** 2)))

    @property
    def moved(self) -> bool:
        """Whether the measured shift stands out from its noise."""
        return self.mean_shift > _NOISE_SIGMAS * self.rms_sigma


def reasons_against(fit: Fit, options: InverseOptions) -> tuple[str, ...]:
    """Why the estimate is not valid; empty if it is."""
    reasons = []
    count = int(fit.used.sum())
    if count < options.min_points:
        reasons.append(f"{count} points in use, {options.min_points} are needed")
    if fit.on_brain < 0.5 * fit.offered:
        reasons.append(f"only {fit.on_brain} of {fit.offered} points lie on this brain: another patient, or a wrong frame?")
    if count < 0.6 * fit.on_brain:
        reasons.append(f"{fit.on_brain - count} of {fit.on_brain} points contradict the others")
    residual = float(np.mean(fit.residuals))
    gate = max(options.max_residual_sigmas * fit.rms_sigma, options.max_residual_fraction * fit.mean_shift)
    if residual > gate:
        reasons.append(f"the mean residual of {m_to_mm(residual):.2f} mm exceeds the limit of {m_to_mm(gate):.2f} mm")
    if not fit.solution.kkt_residual <= options.max_kkt_residual:
        reasons.append(
            f"the solver failed: KKT residual {fit.solution.kkt_residual:.1e}, allowed {options.max_kkt_residual:.0e}"
        )
    if fit.moved and not fit.solution.weights.any():
        reasons.append("no atlas entry moves the points the measured way: every weight is zero")
    if fit.moved and fit.field_error > fit.mean_shift:  # as of weights that fit noise, whatever their residual
        reasons.append(
            f"the whole brain's shift is uncertain by {m_to_mm(fit.field_error):.2g} mm, more than the "
            f"{m_to_mm(fit.mean_shift):.1f} mm that were measured"
        )
    return tuple(reasons)


def remarks(fit: Fit) -> tuple[str, ...]:
    """Say what the data do not determine or the atlas does not span."""
    found = []
    outliers = int((~fit.used).sum())
    if outliers:
        found.append(f"{outliers} of {fit.on_brain} points were dropped as outliers")
    if not fit.moved:
        found.append(f"the measured shift of {m_to_mm(fit.mean_shift):.2f} mm is not above its own noise")
    predicted = float(np.mean(np.linalg.norm(fit.estimated[fit.used], axis=1)))
    if fit.solution.saturated and predicted < 0.9 * fit.mean_shift:
        names = ", ".join(fit.solution.saturated)
        found.append(
            f"the weights of {names} reached their limit: the atlas holds no shift as large as the measured "
            f"{m_to_mm(fit.mean_shift):.1f} mm"
        )
    found += _unexplained(fit)
    extent = np.linalg.svd(fit.points[fit.used] - fit.points[fit.used].mean(axis=0), compute_uv=False)
    extent = np.pad(extent, (0, 3))[:3] / np.sqrt(max(int(fit.used.sum()), 1))
    if extent[0] < _SMALL_PATCH:
        found.append(f"the points cover a patch of only {m_to_mm(2 * extent[0]):.0f} mm: the far field is not determined")
    elif extent[1] < _THIN_LINE:
        found.append("the points lie nearly on a line: rotation about it is not determined")
    return tuple(found)


def far_field(
    nodes: NDArray[np.float64], displacement: NDArray[np.float64], std: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[str, ...]:
    """Say if the field far from the points is hardly known, compared with its size.

    Parameters
    ----------
    nodes, displacement
        Shape (N, 3), metres.
    std
        Shape (N,), of a component, metres.
    points
        Shape (n, 3), the points in use, metres.
    """
    far = cKDTree(points).query(nodes, distance_upper_bound=_FAR)[0] > _FAR
    if not far.any():
        return ()
    size = float(np.sqrt(np.mean(np.sum(displacement[far] ** 2, axis=1))))
    error = float(np.sqrt(3.0 * np.mean(std[far] ** 2)))
    if error <= _UNSURE * size:
        return ()
    return (
        f"farther than {m_to_mm(_FAR):.0f} mm from the points the shift is {m_to_mm(size):.1f} mm in the mean, "
        f"uncertain by {m_to_mm(error):.1f} mm",
    )


def _unexplained(fit: Fit) -> list[str]:
    """Say which mechanisms the points do not tell apart, and if they are noisier than they claim."""
    found = []
    vague = [
        f"{name} ({m_to_mm(share.shift):.1f} ± {m_to_mm(share.shift_std):.1f} mm)"
        for name, share in fit.shares.items()
        if share.shift_std > _VAGUE * fit.mean_shift
    ]
    if fit.moved and len(vague) > 1:
        found.append(f"the points do not tell {' from '.join(vague)}")
    if fit.amplitudes.sigma_factor > _NOISIER:
        found.append(f"the points scatter {fit.amplitudes.sigma_factor:.1f} times as much as their sigma says")
    return found
