"""Paired fiducials as a person writes them: YAML, millimetres."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from brainshift_ros.errors import InputError
from brainshift_ros.units import mm_to_m
from brainshift_ros.yaml_files import read_yaml, validated

_EXAMPLE = "config/fiducials_example.yaml"

_Point = tuple[float, float, float]


class _Fiducial(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    name: str
    patient_mm: _Point
    tracker_mm: _Point


class _FiducialsFile(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    fiducials: list[_Fiducial] = Field(min_length=3)
    fle_mm: float | None = Field(default=None, gt=0.0, le=20.0)


class PairedFiducials(NamedTuple):
    """Fiducials in both frames, in the order of :func:`register_fiducials`'s arguments.

    Attributes
    ----------
    tracker, patient
        Shape (n, 3), metres, RAS+ in the patient frame.
    fle_m
        Their localisation error where the file gives it, metres.
    names
        One a fiducial.
    """

    tracker: NDArray[np.float64]
    patient: NDArray[np.float64]
    fle_m: float | None
    names: tuple[str, ...]


def read_fiducials(path: str | Path) -> PairedFiducials:
    """Read paired fiducials from YAML, millimetres, as in ``config/fiducials_example.yaml``.

    Raises
    ------
    InputError
        Missing, not YAML, an unknown or missing key, a name that comes twice.
    """
    content = validated(path, _FiducialsFile, read_yaml(path, "paired fiducials", _EXAMPLE), _EXAMPLE)
    names = tuple(fiducial.name for fiducial in content.fiducials)
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise InputError(path, f"names {', '.join(repeated)} come twice", "give each fiducial its own name")
    return PairedFiducials(
        tracker=mm_to_m([fiducial.tracker_mm for fiducial in content.fiducials]),
        patient=mm_to_m([fiducial.patient_mm for fiducial in content.fiducials]),
        fle_m=None if content.fle_mm is None else float(mm_to_m(content.fle_mm)),
        names=names,
    )
