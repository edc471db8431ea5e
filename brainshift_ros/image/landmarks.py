"""Landmark files: what a person marks once on an image, in millimetres, and the code turns into labels and septa."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from brainshift_ros.errors import InputError
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

    def projected_mm(self, points_mm: ArrayLike) -> NDArray[np.float64]:
        """Closest points of the plane, shape (n, 3), mm."""
        points = np.asarray(points_mm, dtype=np.float64)
        normal = np.asarray(self.normal) / float(np.linalg.norm(self.normal))
        return points - self.height_mm(points)[..., None] * normal

    @model_validator(mode="after")
    def _normal_has_a_direction(self) -> Plane:
        if not any(self.normal):
            raise ValueError("the normal is zero")
        return self


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


class FalxSketch(_Part):
    """The falx's periphery as drawn on the mid-sagittal slice, besides the straight sinus."""

    outer_edge: Annotated[tuple[Point, ...], Field(min_length=3, description="as in FalxLandmarks; on the skull will do")]
    free_edge: Annotated[tuple[Point, ...], Field(min_length=3, description="as in FalxLandmarks")]


class TentoriumSketch(_Part):
    """One side's tentorium as a plane, clipped, and the points that it is morphed onto."""

    plane: tuple[Point, Point, Point] = Field(description="three points of the plane that the sheet is clipped from")
    outline: Annotated[
        tuple[Point, ...], Field(min_length=3, description="outer clip, from the torcula along the skull to the petrous apex")
    ]
    notch: Annotated[
        tuple[Point, ...], Field(min_length=2, description="inner clip, from the petrous apex back to the notch's apex")
    ]
    targets: Annotated[tuple[Point, ...], Field(min_length=3, description="points of the tentorium, in any order")]

    @model_validator(mode="after")
    def _points_span_a_plane(self) -> TentoriumSketch:
        if np.linalg.norm(self.normal_up) == 0.0:
            raise ValueError("the plane's three points lie on a line")
        return self

    @property
    def normal_up(self) -> NDArray[np.float64]:
        """Unit normal of the plane, shape (3,), pointing up; zero if the three points lie (within 6 degrees) on a line."""
        a, b, c = np.asarray(self.plane)
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length <= 0.1 * float(np.linalg.norm(b - a) * np.linalg.norm(c - a)):
            return np.zeros(3)
        return normal / length * (1.0 if normal[2] >= 0.0 else -1.0)

    def mirrored(self, plane: Plane) -> TentoriumSketch:
        """Return the other side, in a head that is symmetric about a plane."""

        def flip(points: tuple[Point, ...]) -> list[list[float]]:
            return (2.0 * plane.projected_mm(points) - np.asarray(points)).tolist()

        return TentoriumSketch.model_validate({name: flip(getattr(self, name)) for name in type(self).model_fields})


class TentoriaSketch(_Part):
    """Both sides of the tentorium."""

    left: TentoriumSketch
    right: TentoriumSketch | Literal["mirrored"]


class SeptaSketch(_Part):
    """Falx and tentorium by the semi-automatic method of the thesis (figures 1 and 2)."""

    midsagittal_plane: Plane = Field(description="the slice that the falx was drawn on; its normal points right")
    straight_sinus: Polyline = Field(description="from the apex of the tentorial notch back to the torcula")
    falx: FalxSketch
    tentorium: TentoriaSketch

    @property
    def sides(self) -> tuple[TentoriumSketch, TentoriumSketch]:
        """Left and right tentorium, written out."""
        left, right = self.tentorium.left, self.tentorium.right
        return left, left.mirrored(self.midsagittal_plane) if right == "mirrored" else right


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


class _SketchFile(_Part):
    septa_sketch: SeptaSketch


_EXAMPLE = "config/template_mni152.yaml"
_SKETCH_EXAMPLE = "config/septa_example.yaml"


def read_septa_landmarks(path: str | Path) -> SeptaLandmarks | SeptaSketch:
    """Read the septa of a landmark file in mm of the patient frame: full landmarks, or the sketch of a semi-automatic method.

    Raises
    ------
    InputError
        Missing, not YAML, of neither style or of both, or a key is unknown, missing or out of range; every fault is named.
    """
    content = read_yaml(path, "landmark file", _SKETCH_EXAMPLE)
    if "septa" in content and "septa_sketch" in content:
        problem = "holds both `septa` and `septa_sketch`"
        raise InputError(path, problem, "keep one: full landmarks (`septa`) or the semi-automatic style (`septa_sketch`)")
    if "septa_sketch" in content:
        return validated(path, _SketchFile, content, _SKETCH_EXAMPLE).septa_sketch
    # A template's whole file will do: its other parts are left alone.
    part = {"septa": content["septa"]} if "septa" in content else content
    return validated(path, _SeptaFile, part, _EXAMPLE).septa


def read_template_landmarks(path: str | Path) -> TemplateLandmarks:
    """Read a template's whole landmark file; errors as for :func:`read_septa_landmarks`."""
    return validated(path, TemplateLandmarks, read_yaml(path, "landmark file", _EXAMPLE), _EXAMPLE)
