"""Figures of a session's steps by name, as diagnostics carry them: finite numbers and words only."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.registration.result import RegistrationResult
from brainshift_ros.units import m_to_mm

Figures = dict[str, float | str]


def registration_figures(result: RegistrationResult) -> Figures:
    """Figures of a registration, accepted or refused."""
    figures: Figures = {
        "state": "registered" if result.accepted else "registration refused",
        "registration_start": result.start,
        "registration_starts": float(result.starts),
        "registration_inlier_fraction": result.inlier_fraction,
        "registration_rms_mm": float(m_to_mm(result.rms_m)),
        "registration_condition": result.condition,
        "registration_area_cm2": result.evidence.area_m2 * 1e4,
        "registration_relief_ratio": result.evidence.relief_ratio,
        "registration_scale": result.evidence.scale,
        "registration_rivals": float(result.evidence.rivals),
        "registration_iterations": float(result.iterations),
        "registration_reasons": "; ".join(result.reasons),
    }
    if result.accepted:
        figures["registration_predicted_tre_mm"] = float(m_to_mm(result.predicted_tre_m(result.pivot)))
    return finite(figures)


def tracking_figures(measured: HomologousPoints, found: Mapping[str, float]) -> Figures:
    """Figures of the homologous points of one later scan; `found` are those of the correspondence."""
    figures: Figures = {**found, "homologous_points": float(len(measured.points))}
    length_mm = m_to_mm(np.linalg.norm(measured.displacements, axis=1))
    if len(length_mm):
        figures |= {
            "shift_mm_mean": float(length_mm.mean()),
            "shift_mm_max": float(length_mm.max()),
            "sigma_mm_median": float(np.median(m_to_mm(measured.sigma))),
        }
    return finite(figures)


def finite(figures: Figures) -> Figures:
    """Leave out what does not exist: where nothing matched there is neither an RMS nor a conditioning."""
    return {name: value for name, value in figures.items() if isinstance(value, str) or np.isfinite(value)}
