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
from brainshift_ros.inverse.problem import WeightSolution
from brainshift_ros.units import m_to_mm

SCHEMA = "brainshift/shift-estimate/1"

#: Mechanism, and group name, of columns that were solved during surgery.
RETRACTION = "retraction"


@dataclass(frozen=True)
class EntryWeight:
    """One non-zero weight with the parameters of its column; parameters are None for columns solved during surgery."""

    column: int
    weight: float
    mechanism: str
    gravity_direction: tuple[float, float, float] | None = None
    fluid_level: float | None = None
    drug_level: int | None = None
    resected: bool | None = None


@dataclass(frozen=True)
class ShiftEstimate:
    """The estimated shift, and how far to trust it.

    Attributes
    ----------
    field
        Displacement and standard deviation at every node.
    valid
        Whether every gate passed; `reasons` says which did not.
    reasons, warnings
        Why it is not valid; what a person should know all the same.
    weights
        The non-zero weights, largest first.
    mechanism_sums
        Sum of the weights of each mechanism.
    solution
        All weights, with the solver's diagnostics.
    points, measured, estimated
        Shape (n, 3), metres: the measured points that lie on the brain, their displacements, and the estimated ones.
    used
        Shape (n,), False for outliers.
    points_offered
        How many points were given.
    residual_mean, residual_rms
        Length of the residual over the points in use, metres.
    correction_percent, angular_error_deg
        (4.4) and the mean angle over the points in use; None where nothing moved.
    condition
        Condition number of the weighted columns in use; infinite if they are linearly dependent.
    atlas_id, patient_id, points_sha256, retraction_sha256
        What the estimate was made from.
    times_s
        Seconds spent in each stage.
    """

    field: DisplacementField
    valid: bool
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]
    weights: tuple[EntryWeight, ...]
    mechanism_sums: dict[str, float]
    solution: WeightSolution
    points: NDArray[np.float64]
    measured: NDArray[np.float64]
    estimated: NDArray[np.float64]
    used: NDArray[np.bool_]
    points_offered: int
    residual_mean: float
    residual_rms: float
    correction_percent: float | None
    angular_error_deg: float | None
    condition: float
    atlas_id: str
    patient_id: str
    points_sha256: str
    retraction_sha256: str | None
    times_s: dict[str, float]

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
            "points_offered": self.points_offered,
            "points_on_brain": len(self.points),
            "points_used": int(self.used.sum()),
            "residual_mean_m": self.residual_mean,
            "residual_rms_m": self.residual_rms,
            "shift_mean_m": float(np.mean(np.linalg.norm(self.measured[self.used], axis=1))),
            "correction_percent": self.correction_percent,
            "angular_error_deg": self.angular_error_deg,
            "field_mean_m": float(magnitude.mean()),
            "field_max_m": float(magnitude.max()),
            "field_std_mean_m": float(self.field.std.mean()),
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
