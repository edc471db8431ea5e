"""Boundary conditions drawn on the surfaces they act on, as in the thesis, figures 5 and 31."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.geometry import unit
from brainshift_ros.mechanics.boundary import NodeKind
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.units import m_to_mm

#: Colours of the thesis's figure 5; the cavity wall, which it does not show, in orange.
KIND_COLORS: Mapping[NodeKind, tuple[float, float, float]] = {
    NodeKind.INTERIOR: to_rgb("0.75"),
    NodeKind.FIXED: to_rgb("tab:blue"),
    NodeKind.SLIP: to_rgb("tab:green"),
    NodeKind.FREE: to_rgb("tab:red"),
    NodeKind.CAVITY: to_rgb("tab:orange"),
}

#: Rows of the figure: title, direction from the brain to the viewer, upward direction on the page, facets drawn.
VIEWS: tuple[tuple[str, tuple[float, float, float], tuple[float, float, float], tuple[str, ...]], ...] = (
    ("skull, from the front left", (-0.7, 0.7, 0.35), (0.0, 0.0, 1.0), ("skull",)),
    ("skull, from below", (0.0, 0.35, -1.0), (0.0, 1.0, 0.0), ("skull",)),
    ("septa, from the back left", (-0.8, -0.6, 0.3), (0.0, 0.0, 1.0), ("falx", "tentorium")),
)


def boundary_figure(mesh: TetMesh, cases: Sequence[tuple[str, NDArray[np.uint8]]]) -> Figure:
    """Draw the kinds of the boundary nodes, a column a case (a head orientation), a row a view.

    Parameters
    ----------
    mesh
        The patient's mesh.
    cases
        Title and :class:`~brainshift_ros.mechanics.boundary.NodeKind` (N,) of each case.
    """
    views = [view for view in VIEWS if any(len(mesh.facets.get(name, ())) for name in view[3])]
    figure = Figure(figsize=(4.0 * len(cases), 3.6 * len(views) + 0.4), layout="constrained")
    grid = figure.subplots(len(views), len(cases), squeeze=False)
    for column, (title, kinds) in enumerate(cases):
        for row, (view, camera, up, names) in enumerate(views):
            facets = np.concatenate([mesh.facets[name] for name in names if name in mesh.facets])
            draw_kinds(grid[row, column], mesh.nodes, facets, kinds, camera, up)
            grid[row, column].set_title(f"{title}\n{view}" if row == 0 else view, fontsize=9)
    shown = [kind for kind in NodeKind if kind is not NodeKind.INTERIOR and any((kinds == kind).any() for _, kinds in cases)]
    names_of = {"FREE": "stress-free", "CAVITY": "cavity wall (stress-free)"}
    handles = [Patch(color=KIND_COLORS[kind], label=names_of.get(kind.name, kind.name.lower())) for kind in shown]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    return figure


def draw_kinds(
    axes: Axes,
    nodes: NDArray[np.float64],
    facets: NDArray[np.int32],
    kinds: NDArray[np.uint8],
    camera: ArrayLike,
    up: ArrayLike,
) -> None:
    """Draw facets seen from a direction in parallel projection, shaded, each in the mean colour of its corners; axes in mm."""
    palette = np.array([KIND_COLORS[kind] for kind in NodeKind])
    draw_facets(axes, nodes, facets, palette[kinds][facets].mean(axis=1), camera, up)


def draw_facets(
    axes: Axes,
    nodes: NDArray[np.float64],
    facets: NDArray[np.int32],
    colors: NDArray[np.float64],
    camera: ArrayLike,
    up: ArrayLike,
) -> None:
    """Draw facets with colours (F, 3), far ones first (painter's algorithm), lit from the viewer."""
    toward = unit(camera)
    right = unit(np.cross(np.asarray(up, dtype=np.float64), toward))
    corners = nodes[facets]
    depth = corners.mean(axis=1) @ toward
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    light = 0.45 + 0.55 * np.abs(normal @ toward) / np.where(length > 0.0, length, 1.0)
    order = np.argsort(depth)
    page = m_to_mm(corners @ np.stack([right, np.cross(toward, right)], axis=1))
    shaded = np.clip(colors * light[:, None], 0.0, 1.0)[order]
    axes.add_collection(PolyCollection(list(page[order]), facecolors=shaded, edgecolors=shaded, linewidths=0.2))
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_axis_off()
