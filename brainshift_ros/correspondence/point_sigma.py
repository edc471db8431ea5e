"""How sure a homologous point is: a standard deviation from the evidence at the point itself.

The variance of a displacement's component is a weighted sum of three variances that the point's own data give, and the
tracker's. The weights were fitted by maximum likelihood (Student's t with 4 degrees of freedom, since errors have heavier
tails than a normal distribution) to the errors in simulated cases 0 to 35, less each case's common rigid part, and scaled so
that 68 % of the components lie within one standard deviation. How far a point returns from itself when tracked back, and the
slope of the surface, told nothing more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_SHIFT, _LIFT, _DISAGREEMENT = 1.5, 0.26, 0.20
_ALONE_M = 0.5e-3  # disagreement that is assumed where no neighbours can be asked


@dataclass(frozen=True)
class PointEvidence:
    """What the images and the surface say about each point, shapes (n,).

    Attributes
    ----------
    shift_variance
        Of an in-plane component, by the structure tensor and the residual of the matched windows (Cramer-Rao), m^2.
    lift_variance
        Of the fitted heights, both scans together, m^2.
    disagreement_m
        Distance from what the neighbours predict, metres; NaN where they are too few.
    """

    shift_variance: NDArray[np.float64]
    lift_variance: NDArray[np.float64]
    disagreement_m: NDArray[np.float64]


def point_sigma(evidence: PointEvidence, tracker_m: float) -> NDArray[np.float64]:
    """Estimate the standard deviation of each displacement component, shape (n,), metres.

    Parameters
    ----------
    evidence
        Of each point.
    tracker_m
        Root mean square error of the tracked scanner's position, metres: each of the two scans has it, all points share it,
        and nothing in the scans shows it.
    """
    local = (
        _SHIFT * evidence.shift_variance
        + _LIFT * evidence.lift_variance
        + _DISAGREEMENT * np.nan_to_num(evidence.disagreement_m, nan=_ALONE_M) ** 2
    )
    # A tracker's error has a length; a third of its square falls to each component.
    return np.sqrt(local + 2.0 * tracker_m**2 / 3.0)
