"""The scene: what acts in this surgery. What it leaves out is not modelled."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from brainshift_ros.errors import InputError
from brainshift_ros.files import existing_file

SCHEMA = "brainshift/scene/1"

Vector = tuple[float, float, float]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Gravity(_Part):
    """Sag under gravity after cerebrospinal fluid drained (spec P9)."""

    direction: Vector = Field(description="unit vector along which gravity pulls, patient RAS")
    cone_deg: float = Field(20.0, ge=0.0, le=90.0, description="half angle of the cone of head orientations")
    orientations: int = Field(60, ge=1, le=2000)
    fluid_levels: int = Field(3, ge=1, le=20)

    @field_validator("direction")
    @classmethod
    def _is_unit(cls, value: Vector) -> Vector:
        length = sum(component**2 for component in value) ** 0.5
        if not 0.99 <= length <= 1.01:
            raise ValueError(f"must be a unit vector, its length is {length:.4g}")
        return (value[0] / length, value[1] / length, value[2] / length)


class Mannitol(_Part):
    """Shrinkage by a hyperosmotic drug."""

    permeability_levels: int = Field(3, ge=1, le=20)


class Swelling(_Part):
    """Swelling of peritumoral tissue."""

    pressure_levels: int = Field(2, ge=1, le=20)


class Craniotomy(_Part):
    """The opening of the skull."""

    center_mm: Vector = Field(description="a point on or near the cortex, patient RAS")
    diameter_mm: float = Field(gt=5.0, le=200.0)


class Transient(_Part):
    """Time stepping of the consolidation model."""

    duration_s: float = Field(gt=0.0)
    dt_s: float = Field(gt=0.0)


class Model(_Part):
    """Discretisation and boundary model."""

    element: Literal["P1", "P2"] = "P1"
    time: Literal["steady"] | Transient = "steady"
    skull: Literal["free_cap", "contact"] = "free_cap"


class Scene(_Part):
    """A validated scene file."""

    gravity: Gravity | None = None
    mannitol: Mannitol | None = None
    swelling: Swelling | None = None
    resection: Literal["none", "resected", "both"] = "none"
    septa: bool = True
    craniotomy: Craniotomy | None = None
    model: Model = Model()
    tolerance_mm: Annotated[float, Field(gt=0.0, le=50.0)] | None = None


def read_scene(path: str | Path) -> Scene:
    """Read and validate a scene.

    Raises
    ------
    InputError
        The file is missing, is not YAML, or a key is unknown, missing or out of range; every fault is named.
    """
    path = existing_file(path, "scene file (YAML)")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(path, f"is not YAML: {error}", "see config/scene_demo.yaml for an example") from error
    if not isinstance(content, dict):
        raise InputError(path, "holds no keys", "see config/scene_demo.yaml for an example")
    try:
        scene = Scene.model_validate(content)
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise InputError(path, faults, "mend these keys; config/scene_demo.yaml shows them all") from error
    if scene.gravity is None and scene.mannitol is None and scene.swelling is None:
        raise InputError(path, "names no mechanism", "give at least one of gravity, mannitol, swelling")
    return scene
