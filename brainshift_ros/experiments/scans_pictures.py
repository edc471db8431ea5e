"""Pictures of the study of scans: errors by case and shift, calibration of standard deviations, and cases themselves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from scipy.stats import norm

from brainshift_ros.experiments.scan_scores import CaseScore, upper
from brainshift_ros.geometry import invert_rigid, transform_points
from brainshift_ros.pictures.scan import pixels_of
from brainshift_ros.simulation.scan_cases import ScanCase
from brainshift_ros.simulation.scan_plan import CASES_A_ROUND

_CONDITIONS = {(False, False): ("o", "C0"), (True, False): ("s", "C1"), (False, True): ("^", "C2"), (True, True): ("D", "C3")}
_TOP_MM = 4.0  # errors above it are drawn there
_BAD_MM = 2.0


def _condition(score: CaseScore) -> tuple[str, str]:
    return _CONDITIONS["cavity" in score.tags, "instruments" in score.tags]


def _condition_legend() -> list[Line2D]:
    names = {(False, False): "neither", (True, False): "cavity", (False, True): "instruments", (True, True): "both"}
    return [
        Line2D([], [], color=color, marker=marker, linestyle="", label=names[key])
        for key, (marker, color) in _CONDITIONS.items()
    ]


def tre_chart(scores: Sequence[CaseScore]) -> Figure:
    """Draw the target registration error of each case, surface and deep: median and range; refused ones hollow."""
    figure = Figure(figsize=(max(9.0, 0.2 * len(scores) + 4.0), 4.8), layout="constrained")
    axes = figure.subplots()
    for at, score in enumerate(scores):
        accepted = score.registration.result.accepted
        parts = (score.registration.surface_mm, "C0", -0.15), (score.registration.deep_mm, "C1", 0.15)
        for errors, color, aside in parts:
            low, middle, high = np.minimum(np.quantile(errors, [0.0, 0.5, 1.0]), _TOP_MM)
            axes.plot([at + aside] * 2, [low, high], color=color, linewidth=1.4, alpha=1.0 if accepted else 0.4)
            axes.plot(at + aside, middle, "o", color=color, markersize=4.5, markerfacecolor=color if accepted else "white")
    for limit, label in ((0.7, "median"), (1.5, "95 %"), (3.0, "none accepted")):
        axes.axhline(limit, color="tab:red", linestyle="--", linewidth=0.9)
        axes.text(1.0, limit, f" {label}", color="tab:red", fontsize=8, va="center", transform=axes.get_yaxis_transform())
    _held_out_line(axes, scores)
    axes.set_xticks(range(len(scores)), [score.name.rpartition("_")[2] for score in scores], fontsize=7)
    axes.set(xlabel="case", ylabel="TRE, mm", ylim=(0.0, _TOP_MM + 0.1), xlim=(-0.7, len(scores) - 0.3))
    axes.grid(visible=True, axis="y", alpha=0.25)
    names = ("C0", "cortex"), ("C1", "15 to 50 mm deep")
    handles = [Line2D([], [], color=color, marker="o", label=name) for color, name in names]
    handles.append(Line2D([], [], color="0.3", marker="o", markerfacecolor="white", linestyle="", label="refused"))
    axes.legend(handles=handles, fontsize=8, loc="upper right", ncols=3)
    starts = [score.start_deg for score in scores], [score.start_mm for score in scores]
    axes.set_title(
        f"registration from starts {min(starts[0]):.0f} to {max(starts[0]):.0f} degrees and "
        f"{min(starts[1]):.0f} to {max(starts[1]):.0f} mm off: median and range over targets",
        fontsize=9,
    )
    return figure


def _held_out_line(axes: Axes, scores: Sequence[CaseScore]) -> None:
    held_out = [at for at, score in enumerate(scores) if int(score.name.rpartition("_")[2]) >= CASES_A_ROUND]
    if held_out and held_out[0] > 0:
        axes.axvline(held_out[0] - 0.5, color="0.4", linewidth=0.9)
        axes.text(held_out[0] - 0.4, 0.97, "held out", transform=axes.get_xaxis_transform(), fontsize=8, color="0.3", va="top")


def point_chart(scores: Sequence[CaseScore]) -> Figure:
    """Draw errors, numbers and coverage of homologous points over the greatest shift, by condition."""
    figure = Figure(figsize=(15.0, 4.6), layout="constrained")
    error, count, covered = figure.subplots(1, 3)
    for score in scores:
        marker, color = _condition(score)
        shown = {"marker": marker, "color": color, "linestyle": "", "markersize": 5.5}
        points = score.points
        number = len(points.error_mm) if points is not None else 0
        count.plot(score.shift_mm, number, **shown, markerfacecolor=color if points is not None else "white")
        if points is None or number == 0:
            continue
        middle, high = np.minimum([upper(points.error_mm, 0.5), upper(points.error_mm, 0.95)], _TOP_MM)
        error.plot([score.shift_mm] * 2, [middle, high], color=color, linewidth=1.0, alpha=0.6)
        error.plot(score.shift_mm, middle, **shown)
        error.plot(score.shift_mm, high, marker="_", color=color, markersize=7)
        covered.plot(score.shift_mm, points.covered, **shown)
    for axes, limits in ((error, (0.8, 2.0)), (count, (20.0,)), (covered, ())):
        for limit in limits:
            axes.axhline(limit, color="tab:red", linestyle="--", linewidth=0.9)
        axes.set_xlabel("greatest shift over the opening, mm")
        axes.grid(visible=True, alpha=0.25)
        axes.set_xlim(0.0, None)
    error.set(ylim=(0.0, _TOP_MM + 0.1))
    error.set_title(f"error of a displacement, mm: median to 95 % (above {_TOP_MM:g}: drawn there)", fontsize=9)
    count.set(ylim=(0.0, None))
    count.set_title("homologous points (hollow: none, not registered)", fontsize=9)
    covered.set(ylim=(0.0, 1.03))
    covered.set_title("share of the cortex in both scans within 10 mm of a point", fontsize=9)
    error.legend(handles=_condition_legend(), fontsize=8)
    return figure


def calibration_chart(scores: Sequence[CaseScore]) -> Figure:
    """Draw the errors' components over their standard deviations, and how often they lie within each multiple of them."""
    figure = Figure(figsize=(10.5, 4.4), layout="constrained")
    density, reliability = figure.subplots(1, 2)
    points = [score.points for score in scores if score.points is not None]
    z = np.concatenate([np.zeros(0), *(found.z for found in points)])
    grid = np.linspace(-4.0, 4.0, 161)
    density.hist(np.clip(z, -4.0, 4.0), bins=np.linspace(-4.0, 4.0, 65).tolist(), density=True, color="C0", alpha=0.6)
    density.plot(grid, norm.pdf(grid), color="0.2", linewidth=1.2)
    density.set_title("component of the error over its standard deviation; line: normal (beyond 4: drawn at 4)", fontsize=8)
    expected = np.linspace(0.02, 0.98, 49)
    bounds = norm.ppf(0.5 + 0.5 * expected)
    reliability.plot([0, 1], [0, 1], color="0.5", linewidth=0.8)
    cases = [found.z for found in points if len(found.z) >= 30]
    for values in cases:
        reliability.plot(expected, _share_within(values, bounds), color="C0", linewidth=0.5, alpha=0.35)
    if len(z):
        reliability.plot(expected, _share_within(z, bounds), color="C3", linewidth=2.0, label="all points")
        inside = float(np.mean(np.abs(z) < 1.0))
        reliability.plot(0.683, inside, "o", color="C3", label=f"within one: {100 * inside:.0f} % (normal: 68 %)")
        reliability.legend(fontsize=8)
    reliability.set(xlabel="share within, if normal", ylabel="share within", xlim=(0, 1), ylim=(0, 1), aspect="equal")
    reliability.set_title("reliability; thin: single cases", fontsize=9)
    return figure


