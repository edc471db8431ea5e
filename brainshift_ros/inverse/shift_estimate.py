"""The result of the inverse model, and its JSON form."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros import __version__
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.inverse.accuracy import angles_deg, shift_correction_percent
from brainshift_ros.inverse.discrepancy import Amplitudes
from brainshift_ros.inverse.mechanisms import MechanismShare
from brainshift_ros.inverse.problem import WeightSolution
from brainshift_ros.units import m_to_mm

SCHEMA = "brainshift/shift-estimate/2"


@dataclass(frozen=True)
class EntryWeight:
    """One non-zero weight with the parameters of its column; parameters are None for columns solved during surgery.

    `std` is its standard deviation as the points leave it: large beside the weight where other columns would do as well.
    """

    column: int
    weight: float
    mechanism: str
    gravity_direction: tuple[float, float, float] | None = None
    fluid_level: float | None = None
    drug_level: int | None = None
    resected: bool | None = None
    std: float | None = None


@dataclass(frozen=True)
class ShiftEstimate:
    """The estimated shift, and how far to trust it.

    Attributes
    ----------
    field
        Displacement and standard deviation at every node.
    reasons, warnings
        Which gates did not pass; what a person should know all the same.
    weights
        The non-zero weights, largest first.
    mechanisms
        What each mechanism of the atlas contributes, and how sure that is.
    solution
        All weights, with the solver's diagnostics.
    points, measured, estimated
        Shape (n, 3), metres: the measured points that lie on the brain, their displacements, and the estimated ones.
    used
        Shape (n,), False for outliers.
    points_offered
        How many points were given.
    condition
        Condition number of the weighted columns in use; infinite if they are linearly dependent.
    amplitudes
        Size of what the atlas cannot follow, and of the points' noise, as the points show them.
    atlas_id, patient_id, points_sha256, retraction_sha256
        What the estimate was made from.
    times_s
        Seconds spent in each stage.
    """

    field: DisplacementField
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]
    weights: tuple[EntryWeight, ...]
    mechanisms: dict[str, MechanismShare]
    solution: WeightSolution
    points: NDArray[np.float64]
    measured: NDArray[np.float64]
    estimated: NDArray[np.float64]
    used: NDArray[np.bool_]
    points_offered: int
    condition: float
    amplitudes: Amplitudes
    atlas_id: str
    patient_id: str
    points_sha256: str
    retraction_sha256: str | None
    times_s: dict[str, float]

    @property
    def valid(self) -> bool:
        """Whether every gate passed; `reasons` says which did not."""
        return not self.reasons

    @property
    def residuals(self) -> NDArray[np.float64]:
        """Length of the residual at the points in use, shape (k,), metres."""
        return np.linalg.norm(self.estimated - self.measured, axis=1)[self.used]

    @property
    def residual_mean(self) -> float:
        """Mean of :attr:`residuals`, metres."""
        return float(np.mean(self.residuals))

    @property
    def residual_rms(self) -> float:
        """Root mean square of :attr:`residuals`, metres."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def correction_percent(self) -> float | None:
        """Shift correction (4.4) at the points in use; None where nothing moved."""
        return shift_correction_percent(self.measured[self.used], self.estimated[self.used])

    @property
    def angles_deg(self) -> NDArray[np.float64]:
        """Angles between measured and estimated displacements at the points in use that moved, shape (k,)."""
        return angles_deg(self.measured[self.used], self.estimated[self.used])

    @property
    def angular_error_deg(self) -> float | None:
        """Mean of :attr:`angles_deg`; None where nothing moved."""
        return float(self.angles_deg.mean()) if self.angles_deg.size else None

    @property
    def mechanism_sums(self) -> dict[str, float]:
        """Sum of the weights of each mechanism that has any."""
        active = {weight.mechanism for weight in self.weights}
        return {name: share.weight_sum for name, share in self.mechanisms.items() if name in active}

    def to_json(self) -> dict[str, Any]:
        """Return everything but the field itself as JSON values, in SI units, of the published schema.

        Non-finite numbers, which JSON lacks, become null.
        """
        magnitude = np.linalg.norm(self.field.displacement, axis=1)
        return {
            "schema": SCHEMA,
            "software": f"brainshift_ros {__version__}",
            "valid": self.valid,
            "reasons": list(self.reasons),
            "warnings": list(self.warnings),
            "atlas_id": self.atlas_id,
            "patient_id": self.patient_id,
            "points_sha256": self.points_sha256,
            "retraction_sha256": self.retraction_sha256,
            "method": self.solution.method,
            "kkt_residual": _finite(self.solution.kkt_residual),
            "iterations": self.solution.iterations,
            "converged": self.solution.converged,
            "regularisation": _finite(self.solution.regularisation),
            "condition": _finite(self.condition),
            "saturated_groups": list(self.solution.saturated),
            "weights": [asdict(weight) for weight in self.weights],
            "nonzero_weights": len(self.weights),
            "mechanism_sums": self.mechanism_sums,
            "mechanisms": {
                name: {
                    "weight_sum": share.weight_sum,
                    "weight_sum_std": share.weight_sum_std,
                    "shift_m": share.shift,
                    "shift_std_m": share.shift_std,
                }
                for name, share in self.mechanisms.items()
            },
            "points_offered": self.points_offered,
            "points_on_brain": len(self.points),
            "points_used": int(self.used.sum()),
            "residual_mean_m": self.residual_mean,
            "residual_rms_m": self.residual_rms,
            "residual_max_m": float(np.max(self.residuals)),
            "sigma_factor": self.amplitudes.sigma_factor,
            "model_error_fraction": self.amplitudes.error,
            "shift_mean_m": float(np.mean(np.linalg.norm(self.measured[self.used], axis=1))),
            "correction_percent": self.correction_percent,
            "angular_error_deg": self.angular_error_deg,
            "angular_error_max_deg": float(self.angles_deg.max()) if self.angles_deg.size else None,
            "field_mean_m": float(magnitude.mean()),
            "field_max_m": float(magnitude.max()),
            "field_std_mean_m": float(self.field.std.mean()),
            "field_std_max_m": float(self.field.std.max()),
            "points": [
                {"position_m": position, "measured_m": measured, "estimated_m": estimated, "used": used}
                for position, measured, estimated, used in zip(
                    self.points.tolist(), self.measured.tolist(), self.estimated.tolist(), self.used.tolist(), strict=True
                )
            ],
            "times_s": dict(self.times_s),
        }

    def summary(self) -> str:
        """Return one line for people, lengths in mm."""
        verdict = "valid" if self.valid else "NOT VALID (" + "; ".join(self.reasons) + ")"
        correction = "-" if self.correction_percent is None else f"{self.correction_percent:.0f} %"
        return (
            f"{verdict}: {int(self.used.sum())} of {self.points_offered} points, "
            f"residual {m_to_mm(self.residual_mean):.2f} mm, "
            f"correction at the points {correction}, {len(self.weights)} non-zero weights"
        )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def json_schema() -> dict[str, Any]:
    """Return the published JSON schema of :meth:`ShiftEstimate.to_json`."""
    text = files("brainshift_ros.inverse").joinpath("shift_estimate.schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema
