"""A page for the surgeon: the cortex as scanned, its vessels, and where its points have gone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.files import atomic_path
from brainshift_ros.registration.opening import pixel_spacing
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.units import m_to_mm
from brainshift_ros.vessels.tracing import VesselTree

_VESSEL, _BRIDGE, _START, _END, _OBSTACLE = "#ffe066", "#7fe3ff", "#ffffff", "#39ff88", "#ff4fd8"

#: Standard deviations are drawn this much larger than the picture: true to scale they are about a pixel.
_SIGMA_SCALE = 5.0


def pixels_of(scan: OrganisedScan, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixel (column, row) in which a point would be seen, also where the scan has nothing or something nearer.

    The projection (3x4, by direct linear transform) is fitted to the scan's own pixel-to-point map: exact for a pinhole.

    Parameters
    ----------
    scan
        In the frame of the points.
    points
        Shape (n, 3), metres.

    Returns
    -------
    pixels
        Shape (n, 2).
    """
    rows, columns = np.nonzero(scan.seen)
    step = max(1, len(rows) // 4000)
    rows, columns = rows[::step], columns[::step]
    seen = scan.points[rows, columns].astype(np.float64)
    center, scale = seen.mean(axis=0), seen.std()
    middle, extent = np.array([columns.mean(), rows.mean()]), float(columns.std())
    X = np.concatenate([(seen - center) / scale, np.ones((len(seen), 1))], axis=1)
    x, y = ((np.stack([columns, rows], axis=-1) - middle) / extent).T
    zero = np.zeros_like(X)
    system = np.concatenate([np.hstack([X, zero, -x[:, None] * X]), np.hstack([zero, X, -y[:, None] * X])])
    _, vectors = np.linalg.eigh(system.T @ system)
    projection = vectors[:, 0].reshape(3, 4)
    ahead = np.concatenate([(np.reshape(points, (-1, 3)) - center) / scale, np.ones((np.size(points) // 3, 1))], axis=1)
    u, v, w = projection @ ahead.T
    return np.stack([u / w, v / w], axis=-1) * extent + middle


def scan_page(
    path: Path,
    first: OrganisedScan,
    vessels: VesselTree,
    later: OrganisedScan | None = None,
    homologous: HomologousPoints | None = None,
    *,
    first_obstacles: NDArray[np.bool_] | None = None,
    later_obstacles: NDArray[np.bool_] | None = None,
    title: str = "Laser range scan of the craniotomy",
) -> None:
    """Draw a scan with its traced vessels and, given a later scan, the motion of its homologous points with their sigmas.

    Parameters
    ----------
    path
        PNG to write.
    first
        First scan, in the frame of `homologous`.
    vessels
        Traced in the first scan.
    later, homologous
        Later scan and the points found in it, same frame.
    first_obstacles, later_obstacles
        Shape (H, W): pixels of either scan that are no cortex (instruments, a cavity); outlined.
    title
        Heading of the page.

    Raises
    ------
    InputError
        When only one of `later` and `homologous` is given, or obstacles are of another picture.
    """
    if (later is None) != (homologous is None):
        raise InputError("scan page", "a later scan without homologous points, or the reverse", "give both or neither")
    for scan, obstacles in ((first, first_obstacles), (later, later_obstacles)):
        if obstacles is not None and (scan is None or obstacles.shape != scan.seen.shape):
            raise InputError("scan page", f"obstacles of shape {obstacles.shape}", "give a mask of the scan's own pixels")
    panels = 1 if later is None else 2
    figure = Figure(figsize=(9.6 * panels, 8.1), facecolor="#101418", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, panels, squeeze=False)[0]
    figure.suptitle(title, color="white", fontsize=17)
    branches = len(vessels.branch_points)
    view = _view_around(vessels)
    _texture(axes[0], first, f"First scan: {m_to_mm(vessels.length_m):.0f} mm of vessels, {branches} branch points", view)
    _draw_vessels(axes[0], vessels)
    _draw_obstacles(axes[0], first_obstacles)
    if later is not None and homologous is not None:
        axes[0].plot(*pixels_of(first, homologous.points).T, "o", ms=5.5, mfc="none", mec=_END, mew=1.4)
        length_mm = m_to_mm(np.linalg.norm(homologous.displacements, axis=1))
        text = f"{len(length_mm)} homologous points"
        if len(length_mm):
            text += f", moved {length_mm.mean():.1f} mm on average, {length_mm.max():.1f} mm at most"
        corners = first.points[vessels.strength > 0].astype(np.float64)
        outline = pixels_of(later, corners[np.isfinite(corners).all(axis=1)][::50])
        _texture(axes[1], later, f"Later scan: {text}", _box(outline, 0.008 / pixel_spacing(later)))
        _draw_obstacles(axes[1], later_obstacles)
        _draw_motion(axes[1], later, homologous)
    legend = _legend(vessels, homologous, first_obstacles, later_obstacles)
    figure.legend(handles=legend, loc="outside lower center", ncols=len(legend), frameon=False, labelcolor="white", fontsize=11)
    with atomic_path(path) as part:
        figure.savefig(part, dpi=110, facecolor=figure.get_facecolor(), format="png")


def _box(pixels: NDArray[np.float64], margin: float) -> NDArray[np.float64]:
    """Bounds ((left, top), (right, bottom)) of (column, row) pixels, with a margin."""
    return np.stack([pixels.min(axis=0) - margin, pixels.max(axis=0) + margin])


def _view_around(vessels: VesselTree) -> NDArray[np.float64]:
    """Show the craniotomy, not the drape: where vessels were looked for."""
    rows, columns = np.nonzero(vessels.strength)
    if len(rows) == 0:
        return np.array([[0.0, 0.0], vessels.strength.shape[::-1]])
    return _box(np.stack([columns, rows], axis=-1).astype(np.float64), 0.008 / vessels.pixel_m)


def _texture(axes: Axes, scan: OrganisedScan, title: str, view: NDArray[np.float64]) -> None:
    rows, columns = scan.seen.shape
    (left, top), (right, bottom) = np.clip(view, 0.0, [columns, rows])
    axes.imshow(scan.rgb, interpolation="bilinear")
    axes.set_title(title, color="white", fontsize=13)
    axes.set_axis_off()
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    bar = 0.010 / pixel_spacing(scan)
    x, y = left + 0.04 * (right - left), bottom - 0.04 * (bottom - top)
    outline = [withStroke(linewidth=5, foreground="black")]
    axes.plot([x, x + bar], [y, y], color="white", lw=3, path_effects=outline)
    axes.text(x, y - 0.015 * (bottom - top), "10 mm", color="white", fontsize=12, path_effects=outline)


def _draw_vessels(axes: Axes, vessels: VesselTree) -> None:
    for bridged, color in ((False, _VESSEL), (True, _BRIDGE)):
        lines = [path.pixels[:, ::-1] for path in vessels.paths if path.bridged == bridged]
        axes.add_collection(LineCollection(lines, colors=color, linewidths=1.3, alpha=0.9))
    axes.plot(*vessels.branch_points[:, ::-1].T, ".", color=_VESSEL, ms=6, mec="black", mew=0.4)


def _draw_obstacles(axes: Axes, obstacles: NDArray[np.bool_] | None) -> None:
    if obstacles is not None and obstacles.any():
        axes.contour(obstacles.astype(float), levels=[0.5], colors=_OBSTACLE, linewidths=1.6)


def _draw_motion(axes: Axes, later: OrganisedScan, homologous: HomologousPoints) -> None:
    """Arrows in the later picture, from where each point was to where it is, each with a circle of its sigma."""
    start = pixels_of(later, homologous.points)
    end = pixels_of(later, homologous.points + homologous.displacements)
    for a, b in zip(start, end, strict=True):
        for color, width in (("black", 3.2), (_END, 1.5)):
            style = {"arrowstyle": "-|>", "color": color, "lw": width, "mutation_scale": 10, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", xy=b, xytext=a, arrowprops=style)
    axes.plot(*start.T, ".", color=_START, ms=4, mec="black", mew=0.3)
    diameter = 2.0 * _SIGMA_SCALE * homologous.sigma / pixel_spacing(later)
    for color, width in (("black", 2.2), (_START, 1.1)):
        circles = EllipseCollection(
            diameter, diameter, 0.0, units="x", offsets=end, offset_transform=axes.transData,
            facecolors="none", edgecolors=color, linewidths=width,
        )  # fmt: skip
        axes.add_collection(circles)


def _legend(vessels: VesselTree, homologous: HomologousPoints | None, *obstacles: NDArray[np.bool_] | None) -> list[Line2D]:
    handles = [Line2D([], [], color=_VESSEL, marker=".", lw=2, label="vessel, branch point")]
    if any(path.bridged for path in vessels.paths):
        handles.append(Line2D([], [], color=_BRIDGE, lw=2, label="gap in a vessel, bridged"))
    if homologous is not None:
        sigma = f"its standard deviation, {_SIGMA_SCALE:g} times"
        handles.append(Line2D([], [], color=_END, marker="o", mfc="none", lw=2, label="homologous point, its motion"))
        handles.append(Line2D([], [], color=_START, marker="o", mfc="none", ms=11, lw=0, label=sigma))
    if any(mask is not None and mask.any() for mask in obstacles):
        handles.append(Line2D([], [], color=_OBSTACLE, lw=2, label="no cortex"))
    return handles
