"""From how far off does registration find the place: rotation against translation of the start, a chart a method.

Open3D and small_gicp take part where ``python3 scripts/bootstrap.py --peers`` has installed them: in an environment of their
own, beside the one that runs this.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.geometry import rigid, unit
from brainshift_ros.registration.opening import opening_mask
from brainshift_ros.registration.options import RegistrationOptions
from brainshift_ros.registration.patch import scan_patch
from brainshift_ros.registration.register import register_scan
from brainshift_ros.registration.target import CortexTarget, prepare_target
from brainshift_ros.simulation.scan_cases import ScanCase, make_scan_case
from brainshift_ros.units import m_to_mm, mm_to_m

Progress = Callable[[str, float], None]

#: An interpreter that may have open3d and small_gicp, and what it runs.
PEERS_PYTHON, PEERS_WORKER = Path(sys.prefix) / "peers" / "bin" / "python", Path(__file__).with_name("basin_peers.py")
DEGREES, MILLIMETRES = (0.0, 15.0, 30.0, 45.0, 60.0), (0.0, 10.0, 20.0, 30.0, 40.0)
FOUND_MM, WRONG_MM = 2.0, 3.0
#: Methods of this package by the name that the chart shows.
SINGLE, LATTICE, SEARCH = "one start", "lattice of starts", "search without a pose"
PEERS = {"Open3D": "Open3D, robust point to plane", "small_gicp": "small_gicp, GICP"}

_OURS = {SINGLE: RegistrationOptions(lattice_radius_mm=0.0, lattice_turns_deg=(0.0,)), LATTICE: RegistrationOptions()}
_FINEST_MM = 1.0


def run(folder: Path, full: bool, progress: Progress) -> dict[str, object]:
    """Register scans from starts turned and moved by given amounts in random directions.

    Parameters
    ----------
    folder
        Takes summary.json, table.csv (a row a trial) and basin.png.
    full
        Twelve scans instead of three.
    progress
        Called with stage and fraction done.
    """
    numbers = range(0, 36, 3) if full else range(0, 36, 12)
    rows: list[dict[str, Any]] = []
    for done, number in enumerate(numbers):
        progress("registering scans", done / len(numbers))
        case = make_scan_case(number)
        target = prepare_target(case.cortex)
        offsets = [(degrees, millimetres) for degrees in DEGREES for millimetres in MILLIMETRES]
        rng = np.random.default_rng(number)
        starts = [start_off(case, degrees, millimetres, rng) for degrees, millimetres in offsets]
        for name, options in _OURS.items():
            for offset, start in zip(offsets, starts, strict=True):
                rows.append(_ours(case, target, name, offset, start, options))
        rows.append(_ours(case, target, SEARCH, (np.nan, np.nan), None, RegistrationOptions()))
        if PEERS_PYTHON.exists():
            rows += _theirs(case, target, offsets, starts)
    progress("registering scans", 1.0)
    methods = {name: _figures(rows, name) for name in dict.fromkeys(row["method"] for row in rows)}
    summary = {
        "scans": len(numbers),
        "peers_left_out": sorted(set(PEERS.values()) - methods.keys()),
        "methods": methods,
    }
    write_results(folder, summary, rows)
    write_figure(folder / "basin.png", chart(rows))
    return summary


def start_off(case: ScanCase, degrees: float, millimetres: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Turn and move the true pose about the middle of the craniotomy, by given amounts in random directions."""
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * unit(rng.normal(size=3)))
    center = case.scene.craniotomy.center
    offset = mm_to_m(millimetres) * unit(rng.normal(size=3))
    return rigid(turn, center - turn.apply(center) + offset) @ case.T_patient_tracker


def _row(
    case: ScanCase, method: str, offset: tuple[float, float], pose: NDArray[np.float64], cpu_s: float, accepted: bool | None
) -> dict[str, Any]:
    surface, deep = case.tre_m(pose)
    return {
        "method": method,
        "scan": case.name,
        "degrees": offset[0],
        "millimetres": offset[1],
        "surface TRE, mm": float(m_to_mm(surface.mean())),
        "deep TRE, mm": float(m_to_mm(deep.mean())),
        "accepted": "" if accepted is None else accepted,
        "CPU, s": cpu_s,
    }


def _ours(
    case: ScanCase,
    target: CortexTarget,
    method: str,
    offset: tuple[float, float],
    start: NDArray[np.float64] | None,
    options: RegistrationOptions,
) -> dict[str, Any]:
    with Stopwatch() as watch:
        result = register_scan(case.first.scan, target, start, options)
    return _row(case, method, offset, result.T_patient_tracker, watch.cpu_s, result.accepted)


