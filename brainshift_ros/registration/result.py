"""What a registration found, and whether to believe it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.registration.verdict import Evidence, skew


@dataclass(frozen=True)
class RegistrationResult:
    """Where the tracker is in the patient, and whether to believe it.

    Attributes
    ----------
    T_patient_tracker
        4x4 rigid transform.
    accepted
        The verdict: every gate passed.
    reasons
        Which gates failed, in words; empty when accepted.
    evidence
        The figures that the verdict rests on.
    covariance
        Shape (6, 6): rotation vector (rad), then translation (m), patient frame, about `pivot`; from the Hessian.
    pivot
        Shape (3,), centroid of the inliers, patient frame, metres.
    start
        ``"pose"``: from the given pose; ``"search"``: found without one.
    starts
        How many poses alignment started from.
    iterations
        ICP iterations of the fine stages.
    cortex_mask
        Shape (H, W): the scan's pixels that lie on the cortex.
    warnings
        What a person should know although the verdict stands.
    times_s
        Seconds by stage.
    """

    T_patient_tracker: NDArray[np.float64]
    accepted: bool
    reasons: tuple[str, ...]
    evidence: Evidence
    covariance: NDArray[np.float64]
    pivot: NDArray[np.float64]
    start: Literal["pose", "search"]
    starts: int
    iterations: int
    cortex_mask: NDArray[np.bool_]
    warnings: tuple[str, ...]
    times_s: Mapping[str, float]

    @property
    def inlier_fraction(self) -> float:
        """Share of inliers among the scan's points inside the outline of the matched cortex."""
        return self.evidence.inlier_fraction

    @property
    def rms_m(self) -> float:
        """Root mean square distance of the inliers to the cortex along its normals, metres."""
        return self.evidence.rms_m

    @property
    def condition(self) -> float:
        """Condition number of the Hessian, rotations scaled by the patch's radius of gyration."""
        return self.evidence.condition

    def predicted_tre_m(self, target: ArrayLike) -> float:
        """Predict the registration error at a target, metres: root of the trace of its covariance.

        Parameters
        ----------
        target
            Shape (3,), patient frame, metres.
        """
        lever = np.asarray(target, dtype=np.float64) - self.pivot
        jacobian = np.concatenate([-skew(lever), np.eye(3)], axis=1)
        return float(np.sqrt(np.trace(jacobian @ self.covariance @ jacobian.T)))
