"""Figures of a shift: the MR before and after, the displacement in mm, measured and predicted vectors on the cortex."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.files import atomic_path
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.volume import Volume
from brainshift_ros.inverse.accuracy import shift_correction_percent
from brainshift_ros.pictures.slices import CONVENTION, grey_window, three_slices
from brainshift_ros.pictures.vectors import draw_vectors
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm


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
    figure = Figure(figsize=(13.0, 6.4), layout="constrained")
    draw_vectors(figure.subplots(1, 2), surface, points, measured, predicted, used, radius_mm)
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


def _save(figure: Figure, path: str | Path, title: str) -> None:
    figure.suptitle(title, fontsize=11)
    with matplotlib.rc_context({"savefig.dpi": 130}), atomic_path(path) as temporary:
        figure.savefig(temporary)
