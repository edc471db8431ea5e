"""One page on a patient model: septa and regions on the MR, the mesh cut open, the septa in space, mesh quality."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import cast

import numpy as np
import pyvista as pv
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

from brainshift_ros.files import atomic_path
from brainshift_ros.geometry import unit
from brainshift_ros.image.resample import sample
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.mesh.patient import PatientModel, Tissue
from brainshift_ros.mesh.quality import LIMITS, dihedral_angles_deg
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import polydata
from brainshift_ros.units import m_to_mm, mm_to_m

SEPTA_COLOURS = {"falx": "#ff9d00", "tentorium": "#e5006d"}
TISSUE_COLOURS = {Tissue.WHITE: "#e9e4d4", Tissue.GREY: "#a9a3a0", Tissue.TUMOR: "#c0392b"}
REGION_COLOURS = {
    Region.LEFT_CEREBRUM: "#31c6d4",
    Region.RIGHT_CEREBRUM: "#3d7eff",
    Region.CEREBELLUM: "#35c46a",
    Region.BRAINSTEM: "#ffd23f",
    Region.TUMOR: "#ff4d4d",
}
#: A slice in the falx itself would show nothing but the falx.
BESIDE_FALX_M = 0.004

_PLANES = {0: ("sagittal", "y", "z"), 1: ("coronal", "x", "z"), 2: ("axial", "x", "y")}


def patient_page(patient: PatientModel, t1: Volume, labels: Volume, path: str | Path) -> None:
    """Draw the page and write it as PNG (or whatever the suffix says).

    Parameters
    ----------
    patient
        With septa or without.
    t1
        The MR that the model was made from.
    labels
        The label image that the model was made from, on any grid.
    path
        Output file.
    """
    figure = Figure(figsize=(25, 12), layout="constrained")
    grid = figure.add_gridspec(2, 4, width_ratios=(1.0, 1.0, 1.0, 0.55))
    at = _places(patient)
    window = _grey_window(patient, t1)
    for axis in range(3):
        draw_slice(figure.add_subplot(grid[0, axis]), patient, t1, labels, axis, at[axis], window)
    for column, axis in enumerate((1, 2)):
        draw_cut(figure.add_subplot(grid[1, column]), patient, axis, _centre(patient)[axis])
    _draw_septa_in_space(cast(Axes3D, figure.add_subplot(grid[1, 2], projection="3d")), patient)
    _draw_quality(figure.add_subplot(grid[0, 3]), patient)
    _write_figures(figure.add_subplot(grid[1, 3]), patient)
    present = [region for region in REGION_COLOURS if np.any(patient.mesh.region == region)]
    handles: list[Artist] = [
        Patch(color=REGION_COLOURS[region], label=region.name.lower().replace("_", " ")) for region in present
    ]
    handles += [Patch(color=colour, label=name) for name, colour in SEPTA_COLOURS.items() if name in patient.mesh.facets]
    handles += [
        Line2D([], [], color="white", linewidth=1.5, label="label image"),
        Line2D([], [], color=REGION_COLOURS[Region.LEFT_CEREBRUM], linestyle="--", label="the mesh's outline"),
    ]
    legend = figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=True)
    legend.get_frame().set_facecolor("#d0cdc8")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=80)


def draw_slice(
    axes: Axes, patient: PatientModel, t1: Volume, labels: Volume, axis: int, at: float, window: tuple[float, float]
) -> None:
    """Show the MR on the plane where coordinate `axis` equals `at` (metres), with contours of labels, mesh and septa.

    Solid lines are the borders of the label image, dashed ones those of the mesh; `window` is the intensity range shown.
    """
    first, second = (k for k in range(3) if k != axis)
    low, high = patient.mesh.nodes.min(axis=0) - 0.008, patient.mesh.nodes.max(axis=0) + 0.008
    u, v = (np.arange(low[k], high[k], 0.0007) for k in (first, second))
    points = np.zeros((len(v), len(u), 3))
    points[..., axis], points[..., first], points[..., second] = at, u[None, :], v[:, None]
    extent = (float(m_to_mm(u[0])), float(m_to_mm(u[-1])), float(m_to_mm(v[0])), float(m_to_mm(v[-1])))
    axes.imshow(sample(t1, points), cmap="gray", origin="lower", extent=extent, vmin=window[0], vmax=window[1])
    shown, section = sample(labels, points, "nearest"), _section(patient, axis, at)
    for region, colour in REGION_COLOURS.items():
        if np.any(shown == region):
            axes.contour(m_to_mm(u), m_to_mm(v), shown == region, levels=[0.5], colors=colour, linewidths=0.9)
        edges = _outline(section, region)
        axes.add_collection(LineCollection(_segments(edges, first, second), colors=colour, linewidths=0.8, linestyles="--"))
    _draw_septa_lines(axes, patient, axis, at)
    _name_plane(axes, axis, at)


def _outline(section: pv.PolyData, region: Region) -> pv.PolyData:
    cells = section.extract_cells(section.cell_data["region"] == region)
    return cells.extract_surface(algorithm=None).extract_feature_edges(
        boundary_edges=True, feature_edges=False, manifold_edges=False, non_manifold_edges=False
    )


def draw_cut(axes: Axes, patient: PatientModel, axis: int, at: float) -> None:
    """Show the elements cut by a plane, coloured by tissue, with the septa."""
    first, second = (k for k in range(3) if k != axis)
    section = _section(patient, axis, at)
    points = m_to_mm(section.points[:, [first, second]])
    polygons = [points[cell.point_ids] for cell in section.cell]
    colours = [to_rgb(TISSUE_COLOURS[Tissue(t)]) for t in section.cell_data["tissue"]]
    axes.add_collection(PolyCollection(polygons, facecolors=colours, edgecolors="#5b5550", linewidths=0.25))
    _draw_septa_lines(axes, patient, axis, at)
    axes.set_aspect("equal")
    axes.autoscale_view()
    _name_plane(axes, axis, at)


def _places(patient: PatientModel) -> NDArray[np.float64]:
    """Where the slices lie: beside the falx, through the tentorium, through the tumour; else through the centre."""
    mesh, at = patient.mesh, _centre(patient)
    if "falx" in mesh.facets:
        at[0] = mesh.nodes[mesh.facets["falx"]].mean(axis=(0, 1))[0] + BESIDE_FALX_M
    if "tentorium" in mesh.facets:
        at[1] = mesh.nodes[mesh.facets["tentorium"]].mean(axis=(0, 1))[1]
    return at


def _grey_window(patient: PatientModel, t1: Volume) -> tuple[float, float]:
    """Intensities between which the MR is shown: a scalp is brighter than any brain."""
    centroids = patient.mesh.nodes[patient.mesh.elements].mean(axis=1)
    return 0.0, float(1.15 * np.percentile(sample(t1, centroids), 99.0))


def _centre(patient: PatientModel) -> NDArray[np.float64]:
    """Where to cut: through the tumour if there is one."""
    mesh = patient.mesh
    tumor = mesh.region == Region.TUMOR
    chosen = mesh.elements[tumor] if tumor.any() else mesh.elements
    centre: NDArray[np.float64] = mesh.nodes[chosen].mean(axis=(0, 1))
    return centre


def _section(patient: PatientModel, axis: int, at: float) -> pv.PolyData:
    mesh = patient.mesh
    cells = {pv.CellType.TETRA: mesh.elements.astype(np.int64)}
    grid = pv.UnstructuredGrid(cells, mesh.nodes)
    grid.cell_data["region"], grid.cell_data["tissue"] = mesh.region, patient.tissue
    # half a micrometre off: a plane through nodes, as the midsagittal one, would cut nothing
    return grid.slice(normal=np.eye(3)[axis], origin=np.eye(3)[axis] * (at + 5e-7), generate_triangles=False)


def _draw_septa_lines(axes: Axes, patient: PatientModel, axis: int, at: float) -> None:
    first, second = (k for k in range(3) if k != axis)
    for name, colour in SEPTA_COLOURS.items():
        if name in patient.mesh.facets:
            sheet = polydata(Surface(patient.mesh.nodes, patient.mesh.facets[name]))
            lines = sheet.slice(normal=np.eye(3)[axis], origin=np.eye(3)[axis] * (at + 5e-7))
            axes.add_collection(LineCollection(_segments(lines, first, second), colors=colour, linewidths=2.2))


def _segments(lines: pv.PolyData, first: int, second: int) -> list[NDArray[np.float64]]:
    if lines.n_cells == 0:
        return []
    return list(m_to_mm(lines.points[:, [first, second]])[lines.lines.reshape(-1, 3)[:, 1:]])


def _name_plane(axes: Axes, axis: int, at: float) -> None:
    name, horizontal, vertical = _PLANES[axis]
    axes.set_title(f"{name}, {'xyz'[axis]} = {float(m_to_mm(at)):.0f} mm", fontsize=10)
    axes.set_xlabel(f"{horizontal} (mm, RAS)")
    axes.set_ylabel(f"{vertical} (mm, RAS)")


#: Where the light comes from; of length one.
_LIGHT = unit([-0.7, -0.3, 0.65])


def _draw_septa_in_space(axes: Axes3D, patient: PatientModel) -> None:
    mesh = patient.mesh
    skull = mesh.facets["skull"]
    shown = skull[mesh.nodes[skull].mean(axis=1)[:, 0] > mm_to_m(2.0)]
    parts = [(shown, "#c9c2bb", 0.10)]
    parts += [(mesh.facets[name], colour, 0.95) for name, colour in SEPTA_COLOURS.items() if name in mesh.facets]
    if "tumor" in mesh.facets:
        parts.append((mesh.facets["tumor"], TISSUE_COLOURS[Tissue.TUMOR], 0.9))
    for facets, colour, alpha in parts:
        triangles = m_to_mm(mesh.nodes[facets])
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        light = np.abs(normals @ _LIGHT) / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
        light = np.minimum(light, 1.0)  # round-off
        shade = np.outer(0.45 + 0.55 * light, to_rgb(colour))
        axes.add_collection3d(Poly3DCollection(triangles, facecolors=np.column_stack([shade, np.full(len(shade), alpha)])))
    low, high = m_to_mm(mesh.nodes.min(axis=0)), m_to_mm(mesh.nodes.max(axis=0))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]), box_aspect=high - low)
    axes.view_init(elev=18, azim=-155)
    axes.set_axis_off()
    axes.set_title("septa in the mesh, from the left and behind", fontsize=10)


def _draw_quality(axes: Axes, patient: PatientModel) -> None:
    angles = dihedral_angles_deg(patient.mesh.nodes, patient.mesh.elements).min(axis=1)
    limit = LIMITS["dihedral_min_deg"][0]
    axes.hist(angles, bins=36, range=(0.0, 72.0), color="#5b7fa6")
    axes.axvline(limit, color="#c0392b", linewidth=1.5)
    axes.set_title(
        f"smallest dihedral angle of each element\nsmallest of all {angles.min():.1f}°, allowed {limit:g}°", fontsize=10
    )
    axes.set_xlabel("degrees")
    axes.set_ylabel("elements")


def _write_figures(axes: Axes, patient: PatientModel) -> None:
    axes.set_axis_off()
    lines = [f"{name:34} {value:10.4g}" for name, value in patient.quality.items()]
    text = "\n".join([patient.image.name, "", *lines, "", *(fill(f"! {warning}", 46) for warning in patient.warnings)])
    written = axes.text(0.0, 1.0, text, va="top", family="monospace", fontsize=7.0, transform=axes.transAxes)
    written.set_in_layout(False)  # a long list must not make the pictures small
