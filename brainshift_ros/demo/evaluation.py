"""The estimate against the truth, split by where, because an average hides the far field (spec E1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.demo.recording import RecordedCase, registration_error
from brainshift_ros.demo.session import Session
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.image.volume import Region
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.simulation.targets import target_groups
from brainshift_ros.units import m_to_mm


@dataclass(frozen=True)
class GroupError:
    """Shift and error of one group of targets; `correction_percent` is (4.4) of the group's means."""

    targets: int
    shift_mm_mean: float
    shift_mm_max: float
    error_mm_mean: float
    error_mm_95: float
    correction_percent: float


def evaluate_field(case: RecordedCase, field: DisplacementField) -> dict[str, GroupError]:
    """Compare at the truth's own nodes, by group of targets (see :func:`target_groups`)."""
    mesh = case.truth.mesh
    craniotomy = case.scene.craniotomy
    locator = PointLocator(field.mesh)
    report = {}
    for name, nodes in target_groups(mesh, craniotomy.center, craniotomy.radius_m).items():
        located = locator.locate(mesh.nodes[nodes], max_outside_m=5e-3)
        nodes, estimated = nodes[located.found], located.interpolate(field.mesh, field.displacement)[located.found]
        report[name] = _group_error(case.truth.solution.displacement[nodes], estimated)
    return report


def _group_error(truth: NDArray[np.float64], estimated: NDArray[np.float64]) -> GroupError:
    shift = m_to_mm(np.linalg.norm(truth, axis=1))
    error = m_to_mm(np.linalg.norm(estimated - truth, axis=1))
    return GroupError(
        targets=len(shift),
        shift_mm_mean=float(shift.mean()),
        shift_mm_max=float(shift.max()),
        error_mm_mean=float(error.mean()),
        error_mm_95=float(np.percentile(error, 95)),
        correction_percent=float(100.0 * (1.0 - error.mean() / shift.mean())),
    )


def registration_errors_mm(case: RecordedCase, session: Session) -> dict[str, float]:
    """Target registration error, mm: mean over the cortex in the craniotomy, and at the tumour's centre."""
    mesh = case.truth.mesh
    cortex = case.first.material[np.isfinite(case.first.material).all(axis=-1)]
    tumor = mesh.nodes[mesh.elements[mesh.region == Region.TUMOR]].mean(axis=(0, 1))
    return {
        "cortex": float(m_to_mm(registration_error(case, session.T_patient_tracker, cortex)).mean()),
        "tumor": float(m_to_mm(registration_error(case, session.T_patient_tracker, tumor[None]))[0]),
        "start": float(m_to_mm(registration_error(case, case.T_patient_tracker_initial, cortex)).mean()),
    }


def measured_point_errors_mm(case: RecordedCase, session: Session) -> dict[str, float]:
    """How far the measured displacements of the homologous points are from the truth there, mm."""
    truth = case.truth.displacement_at(session.homologous.points)
    error = m_to_mm(np.linalg.norm(session.homologous.displacements - truth, axis=1))
    return {"median": float(np.median(error)), "percentile_95": float(np.percentile(error, 95))}
