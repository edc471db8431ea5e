"""One page on an estimate: vectors on the cortex (figure 13), weights by mechanism (figure 17), and the residuals."""

from __future__ import annotations

import textwrap
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brainshift_ros.files import atomic_path
from brainshift_ros.inverse.shift_estimate import EntryWeight, ShiftEstimate
from brainshift_ros.pictures.vectors import MEASURED, OUTLIER, draw_vectors
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import m_to_mm

#: Colour of each mechanism; what else an atlas may hold is grey.
_COLOURS = {"gravity": "tab:blue", "mannitol": "tab:green", "swelling": "tab:purple", "retraction": "tab:red"}

#: Bars of single weights, at most: constrained fits have 1 to 10 of them, unconstrained ones as many as the atlas.
_MOST_BARS = 12


def estimate_page(path: str | Path, estimate: ShiftEstimate) -> None:
    """Write :func:`draw_estimate` as PNG."""
    figure = draw_estimate(estimate)
    with matplotlib.rc_context({"savefig.dpi": 120}), atomic_path(path) as temporary:
        figure.savefig(temporary)


def draw_estimate(estimate: ShiftEstimate) -> Figure:
    """Draw an estimate for the person who is to trust it; where it is not valid the heading says so in red.

    The cortex is the atlas mesh's outer surface, before the shift.
    """
    figure = Figure(figsize=(13.0, 11.0), layout="constrained")
    rows = figure.add_gridspec(2, 1, height_ratios=[1.25, 1.0])
    upper, lower = (figure.add_subfigure(rows[row, 0]) for row in (0, 1))
    mesh = estimate.field.mesh
    draw_vectors(
        [upper.add_subplot(1, 2, column) for column in (1, 2)],
        Surface(mesh.nodes, mesh.facets["skull"]),
        estimate.points,
        estimate.measured,
        estimate.estimated,
        estimate.used,
    )
    cells = lower.add_gridspec(1, 3, width_ratios=[1.0, 1.7, 1.15])
    for column, draw in enumerate((_draw_mechanisms, _draw_weights, _draw_residuals)):
        draw(lower.add_subplot(cells[0, column]), estimate)
    figure.suptitle(_heading(estimate), fontsize=11, color="black" if estimate.valid else "tab:red")
    return figure


def _heading(estimate: ShiftEstimate) -> str:
    """Verdict, then the figures that the thesis reports of a case."""
    verdict = "valid" if estimate.valid else "NOT VALID: " + "; ".join(estimate.reasons)
    shift_mm = m_to_mm(np.linalg.norm(estimate.measured[estimate.used], axis=1).mean())
    figures = [
        f"shift of {int(estimate.used.sum())} of {estimate.points_offered} points: mean {shift_mm:.1f} mm",
        f"residual {m_to_mm(estimate.residual_mean):.2f} mm",
    ]
    if estimate.correction_percent is not None:
        figures.append(f"correction {estimate.correction_percent:.0f} %")
    if estimate.angular_error_deg is not None:
        figures.append(f"angular error {estimate.angular_error_deg:.1f} degrees")
    return f"{textwrap.fill(verdict, 120)}\n{', '.join(figures)}; arrows in true length"


def _draw_mechanisms(panel: Axes, estimate: ShiftEstimate) -> None:
    """How much of the shift at the points each mechanism makes, with its standard deviation, and the sum of its weights."""
    names = list(estimate.mechanisms)
    shares = [estimate.mechanisms[name] for name in names]
    panel.bar(
        names,
        [m_to_mm(share.shift) for share in shares],
        yerr=[m_to_mm(share.shift_std) for share in shares],
        color=[_COLOURS.get(name, "grey") for name in names],
        width=0.6,
        capsize=5,
    )
    for position, share in enumerate(shares):
        panel.text(
            position, 0.02, f"sum of weights\n{share.weight_sum:.2f} ± {share.weight_sum_std:.2f}",
            transform=panel.get_xaxis_transform(), ha="center", fontsize=8,
            bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.5},
        )  # fmt: skip
    panel.axhline(0.0, color="black", linewidth=0.8)
    panel.set_xlim(-0.6, max(len(names), 2) - 0.4)
    if not any(share.shift for share in shares):
        panel.set_ylim(-0.1, 1.0)
    panel.set_ylabel("mean shift at the points (mm)")
    panel.set_title("by mechanism, ± 1 std", fontsize=10)


def _draw_weights(panel: Axes, estimate: ShiftEstimate) -> None:
    """Each weight, with its standard deviation and the parameters of its column."""
    shown = estimate.weights[:_MOST_BARS]
    if not shown:
        panel.set_axis_off()
        panel.text(0.5, 0.5, "every weight is zero", ha="center", transform=panel.transAxes)
        return
    rows = np.arange(len(shown))
    panel.barh(
        rows,
        [item.weight for item in shown],
        xerr=[item.std or 0.0 for item in shown],
        color=[_COLOURS.get(item.mechanism, "grey") for item in shown],
        ecolor="black",
        capsize=3,
    )
    panel.set_yticks(rows, [_name(item) for item in shown], fontsize=7)
    panel.invert_yaxis()
    panel.axvline(0.0, color="black", linewidth=0.8)
    panel.set_xlabel("weight")
    more = len(estimate.weights) - len(shown)
    panel.set_title(f"{len(estimate.weights)} weights are not zero" + (f"; {more} not shown" if more else ""), fontsize=10)


def _name(item: EntryWeight) -> str:
    """Column as a person tells it from others: mechanism, direction of gravity (RAS), level, resection."""
    parts = [item.mechanism]
    if item.fluid_level is not None:
        parts.append(f"fluid level {item.fluid_level:.2f}")
    if item.drug_level:
        parts.append(f"drug level {item.drug_level}")
    if item.resected:
        parts.append("resected")
    if item.gravity_direction is None:
        return ", ".join(parts)
    direction = " ".join(f"{component:+.2f}" for component in item.gravity_direction)
    return f"{', '.join(parts)}\ngravity along ({direction})"


def _draw_residuals(panel: Axes, estimate: ShiftEstimate) -> None:
    """Residual against shift, point by point: below the diagonal the estimate is better than no correction."""
    shift_mm = m_to_mm(np.linalg.norm(estimate.measured, axis=1))
    residual_mm = m_to_mm(np.linalg.norm(estimate.measured - estimate.estimated, axis=1))
    for rows, colour, label in ((estimate.used, MEASURED, "in use"), (~estimate.used, OUTLIER, "dropped")):
        if rows.any():
            panel.scatter(shift_mm[rows], residual_mm[rows], s=22, color=colour, label=f"{int(rows.sum())} points {label}")
    limit = 1.08 * max(float(shift_mm.max()), float(residual_mm.max()), 0.1)
    panel.plot([0.0, limit], [0.0, limit], color="grey", linestyle="--", linewidth=1.0, label="no correction")
    panel.set_xlim(0.0, limit)
    panel.set_ylim(0.0, limit)
    panel.set_xlabel("measured shift (mm)")
    panel.set_ylabel("residual (mm)")
    panel.set_title("residual of each point", fontsize=10)
    panel.legend(fontsize=8, loc="upper left")
