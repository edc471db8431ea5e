"""Figures of a shift: the MR before and after, the displacement in mm, measured and predicted vectors on the cortex."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.files import atomic_path
from brainshift_ros.geometry import unit
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.volume import Volume
from brainshift_ros.inverse.accuracy import shift_correction_percent
from brainshift_ros.pictures.slices import CONVENTION, grey_window, three_slices
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm

_MEASURED, _PREDICTED, _OUTLIER = "black", "magenta", "tab:orange"


def mr_before_after(path: str | Path, before: Volume, after: Volume, inverse: NDArray, centre: ArrayLike) -> None:
    """Three orthogonal slices of the MR before and after the update, with displacement contours, and their difference.

    Parameters
    ----------
    path
        PNG to write.
    before, after
        The MR and the updated MR on one grid.
    inverse
        Shape (I, J, K, 3), metres, on that grid: the displacement that brought tissue to each voxel (either sign).
    centre
        Shape (3,), metres, patient frame: where the three planes meet; a point with much shift shows most.
    """
    grid = Grid.of(after)
    low, high = grey_window(before)
    magnitude_mm = m_to_mm(np.linalg.norm(inverse, axis=-1))
    step = contour_step(float(magnitude_mm.max()))
    slices = three_slices(before, centre)
    heights = [float(np.ptp(plane.up_mm) / np.ptp(plane.across_mm)) for plane in slices]
    figure = Figure(figsize=(10.8, 3.6 * sum(heights) + 1.2), layout="constrained")
    cells = figure.add_gridspec(3, 3, height_ratios=heights)
    for row, plane in enumerate(slices):
        old, new = plane.sample(before.data, Grid.of(before)), plane.sample(after.data, grid)
        shift = plane.sample(magnitude_mm, grid)
        panels = [figure.add_subplot(cells[row, column]) for column in range(3)]
        panels[0].imshow(old, cmap="gray", vmin=low, vmax=high, origin="lower", extent=plane.extent)
        panels[1].imshow(new, cmap="gray", vmin=low, vmax=high, origin="lower", extent=plane.extent)
        levels = np.arange(step, max(float(shift.max()), step * 1.001), step)
        shown = np.where(new > 0.02 * high, shift, np.nan)
        lines = panels[1].contour(plane.across_mm, plane.up_mm, shown, levels, cmap="autumn_r", linewidths=0.8)
        panels[1].clabel(lines, fmt="%g", fontsize=6)
        panels[2].imshow(new - old, cmap="RdBu_r", vmin=-0.6 * high, vmax=0.6 * high, origin="lower", extent=plane.extent)
        titles = ("before surgery", f"updated; shift in mm every {step:g} mm", "updated - before")
        for panel, title in zip(panels, titles, strict=True):
            plane.prepare(panel, ink="black" if panel is panels[2] else "white")
            panel.set_title(f"{plane.title()}: {title}" if panel is panels[0] else title, fontsize=9)
    _save(figure, path, f"MR before and after the estimated shift ({CONVENTION})")


def displacement_map(
    path: str | Path, image: Volume, displacement: NDArray, inside: NDArray[np.bool_], centre: ArrayLike
) -> None:
    """Displacement of the brain in mm, in colour over three orthogonal slices, with in-plane arrows of true length.

    Parameters
    ----------
    path
        PNG to write.
    image
        The MR before surgery.
    displacement
        Shape (I, J, K, 3), metres, forward, on the grid of `image`.
    inside
        Shape (I, J, K), the brain.
    centre
        Shape (3,), metres, patient frame: where the three planes meet.
    """
    grid = Grid.of(image)
    low, high = grey_window(image)
    magnitude_mm = m_to_mm(np.linalg.norm(displacement, axis=-1))
    largest = float(magnitude_mm[inside].max()) if inside.any() else 0.0
    slices = three_slices(image, centre)
    figure = Figure(figsize=(14.0, 5.2), layout="constrained")
    shown = None
    for column, plane in enumerate(slices):
        panel = figure.add_subplot(1, 3, column + 1)
        panel.imshow(plane.sample(image.data, grid), cmap="gray", vmin=low, vmax=high, origin="lower", extent=plane.extent)
        in_brain = plane.sample(inside.astype(np.float32), grid) > 0.5
        shift = np.where(in_brain, plane.sample(magnitude_mm, grid), np.nan)
        shown = panel.imshow(
            shift, cmap="turbo", alpha=0.6, vmin=0.0, vmax=max(largest, 0.1), origin="lower", extent=plane.extent
        )
        _arrows_in_plane(panel, plane.across_mm, plane.up_mm, m_to_mm(plane.sample(displacement, grid)), in_brain, plane.axes)
        plane.prepare(panel)
        panel.set_title(plane.title(), fontsize=9)
    if shown is not None:
        figure.colorbar(shown, ax=figure.axes, shrink=0.8, pad=0.02, label="displacement (mm)")
    _save(figure, path, f"Estimated shift, largest {largest:.1f} mm; arrows in true length ({CONVENTION})")


def vectors_on_cortex(
    path: str | Path,
    surface: Surface,
    points: NDArray[np.float64],
    measured: NDArray[np.float64],
    predicted: NDArray[np.float64],
    used: NDArray[np.bool_] | None = None,
    radius_mm: float = 45.0,
) -> None:
    """Measured (black) and predicted (magenta) shift on the cortex: from above the craniotomy, and from its side.

    Most of a sag points into the brain, along the line of sight from above, so the second view shows its length.

    Parameters
    ----------
    path
        PNG to write.
    surface
        Cortical surface before the shift, patient frame.
    points, measured, predicted
        Shape (n, 3), metres: homologous points before the shift and their displacements.
    used
        Shape (n,), False for points that the estimate dropped (drawn orange); all used if None.
    radius_mm
        How much of the cortex around the points is shown.
    """
    used = np.ones(len(points), dtype=bool) if used is None else used
    centre = points.mean(axis=0)
    radius = max(radius_mm, float(m_to_mm(np.linalg.norm(points - centre, axis=1).max())) * 1.25)
    patch, outward = _patch(surface, centre, radius)
    front = np.array([0.0, 1.0, 0.0]) if abs(outward[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    up = unit(front - (front @ outward) * outward)
    figure = Figure(figsize=(13.0, 6.4), layout="constrained")
    views = (("seen from above the craniotomy", outward, up), ("seen from its side", unit(np.cross(up, outward)), outward))
    for position, (title, towards_viewer, upward) in enumerate(views):
        panel = figure.add_subplot(1, 2, position + 1)
        frame = np.stack([np.cross(upward, towards_viewer), upward, towards_viewer])
        _shaded(panel, m_to_mm((surface.vertices[patch] - centre) @ frame.T))
        at = m_to_mm((points - centre) @ frame.T)
        for vectors, rows, colour, width in (
            (measured, used, _MEASURED, 0.007),
            (measured, ~used, _OUTLIER, 0.007),
            (predicted, np.ones_like(used), _PREDICTED, 0.0035),  # thinner, so that what lies beneath still shows
        ):
            tips = m_to_mm(vectors @ frame.T)
            panel.quiver(
                at[rows, 0], at[rows, 1], tips[rows, 0], tips[rows, 1], color=colour, zorder=5,
                angles="xy", scale_units="xy", scale=1.0, width=width, headwidth=3.5, headlength=4.0,
            )  # fmt: skip
        _finish_view(panel, title, frame, radius)
    handles = [
        Line2D([], [], color=_MEASURED, lw=2, label="measured"),
        Line2D([], [], color=_PREDICTED, lw=2, label="predicted"),
    ]
    if not used.all():
        handles.append(Line2D([], [], color=_OUTLIER, lw=2, label="measured, dropped"))
    figure.axes[0].legend(handles=handles, loc="lower left", fontsize=9)
    shift_mm = m_to_mm(np.linalg.norm(measured[used], axis=1).mean())
    error_mm = m_to_mm(np.linalg.norm(measured - predicted, axis=1)[used].mean())
    correction = shift_correction_percent(measured[used], predicted[used])
    corrected = "" if correction is None else f", correction {correction:.0f} %"
    _save(
        figure,
        path,
        f"Shift of {int(used.sum())} points: mean {shift_mm:.1f} mm, error {error_mm:.1f} mm{corrected}; true length",
    )


def contour_step(largest_mm: float) -> float:
    """Return a round step, mm, that gives three to ten contours up to `largest_mm`."""
    for step in (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0):
        if largest_mm / step <= 10.0:
            return step
    return 10.0


def _arrows_in_plane(
    panel: Axes, across: NDArray, up: NDArray, vectors_mm: NDArray, mask: NDArray[np.bool_], axes: tuple[int, int, int]
) -> None:
    """Draw an arrow every 10 mm, as long as the displacement in the plane."""
    rows, columns = np.arange(5, up.size, 10), np.arange(5, across.size, 10)
    r, c = (index.ravel() for index in np.meshgrid(rows, columns, indexing="ij"))
    keep = mask[r, c] & (np.linalg.norm(vectors_mm[r, c], axis=-1) > 0.3)
    r, c = r[keep], c[keep]
    panel.quiver(
        across[c], up[r], vectors_mm[r, c, axes[0]], vectors_mm[r, c, axes[1]], color="white",
        angles="xy", scale_units="xy", scale=1.0, width=0.005, headwidth=3.5,
    )  # fmt: skip


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


def _save(figure: Figure, path: str | Path, title: str) -> None:
    figure.suptitle(title, fontsize=11)
    with matplotlib.rc_context({"savefig.dpi": 130}), atomic_path(path) as temporary:
        figure.savefig(temporary)
