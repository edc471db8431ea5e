"""Measured and predicted displacement vectors on the cortex, as the thesis's figure 13 shows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from brainshift_ros.geometry import unit
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm

MEASURED, PREDICTED, OUTLIER = "black", "magenta", "tab:orange"


def draw_vectors(
    panels: Sequence[Axes],
    surface: Surface,
    points: NDArray[np.float64],
    measured: NDArray[np.float64],
    predicted: NDArray[np.float64],
    used: NDArray[np.bool_],
    radius_mm: float = 45.0,
) -> None:
    """Measured (black) and predicted (magenta) shift on the cortex: from above the craniotomy, and from its side.

    Parameters
    ----------
    panels
        Two axes.
    surface
        Cortical surface before the shift, patient frame.
    points, measured, predicted
        Shape (n, 3), metres: homologous points before the shift and their displacements; drawn in true length.
    used
        Shape (n,), False for points that the estimate dropped (drawn orange).
    radius_mm
        How much of the cortex around the points is shown, at least.
    """
    centre = points.mean(axis=0)
    radius = max(radius_mm, float(m_to_mm(np.linalg.norm(points - centre, axis=1).max())) * 1.25)
    patch, outward = _patch(surface, centre, radius)
    front = np.array([0.0, 1.0, 0.0]) if abs(outward[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    up = unit(front - (front @ outward) * outward)
    views = (("seen from above the craniotomy", outward, up), ("seen from its side", unit(np.cross(up, outward)), outward))
    for panel, (title, towards_viewer, upward) in zip(panels, views, strict=True):
        frame = np.stack([np.cross(upward, towards_viewer), upward, towards_viewer])
        _shaded(panel, m_to_mm((surface.vertices[patch] - centre) @ frame.T))
        at = m_to_mm((points - centre) @ frame.T)
        for vectors, rows, colour, width in (
            (measured, used, MEASURED, 0.007),
            (measured, ~used, OUTLIER, 0.007),
            (predicted, np.ones_like(used), PREDICTED, 0.0035),  # thinner, so that what lies beneath still shows
        ):
            tips = m_to_mm(vectors @ frame.T)
            panel.quiver(
                at[rows, 0], at[rows, 1], tips[rows, 0], tips[rows, 1], color=colour, zorder=5,
                angles="xy", scale_units="xy", scale=1.0, width=width, headwidth=3.5, headlength=4.0,
            )  # fmt: skip
        _finish_view(panel, title, frame, radius)
    handles = [
        Line2D([], [], color=MEASURED, lw=2, label="measured"),
        Line2D([], [], color=PREDICTED, lw=2, label="predicted"),
    ]
    if not used.all():
        handles.append(Line2D([], [], color=OUTLIER, lw=2, label="measured, dropped"))
    panels[0].legend(handles=handles, loc="lower left", fontsize=9)


def _patch(surface: Surface, centre: NDArray, radius_mm: float) -> tuple[NDArray, NDArray[np.float64]]:
    """Faces of the surface near the craniotomy that look outward, and the outward direction there."""
    triangles = surface.vertices[surface.faces]
    middle = triangles.mean(axis=1)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    distance_mm = m_to_mm(np.linalg.norm(middle - centre, axis=1))
    nearest = distance_mm <= max(0.5 * radius_mm, float(distance_mm.min()) + 5.0)
    outward = unit(normals[nearest].sum(axis=0))
    shown = (distance_mm <= radius_mm) & (normals @ outward > -0.2 * np.linalg.norm(normals, axis=1))
    return surface.faces[shown], outward


def _shaded(panel: Axes, triangles_mm: NDArray) -> None:
    """Triangles in view coordinates (x right, y up, z to the viewer), far ones first, lit from the upper left."""
    order = np.argsort(triangles_mm[:, :, 2].mean(axis=1))
    triangles = triangles_mm[order]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    light = unit([-0.4, 0.5, 0.8])
    brightness = 0.45 + 0.5 * np.clip(np.abs(normals @ light), 0.0, 1.0)
    colours = brightness[:, None] * np.array([[0.95, 0.80, 0.74]])
    panel.add_collection(
        PolyCollection(list(triangles[:, :, :2]), facecolors=colours, edgecolors=colours, linewidths=0.3, zorder=1)
    )


def _finish_view(panel: Axes, title: str, frame: NDArray, radius_mm: float) -> None:
    panel.set_xlim(-radius_mm - 4, radius_mm + 4)
    panel.set_ylim(-radius_mm - 4, radius_mm + 4)
    panel.set_aspect("equal")
    panel.set_xticks([])
    panel.set_yticks([])
    panel.set_title(title, fontsize=10)
    panel.plot([radius_mm - 20, radius_mm - 10], [-radius_mm] * 2, color="black", linewidth=2.5)
    panel.text(radius_mm - 15, -radius_mm + 1.5, "10 mm", ha="center", fontsize=8)
    corner = np.array([radius_mm - 8, radius_mm - 10])
    for axis, letters in enumerate((("L", "R"), ("P", "A"), ("I", "S"))):
        direction = frame[:2, axis]
        length = float(np.linalg.norm(direction))
        if length < 0.25:
            continue
        # Each axis is named by the end that it shows: R, A or S.
        (x, y), (dx, dy) = corner, direction
        panel.annotate("", (x + 9 * dx, y + 9 * dy), (x, y), arrowprops={"arrowstyle": "->", "color": "tab:blue"})
        panel.text(x + 12 * dx, y + 12 * dy, letters[1], color="tab:blue", ha="center", va="center", fontweight="bold")
