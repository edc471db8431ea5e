"""Landmark files: what a person marks once on an image, in millimetres, and the code turns into labels and septa."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from brainshift_ros.yaml_files import read_yaml, validated

Point = Annotated[tuple[float, float, float], Field(description="mm, RAS")]
Polyline = Annotated[tuple[Point, ...], Field(min_length=2)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Plane(_Part):
    """A plane; the normal need not be a unit vector."""

    point: Point
    normal: Point

    def height_mm(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Signed distance along the normal, for points of shape (..., 3) in mm."""
        normal = np.asarray(self.normal)
        return (points_mm - np.asarray(self.point)) @ normal / float(np.linalg.norm(normal))


class FalxLandmarks(_Part):
    """The falx's periphery, besides the straight sinus."""

    outer_edge: Polyline = Field(description="from the torcula over the vertex to the crista galli, a little outside the brain")
    free_edge: Polyline = Field(description="from the crista galli back to the apex of the tentorial notch")


class TentoriumLandmarks(_Part):
    """One side's tentorium, besides the straight sinus."""

    attachment: Polyline = Field(description="from the torcula outward and along the petrous ridge, a little outside the brain")
    free_edge: Polyline = Field(description="from the petrous apex back to the apex of the tentorial notch")
    surface: tuple[Point, ...] = Field((), description="points of the sheet between its edges")

    def mirrored(self) -> TentoriumLandmarks:
        """Return the other side, in a symmetric head."""

        def flip(points: tuple[Point, ...]) -> tuple[Point, ...]:
            return tuple((-x, y, z) for x, y, z in points)

        return TentoriumLandmarks(attachment=flip(self.attachment), free_edge=flip(self.free_edge), surface=flip(self.surface))


class TentoriaLandmarks(_Part):
    """Both sides of the tentorium."""

    left: TentoriumLandmarks
    right: TentoriumLandmarks | Literal["mirrored"]

    @property
    def right_side(self) -> TentoriumLandmarks:
        """The right side, written out."""
        return self.left.mirrored() if self.right == "mirrored" else self.right


class SeptaLandmarks(_Part):
    """Falx and tentorium, which meet along the straight sinus."""

    straight_sinus: Polyline = Field(description="from the apex of the tentorial notch back to the torcula")
    falx: FalxLandmarks
    tentorium: TentoriaLandmarks


class Section(_Part):
    """A horizontal cross section of the brainstem."""

    z: float
    y_anterior: float
    y_posterior: float
    half_width: float = Field(gt=0.0)


class BrainstemLandmarks(_Part):
    """A tube of superelliptic sections, cut above by a plane."""

    top_plane: Plane
    exponent: float = Field(2.0, ge=1.0, le=10.0)
    sections: Annotated[tuple[Section, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _sections_descend(self) -> BrainstemLandmarks:
        heights = [section.z for section in self.sections]
        if sorted(heights, reverse=True) != heights or len(set(heights)) != len(heights):
            raise ValueError("sections must run from above down, each z once")
        return self


class TemplateLandmarks(_Part):
    """All that turns the template's T1 into labels and septa."""

    midsagittal_plane: Plane
    septa: SeptaLandmarks
    brainstem: BrainstemLandmarks


class _SeptaFile(_Part):
    septa: SeptaLandmarks


_EXAMPLE = "config/template_mni152.yaml"


def read_septa_landmarks(path: str | Path) -> SeptaLandmarks:
    """Read the `septa` part of a landmark file in mm of the patient frame.

    Raises
    ------
    InputError
        Missing, not YAML, or a key is unknown, missing or out of range; every fault is named.
    """
    content = read_yaml(path, "landmark file", _EXAMPLE)
    # A template's whole file will do: its other parts are left alone.
    part = {"septa": content["septa"]} if "septa" in content else content
    return validated(path, _SeptaFile, part, _EXAMPLE).septa


def read_template_landmarks(path: str | Path) -> TemplateLandmarks:
    """Read a template's whole landmark file; errors as for :func:`read_septa_landmarks`."""
    return validated(path, TemplateLandmarks, read_yaml(path, "landmark file", _EXAMPLE), _EXAMPLE)