def _share_within(z: NDArray[np.float64], bounds: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.searchsorted(np.sort(np.abs(z)), bounds) / len(z))


@dataclass(frozen=True)
class Example:
    """A case to show: both pictures, and the pixels (column, row) of its points in each."""

    title: str
    first: NDArray[np.uint8]
    later: NDArray[np.uint8]
    first_px: NDArray[np.float64]
    later_px: NDArray[np.float64]
    error_mm: NDArray[np.float64]


def example_of(case: ScanCase, score: CaseScore) -> Example:
    """Keep of a case what :func:`montage` draws."""
    tags = sorted(tag for tag in case.tags if not tag.startswith("shift"))
    title = f"{case.name}: {score.shift_mm:.0f} mm; {', '.join(tags)}"
    first_px = later_px = np.zeros((0, 2))
    error_mm = np.zeros(0)
    if score.points is not None and score.later is not None and score.later.homologous is not None:
        found = score.later.homologous
        to_tracker = invert_rigid(score.registration.result.T_patient_tracker)
        first_px = pixels_of(case.first.scan, transform_points(to_tracker, found.points))
        later_px = pixels_of(case.later.scan, transform_points(to_tracker, found.points + found.displacements))
        error_mm = score.points.error_mm
        median = f", median error {np.median(error_mm):.2f} mm" if len(error_mm) else ""
        title += f"\n{len(error_mm)} points{median}"
    else:
        title += f"\n{score.refusal[:90]}"
    return Example(title, case.first.scan.rgb, case.later.scan.rgb, first_px, later_px, error_mm)


def montage(examples: Sequence[Example]) -> Figure:
    """Draw first and later pictures side by side with their points; lines in the later one come from where a point was."""
    columns = 2
    rows = max(1, -(-len(examples) // columns))
    figure = Figure(figsize=(17.0, 3.5 * rows), layout="constrained")
    panels = figure.subplots(rows, 2 * columns, squeeze=False).reshape(-1, 2)
    for axes in panels.ravel():
        axes.set_axis_off()
    for (left, right), example in zip(panels, examples, strict=False):
        colors = np.where(example.error_mm < _BAD_MM, "#40ff70", "#ff3020")
        left.imshow(example.first)
        right.imshow(example.later)
        left.scatter(*example.first_px.T, s=14, facecolors="none", edgecolors=colors, linewidths=0.9)
        right.scatter(*example.later_px.T, s=14, facecolors="none", edgecolors=colors, linewidths=0.9)
        lines = np.stack([example.first_px, example.later_px], axis=1)
        left.add_collection(LineCollection(list(lines), colors=list(colors), linewidths=0.6, alpha=0.8))
        for axes in (left, right):
            axes.set(xlim=(0, example.first.shape[1]), ylim=(example.first.shape[0], 0))
        left.set_title(example.title, fontsize=8, loc="left")
    heading = f"first and later scan; green: error below {_BAD_MM:g} mm, red: above; lines: to the point's later pixel"
    figure.suptitle(heading, fontsize=10)
    return figure
