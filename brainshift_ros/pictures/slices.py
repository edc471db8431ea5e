"""Orthogonal slices in patient axes, with the labels and scale that a reader of MR expects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.image.grid import Grid, trilinear
from brainshift_ros.image.volume import Volume
from brainshift_ros.units import m_to_mm, mm_to_m

#: Said on every figure of slices.
CONVENTION = "radiological view: the patient's right is on the left of the picture"

_AXES = {"axial": (0, 1, 2), "coronal": (0, 2, 1), "sagittal": (1, 2, 0)}
_AXIS_ENDS = (("L", "R"), ("P", "A"), ("I", "S"))


@dataclass(frozen=True)
class Slice:
    """One plane through the patient, sampled every millimetre.

    Attributes
    ----------
    plane
        ``axial``, ``coronal`` or ``sagittal``.
    across_mm, up_mm
        Shapes (w,) and (h,): patient coordinates of the columns, and of the rows from bottom to top.
    depth_mm
        Patient coordinate of the plane along its normal.
    """

    plane: str
    across_mm: NDArray[np.float64]
    up_mm: NDArray[np.float64]
    depth_mm: float

    @staticmethod
    def through(plane: str, centre: ArrayLike, low: ArrayLike, high: ArrayLike) -> Slice:
        """Return the plane through `centre` that spans the box from `low` to `high`; all shape (3,), metres."""
        a, b, normal = _AXES[plane]
        low_mm, high_mm = np.floor(m_to_mm(low)), np.ceil(m_to_mm(high))
        across, up = np.arange(low_mm[a], high_mm[a] + 1), np.arange(low_mm[b], high_mm[b] + 1)
        return Slice(plane, across, up, float(m_to_mm(np.asarray(centre)[normal])))

    @property
    def axes(self) -> tuple[int, int, int]:
        """Patient axes across, up, and along the normal."""
        return _AXES[self.plane]

    def points(self) -> NDArray[np.float64]:
        """Shape (h, w, 3), metres."""
        a, b, normal = self.axes
        points = np.empty((self.up_mm.size, self.across_mm.size, 3))
        points[..., a], points[..., b], points[..., normal] = self.across_mm[None, :], self.up_mm[:, None], self.depth_mm
        return mm_to_m(points)

    def sample(self, data: NDArray, grid: Grid) -> NDArray[np.float32]:
        """Values of an image (I, J, K) or vector image (I, J, K, C) on the plane, linear, zero outside."""
        vectors = data if data.ndim == 4 else data[..., None]
        points = self.points()
        voxels = grid.to_voxels(points.reshape(-1, 3))
        values = trilinear(vectors, voxels).reshape(*points.shape[:2], -1)
        values[((voxels < -0.5) | (voxels > np.array(grid.shape) - 0.5)).any(axis=1).reshape(points.shape[:2])] = 0.0
        return values if data.ndim == 4 else values[..., 0]

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom, top for ``imshow(origin="lower")``, mm."""
        return (self.across_mm[0] - 0.5, self.across_mm[-1] + 0.5, self.up_mm[0] - 0.5, self.up_mm[-1] + 0.5)

    def prepare(self, axes: Axes, ink: str = "white") -> None:
        """Set view, letters and scale bar in `ink`: patient's right on the left; anterior on the left of sagittal."""
        left, right, bottom, top = self.extent
        # Both R (+x) and A (+y) go to the left of the picture.
        axes.set_xlim(right, left)
        axes.set_ylim(bottom, top)
        axes.set_aspect("equal")
        axes.set_facecolor("black")
        axes.set_xticks([])
        axes.set_yticks([])
        a, b, _ = self.axes
        outline = [withStroke(linewidth=2.0, foreground="black" if ink == "white" else "white")]
        style: dict[str, Any] = {
            "color": ink,
            "fontsize": 11,
            "fontweight": "bold",
            "path_effects": outline,
            "transform": axes.transAxes,
        }
        axes.text(0.02, 0.5, _AXIS_ENDS[a][1], ha="left", va="center", **style)
        axes.text(0.98, 0.5, _AXIS_ENDS[a][0], ha="right", va="center", **style)
        axes.text(0.5, 0.98, _AXIS_ENDS[b][1], ha="center", va="top", **style)
        axes.text(0.5, 0.02, _AXIS_ENDS[b][0], ha="center", va="bottom", **style)
        start = right - 0.04 * (right - left)
        axes.plot([start, start - 20], [bottom + 4, bottom + 4], color=ink, linewidth=2, path_effects=outline)
        axes.text(start - 10, bottom + 6, "20 mm", color=ink, fontsize=7, ha="center", path_effects=outline)

    def title(self) -> str:
        """Name and place of the plane."""
        low, high = _AXIS_ENDS[self.axes[2]]
        return f"{self.plane}, {abs(self.depth_mm):.0f} mm {high if self.depth_mm >= 0 else low}"


def three_slices(image: Volume, centre: ArrayLike, margin_mm: float = 8.0) -> tuple[Slice, ...]:
    """Return the axial, coronal and sagittal plane through a point, cropped to what the image shows."""
    grid = Grid.of(image)
    shown = np.argwhere(image.data[::2, ::2, ::2] > 0.05 * float(image.data.max())) * 2
    corners = grid.centres(shown if shown.size else np.argwhere(np.ones((2, 2, 2))) * (np.array(image.shape) - 1))
    margin = float(mm_to_m(margin_mm))
    low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    return tuple(Slice.through(plane, centre, low, high) for plane in _AXES)


def grey_window(image: Volume) -> tuple[float, float]:
    """Black and white level of an MR: zero (or its minimum) and nearly its brightest tissue."""
    values = image.data[image.data > 0]
    return min(0.0, float(image.data.min())), float(np.percentile(values, 99.5)) if values.size else 1.0
