"""The scene: what acts in this surgery. What it leaves out is not modelled."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from brainshift_ros.errors import InputError
from brainshift_ros.yaml_files import read_yaml, validated

_EXAMPLE = "config/scene_demo.yaml"

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

    version: Literal[1] = Field(1, description="of the scene's format; a file may leave it out")
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
    scene = validated(path, Scene, read_yaml(path, "scene file", _EXAMPLE), _EXAMPLE)
    if scene.gravity is None and scene.mannitol is None and scene.swelling is None:
        raise InputError(path, "names no mechanism", "give at least one of gravity, mannitol, swelling")
    return scene
