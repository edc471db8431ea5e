"""The scene: what acts in this surgery. What it leaves out is not modelled."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.cases import SWELLING_MARGIN_MM
from brainshift_ros.yaml_files import read_yaml, validated

_EXAMPLE = "config/scene_demo.yaml"

Vector = tuple[float, float, float]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Head(_Part):
    """Orientations of the head: which part of the brain is uppermost, free to move and open to the atmosphere."""

    direction: Vector = Field(description="unit vector along which gravity pulls, patient RAS")
    cone_deg: float = Field(20.0, ge=0.0, le=90.0, description="half angle of the cone of head orientations")
    orientations: int = Field(60, ge=1, le=2000)

    @field_validator("direction")
    @classmethod
    def _is_unit(cls, value: Vector) -> Vector:
        length = sum(component**2 for component in value) ** 0.5
        if not 0.99 <= length <= 1.01:
            raise ValueError(f"must be a unit vector, its length is {length:.4g}")
        return (value[0] / length, value[1] / length, value[2] / length)


class Gravity(Head):
    """Sag under gravity after cerebrospinal fluid drained (spec P9)."""

    fluid_levels: int = Field(3, ge=1, le=20)


class Mannitol(_Part):
    """Shrinkage by a hyperosmotic drug."""

    permeability_levels: int = Field(3, ge=1, le=20)


class Swelling(_Part):
    """Swelling of peritumoral tissue."""

    pressure_levels: int = Field(2, ge=1, le=20)
    margin_mm: float = Field(SWELLING_MARGIN_MM, ge=0.0, le=100.0, description="how far from the tumour tissue still swells")


class Craniotomy(_Part):
    """The opening of the skull."""

    center_mm: Vector = Field(description="a point on or near the cortex, patient RAS")
    diameter_mm: float = Field(gt=5.0, le=200.0)


class WeightSums(_Part):
    """Largest sum of the weights of entries that share it: 1 interpolates between them (3.9), (6.3); more extrapolates."""

    preoperative: Annotated[float, Field(gt=0.0, le=10.0, description="of all entries that are solved before surgery")] = 1.0
    retraction: Annotated[float, Field(gt=0.0, le=10.0, description="of the columns that a blade appends in surgery")] = 1.0


class Transient(_Part):
    """Time stepping of the consolidation model."""

    duration_s: float = Field(gt=0.0)
    dt_s: float = Field(gt=0.0)


class Model(_Part):
    """Discretisation and boundary model."""

    element: Literal["P1", "P2"] = "P1"
    time: Literal["steady"] | Transient = "steady"
    skull: Annotated[
        Literal["free_cap", "contact"],
        Field(description="above the demarcation: nothing holds the brain, or it may leave the skull but not cross it"),
    ] = "contact"


class Scene(_Part):
    """A validated scene file."""

    version: Literal[1] = Field(1, description="of the scene's format; a file may leave it out")
    gravity: Gravity | None = None
    head: Head | None = Field(None, description="in place of gravity, where it does not act")
    mannitol: Mannitol | None = None
    swelling: Swelling | None = None
    resection: Literal["none", "resected", "both"] = "none"
    septa: bool = True
    craniotomy: Craniotomy | None = None
    model: Model = Model()
    weight_sums: WeightSums = WeightSums()
    tolerance_mm: Annotated[float, Field(gt=0.0, le=50.0)] | None = None


def orientations_of(scene: Scene, source: object = "scene") -> Head:
    """Orientations of the head: those of gravity, or `head` where gravity does not act.

    The drug and the swelling need them as well: the orientation decides which part of the brain is free to move and drained.

    Raises
    ------
    InputError
        The scene names no mechanism, or gives the orientations twice or not at all.
    """
    if scene.gravity is None and scene.mannitol is None and scene.swelling is None:
        raise InputError(source, "names no mechanism", "give at least one of gravity, mannitol, swelling")
    if scene.gravity is not None and scene.head is not None:
        raise InputError(source, "gives both gravity and head", "leave head out: gravity says how the head lies")
    found = scene.gravity or scene.head
    if found is None:
        problem = "does not say how the head lies, which decides where the brain is free to move and drained"
        raise InputError(source, problem, "give head: {direction: [x, y, z]}, the way gravity would pull, or gravity itself")
    return found


def read_scene(path: str | Path) -> Scene:
    """Read and validate a scene.

    Raises
    ------
    InputError
        The file is missing, is not YAML, or a key is unknown, missing or out of range; every fault is named.
    """
    scene = validated(path, Scene, read_yaml(path, "scene file", _EXAMPLE), _EXAMPLE)
    orientations_of(scene, path)
    return scene
