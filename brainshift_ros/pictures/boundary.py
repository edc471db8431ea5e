"""Boundary conditions drawn on the surfaces they act on, as in the thesis, figures 5 and 31."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

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
    NodeKind.CONTACT: to_rgb("tab:purple"),
}

KIND_NAMES: Mapping[NodeKind, str] = {
    NodeKind.INTERIOR: "interior",
    NodeKind.FIXED: "fixed",
    NodeKind.SLIP: "slip",
    NodeKind.FREE: "stress-free",
    NodeKind.CAVITY: "cavity wall (stress-free)",
    NodeKind.CONTACT: "one-sided skull contact",
}

#: No flux, and atmospheric pressure.
PRESSURE_COLORS = (to_rgb("tab:blue"), to_rgb("tab:green"))

#: Rows of the figure: title, direction from the brain to the viewer, upward direction on the page, facets drawn.
VIEWS: tuple[tuple[str, tuple[float, float, float], tuple[float, float, float], tuple[str, ...]], ...] = (
    ("skull, from the front left", (-0.7, 0.7, 0.35), (0.0, 0.0, 1.0), ("skull",)),
    ("skull, from below", (0.0, 0.35, -1.0), (0.0, 1.0, 0.0), ("skull",)),
    ("septa, from the back left", (-0.8, -0.6, 0.3), (0.0, 0.0, 1.0), ("falx", "tentorium")),
    ("wall of the resected tumour, from the front left", (-0.7, 0.7, 0.35), (0.0, 0.0, 1.0), ("cavity",)),
)


@dataclass(frozen=True)
class BoundaryCase:
    """Boundary conditions of one head orientation.

    Attributes
    ----------
    title
        Heads the column.
    kinds
        Shape (N,), :class:`~brainshift_ros.mechanics.boundary.NodeKind` of each node.
    drained
        Pressure conditions by name: mask (N,) of the nodes at atmospheric pressure; no fluid passes the others.
    """

    title: str
    kinds: NDArray[np.uint8]
    drained: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)


def boundary_figure(mesh: TetMesh, cases: Sequence[BoundaryCase]) -> Figure:
    """Draw what the boundary nodes may do, a column a case, a row a view; then a row each pressure condition.

    Parameters
    ----------
    mesh
        The patient's mesh.
    cases
        One or more, with the same pressure conditions.
    """
    views = [view for view in VIEWS if any(len(mesh.facets.get(name, ())) for name in view[3])]
    drained = list(cases[0].drained)
    rows = len(views) + len(drained)
    figure = Figure(figsize=(4.0 * len(cases), 3.4 * rows + 0.5), layout="constrained")
    grid = figure.subplots(rows, len(cases), squeeze=False)
    for column, case in enumerate(cases):
        for row, (view, camera, up, names) in enumerate(views):
            facets = np.concatenate([mesh.facets[name] for name in names if name in mesh.facets])
            draw_kinds(grid[row, column], mesh.nodes, facets, case.kinds, camera, up)
            grid[row, column].set_title(f"{case.title}\n{view}" if row == 0 else view, fontsize=9)
        _, camera, up, _ = VIEWS[0]
        for axes, name in zip(grid[len(views) :, column], drained, strict=True):
            colors = np.array(PRESSURE_COLORS)[case.drained[name].astype(int)][mesh.facets["skull"]].mean(axis=1)
            draw_facets(axes, mesh.nodes, mesh.facets["skull"], colors, camera, up)
            axes.set_title(f"pressure, {name}", fontsize=9)
    shown = [kind for kind in NodeKind if kind is not NodeKind.INTERIOR and any((c.kinds == kind).any() for c in cases)]
    handles = [Patch(color=KIND_COLORS[kind], label=KIND_NAMES[kind]) for kind in shown]
    if drained:
        handles += [
            Patch(color=color, label=label)
            for color, label in zip(PRESSURE_COLORS, ("pressure: no flux", "pressure: atmospheric"), strict=True)
        ]
    figure.legend(handles=handles, loc="outside lower center", ncols=min(2 * len(cases), len(handles)), frameon=False)
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
