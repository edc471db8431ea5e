"""How well are vessels found, and by which filter? Against the vessels that the simulator painted (spec I3, E7).

The filters are compared pixel by pixel (area under the ROC curve) and by their time, all on the same picture of blood contrast;
the traced centre lines, branch points and widths by recall, precision and error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import ndimage
from skimage.filters import frangi, meijering, sato

from brainshift_ros.experiments.results import write_figure, write_results, write_table
from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.experiments.vessels_score import NEAR_M, WIDTH_CLASSES, PaintedTruth, painted_truth, score_tree
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.simulation.scan_cases import make_scan_case
from brainshift_ros.simulation.scanner import Seen, SimulatedScan
from brainshift_ros.units import m_to_mm
from brainshift_ros.vessels.speculars import specular_mask
from brainshift_ros.vessels.tracing import VesselImage, VesselTree, enhance_vessels, trace_vessels
from brainshift_ros.vessels.vesselness import blood_contrast, vesselness

Progress = Callable[[str, float], None]
Row = dict[str, Any]

#: Numbers of the scan cases; the second half of all of them was never tuned on.
CASES, MORE_CASES = tuple(range(0, 36, 9)), tuple(range(0, 72, 2))

OURS = "this package"
_SCALES_M = (0.2e-3, 0.35e-3, 0.6e-3)
_GLINT, _MATTE = 0.5, 0.02  # strength of the lamp's image
_PLAIN = "this package, on plain green light"


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Trace simulated scans and score them.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv (traced vessels), filters.csv, vessels.png and traced.png.
    full
        36 cases instead of 4, half of them never tuned on.
    progress
        Called with stage and fraction done.
    """
    numbers = MORE_CASES if full else CASES
    rows: list[Row] = []
    filters: list[Row] = []
    curves: dict[str, list[NDArray[np.float64]]] = {}
    for done, number in enumerate(numbers):
        progress("scans", done / len(numbers))
        case = make_scan_case(number)
        for name, scanned in (("first", case.first), ("later", case.later)):
            cortex = scanned.label == Seen.CORTEX
            with Stopwatch() as watch:
                tree = trace_vessels(scanned.scan, cortex)
            truth = painted_truth(case.scene, scanned, cortex)
            labels = {"case": number, "scan": name}
            rows.append(labels | score_tree(tree, truth) | _glints(scanned, cortex) | {"trace_cpu_s": watch.cpu_s})
            for filter_name, (share, cpu_s) in _filtered(scanned, cortex, truth).items():
                filters.append(labels | {"filter": filter_name, "auc": _area_under(share), "cpu_s": cpu_s})
                curves.setdefault(filter_name, []).append(share)
            if not done and name == "first":
                write_figure(folder / "traced.png", picture(scanned.scan, tree, truth))
    progress("scans", 1.0)
    summary = {
        "cases": len(numbers),
        "traced": {key: float(np.nanmedian([row[key] for row in rows])) for key in rows[0] if key not in ("case", "scan")},
        "filters": {
            name: {key: median(r[key] for r in filters if r["filter"] == name) for key in ("auc", "cpu_s")} for name in curves
        },
    }
    write_results(folder, summary, rows)
    write_table(folder / "filters.csv", filters)
    write_figure(folder / "vessels.png", chart(rows, filters, curves))
    return summary


def _glints(scanned: SimulatedScan, cortex: NDArray[np.bool_]) -> Row:
    """Share of the cortex's glints that the repair takes, and of its matte pixels that it takes without need."""
    taken = specular_mask(scanned.scan.rgb)
    glint = scanned.specular > _GLINT
    matte = ~ndimage.binary_dilation(scanned.specular > _MATTE, iterations=4)
    return {
        "glints_repaired": float(taken[cortex & glint].mean()) if (cortex & glint).any() else float("nan"),
        "matte_repaired": float(taken[cortex & matte].mean()),
    }


def _filtered(
    scanned: SimulatedScan, cortex: NDArray[np.bool_], truth: PaintedTruth
) -> Mapping[str, tuple[NDArray[np.float64], float]]:
    """ROC curve (hits at 0, 1, ... 100 % false alarms) and CPU seconds of each filter."""
    image = enhance_vessels(scanned.scan, cortex)
    sigmas = [max(scale / image.pixel_m, 0.8) for scale in _SCALES_M]
    flat = image.flat
    plain = _plain_contrast(scanned.scan, cortex, image)
    filters: Mapping[str, Callable[[], NDArray]] = {
        OURS: lambda: vesselness(flat, image.pixel_m, _SCALES_M),
        "Frangi": lambda: frangi(flat, sigmas=sigmas, black_ridges=True),
        "Sato": lambda: sato(flat, sigmas=sigmas, black_ridges=True),
        "Meijering": lambda: meijering(flat, sigmas=sigmas, black_ridges=True),
        _PLAIN: lambda: vesselness(plain, image.pixel_m, _SCALES_M),
    }
    painted = truth.on_vessel()[truth.judged]
    found = {}
    for name, apply in filters.items():
        with Stopwatch() as watch:
            strength = apply()
        found[name] = _roc(strength[truth.judged], painted), watch.cpu_s
    return found