def _theirs(
    case: ScanCase,
    target: CortexTarget,
    offsets: list[tuple[float, float]],
    starts: Iterable[NDArray[np.float64]],
) -> list[dict[str, Any]]:
    """Let the peers align what our opening mask leaves of the scan."""
    source = scan_patch(case.first.scan, opening_mask(case.first.scan), float(mm_to_m(_FINEST_MM))).cloud()
    with tempfile.TemporaryDirectory(prefix="brainshift-basin-") as name:
        folder = Path(name)
        np.savez(
            folder / "problem.npz",
            source=m_to_mm(source.points),
            target=m_to_mm(target.points),
            normals=target.normals,
            starts=[_translation_scaled(start, m_to_mm) for start in starts],
        )
        subprocess.run([PEERS_PYTHON, PEERS_WORKER, folder], check=True, capture_output=True)
        with np.load(folder / "answer.npz") as answer:
            return [
                _row(case, title, offset, _translation_scaled(pose, mm_to_m), float(answer[f"{peer} cpu_s"]), None)
                for peer, title in PEERS.items()
                if f"{peer} poses" in answer
                for offset, pose in zip(offsets, answer[f"{peer} poses"], strict=True)
            ]


def _translation_scaled(pose: NDArray[np.float64], convert: Callable[[Any], NDArray[np.float64]]) -> NDArray[np.float64]:
    scaled = pose.copy()
    scaled[:3, 3] = convert(pose[:3, 3])
    return scaled


def _of(rows: list[dict[str, Any]], method: str) -> list[dict[str, Any]]:
    return [row for row in rows if row["method"] == method]


def _figures(rows: list[dict[str, Any]], method: str) -> dict[str, object]:
    mine = _of(rows, method)
    error = np.array([row["surface TRE, mm"] for row in mine])
    found = error < FOUND_MM
    figures: dict[str, object] = {
        "trials": len(mine),
        f"TRE below {FOUND_MM:g} mm, share": float(found.mean()),
        "median TRE of these, mm": float(np.median(error[found])) if found.any() else None,
        "CPU of a trial, median, s": float(np.median([row["CPU, s"] for row in mine])),
    }
    if mine[0]["accepted"] != "":
        accepted = np.array([row["accepted"] for row in mine])
        figures["accepted, share"] = float(accepted.mean())
        figures[f"accepted with TRE above {WRONG_MM:g} mm"] = int((accepted & (error > WRONG_MM)).sum())
    return figures


def chart(rows: list[dict[str, Any]]) -> Figure:
    """Draw for each method where it found the place, and what it accepted."""
    methods = list(dict.fromkeys(row["method"] for row in rows if row["method"] != SEARCH))
    figure = Figure(figsize=(3.4 * len(methods) + 0.6, 7.4), layout="constrained")
    axes = figure.subplots(2, len(methods), squeeze=False)
    for column, method in enumerate(methods):
        mine, figures = _of(rows, method), _figures(rows, method)
        median = figures["median TRE of these, mm"]
        found = f"TRE {median:.2f} mm where found" if isinstance(median, float) else "never found"
        title = f"{method}\n{found}, {figures['CPU of a trial, median, s']:.2f} s CPU"
        _heat(axes[0, column], mine, lambda row: row["surface TRE, mm"] < FOUND_MM, title)
        if mine[0]["accepted"] == "":
            axes[1, column].set_axis_off()
            axes[1, column].text(0.5, 0.6, "gives no verdict", ha="center", transform=axes[1, column].transAxes)
        else:
            wrong = figures[f"accepted with TRE above {WRONG_MM:g} mm"]
            _heat(axes[1, column], mine, lambda row: row["accepted"], f"accepted; {wrong} of them with TRE > {WRONG_MM:g} mm")
    search = _figures(rows, SEARCH)
    share, median = search[f"TRE below {FOUND_MM:g} mm, share"], search["median TRE of these, mm"]
    figure.suptitle(
        f"Share of trials with TRE < {FOUND_MM:g} mm (top) and accepted (bottom), by how far the start is off; "
        "CPU of ours with checks, opening and verdict, of peers the alignment only\n"
        f"search without a pose, whole cortex: {share:.0%} found"
        + (f", TRE {median:.2f} mm" if isinstance(median, float) else "")
        + f", {search['accepted, share']:.0%} accepted, {search['CPU of a trial, median, s']:.1f} s CPU",
        fontsize=10,
    )
    return figure


def _heat(axes: Axes, rows: list[dict[str, Any]], passed: Callable[[dict[str, Any]], bool], title: str) -> None:
    share = np.array(
        [
            [np.mean([passed(row) for row in rows if (row["degrees"], row["millimetres"]) == (d, m)]) for m in MILLIMETRES]
            for d in DEGREES
        ]
    )
    axes.imshow(share, origin="lower", cmap="RdYlGn", vmin=0.0, vmax=1.0)
    for (i, j), value in np.ndenumerate(share):
        axes.text(j, i, f"{100 * value:.0f}", ha="center", va="center", fontsize=8)
    axes.set_xticks(range(len(MILLIMETRES)), [f"{m:g}" for m in MILLIMETRES])
    axes.set_yticks(range(len(DEGREES)), [f"{d:g}" for d in DEGREES])
    axes.set_xlabel("translation of the start, mm", fontsize=8)
    axes.set_ylabel("rotation of the start, degrees", fontsize=8)
    axes.set_title(title, fontsize=8)