def _plain_contrast(scan: OrganisedScan, cortex: NDArray[np.bool_], image: VesselImage) -> NDArray[np.float32]:
    """Logarithm of the green light alone, minus its local mean: what most vessel filters are given."""
    return blood_contrast(scan.rgb, cortex.astype(np.float32), 4.0e-3 / image.pixel_m, red_share=0.0)


def _roc(strength: NDArray, painted: NDArray[np.bool_]) -> NDArray[np.float64]:
    thresholds = np.quantile(strength[~painted], np.linspace(1.0, 0.0, 101))
    ordered = np.sort(strength[painted])
    return 1.0 - np.searchsorted(ordered, thresholds, side="left") / len(ordered)


def _area_under(hits: NDArray[np.float64]) -> float:
    return float(np.trapezoid(hits, dx=0.01))


def chart(rows: Sequence[Row], filters: Sequence[Row], curves: Mapping[str, Sequence[NDArray[np.float64]]]) -> Figure:
    """Draw ROC curves, the filters' areas over their times, and what tracing finds."""
    figure = Figure(figsize=(16, 4.8), layout="constrained")
    roc, cost, traced = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.35))
    alarms = np.linspace(0.0, 1.0, 101)
    for number, (name, shares) in enumerate(curves.items()):
        style = "--" if name == _PLAIN else "-"
        roc.plot(alarms, np.median(shares, axis=0), style, color=f"C{number}", label=name)
        own = [row for row in filters if row["filter"] == name]
        cost.plot(median(row["cpu_s"] for row in own), median(row["auc"] for row in own), "o", color=f"C{number}", ms=9)
    roc.set(xlim=(0.0, 0.3), ylim=(0.4, 1.0), xlabel="false alarms, share of other pixels", ylabel="vessel pixels found")
    roc.legend(fontsize=8, loc="lower right")
    roc.set_title("vesselness against painted vessels", fontsize=10)
    cost.set(xscale="log", xlabel="CPU time at 640 x 480, s", ylabel="area under the curve")
    cost.set_xticks([0.01, 0.03, 0.1, 0.3, 1.0], ["0.01", "0.03", "0.1", "0.3", "1"])
    cost.minorticks_off()
    cost.set_title("same colours; medians", fontsize=10)
    shown = {
        "precision": "precision\nof lines",
        "recall": "recall\nof lines:",
        **{f"recall, {name}": name for name in WIDTH_CLASSES},
        "branch_recall": "recall of\nbranches",
        "branch_precision": "precision\nof branches",
    }
    values = [[row[key] for row in rows if np.isfinite(row[key])] for key in shown]
    traced.boxplot(values, widths=0.6, medianprops={"color": "C3"})
    traced.set_xticks(range(1, len(shown) + 1), list(shown.values()), fontsize=7)
    traced.set(ylim=(0.0, 1.02))
    traced.set_title(f"traced vessels in {len(rows)} scans; lines within {m_to_mm(NEAR_M):g} mm", fontsize=10)
    for axes in (roc, cost, traced):
        axes.grid(visible=True, alpha=0.25)
    figure.suptitle("vessels of simulated scans: arteries and veins of 0.4 to 2 mm, glints, shadows, instruments", fontsize=11)
    return figure


def picture(scan: OrganisedScan, tree: VesselTree, truth: PaintedTruth) -> Figure:
    """Draw a scan, and on it what was traced, what was missed, and branch points."""
    rows, columns = np.nonzero(truth.judged)
    view = (columns.min() - 5, columns.max() + 5), (rows.max() + 5, rows.min() - 5)
    figure = Figure(figsize=(17, 8.6), layout="constrained")
    for axes in figure.subplots(1, 2):
        axes.imshow(scan.rgb)
        axes.set(xlim=view[0], ylim=view[1])
        axes.set_axis_off()
    missed = truth.missed_pixels(tree)
    axes.plot(missed[:, 1], missed[:, 0], ".", color="#ff4030", ms=1.6, label="painted, not found")
    for number, path in enumerate(tree.paths):
        label = "traced" if number == 0 else None
        axes.plot(path.pixels[:, 1], path.pixels[:, 0], color="#40ff70", lw=1.1, label=label)
    axes.plot(tree.branch_points[:, 1], tree.branch_points[:, 0], ".", color="white", ms=5, label="branch points")
    axes.legend(loc="lower left", fontsize=9)
    return figure
