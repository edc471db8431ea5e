"""What the size of mannitol's and gravity's fields means: how the tissue gets to the steady state, and how long it takes.

The thesis leaves open at what time its solutions hold. If the field at a time in surgery is a multiple of the steady one, a
weight between 0 and 1 stands for the time, and steady solutions will do; this measures how nearly it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.geometry import unit
from brainshift_ros.mechanics.cases import Case
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.skull import SkullName
from brainshift_ros.mechanics.steady import Direction, SteadyModel
from brainshift_ros.mechanics.system import System, assemble_system
from brainshift_ros.mechanics.transient import History, TransientModel
from brainshift_ros.mesh.build import build_patient
from brainshift_ros.mesh.patient import ImageReference, PatientModel
from brainshift_ros.mesh.template_patient import template_patient_images
from brainshift_ros.septa.sheets import septa_spacing_mm
from brainshift_ros.units import m_to_mm

Progress = Callable[[str, float], None]

_X, _Y, _Z = (float(component) for component in unit([0.0, -0.94, -0.34]))
SUPINE: Direction = (_X, _Y, _Z)
FLUID_LEVEL = 0.4

#: Times at which a surgeon might look, then times that show the approach to the steady state.
SURGICAL_S = (600.0, 1200.0, 2400.0, 3600.0)
LATER_S = (7200.0, 21600.0, 86400.0)

#: Longest time step up to two hours, and after that.
FINE_S, COARSE_S = 60.0, 600.0

#: Time steps for 40 minutes, to see what a long step costs in accuracy.
DT_S = (2400.0, 1200.0, 600.0, 300.0, 120.0)

CASES = {
    "mannitol, k_c1": Case("mannitol", SUPINE, FLUID_LEVEL, 0.0),
    "mannitol, k_c2": Case("mannitol", SUPINE, FLUID_LEVEL, 0.5),
    "mannitol, k_c3": Case("mannitol", SUPINE, FLUID_LEVEL, 1.0),
    "gravity": Case("gravity", SUPINE, FLUID_LEVEL),
}


@dataclass(frozen=True)
class Row:
    """One field against the steady one of its case; the cortex is the brain's outer surface.

    `left` is what the best multiple of the steady field (`scale`) leaves of the field, over all nodes.
    """

    skull: str
    case: str
    minutes: float
    largest_mm: float
    mean_mm: float
    lowest_pressure_pa: float
    highest_pressure_pa: float
    cosine: float
    scale: float
    left_percent: float
    left_mean_mm: float
    left_largest_mm: float


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Follow three levels of mannitol, and gravity, on the template's brain with tumour and septa, supine.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv and mannitol.png.
    full
        12,000 nodes and both models of the skull rather than 5,000 and the free cap.
    progress
        Called with stage and fraction done.
    """
    nodes = 12_000 if full else 5_000
    images = template_patient_images(septa_spacing_mm=septa_spacing_mm(nodes))
    image = ImageReference("template", "0" * 64, images.t1.shape, images.t1.T_patient_voxel)
    patient = build_patient(images.t1, images.labels, images.septa, image_ref=image, nodes=nodes, progress=progress)
    return study(patient, folder, ("free_cap", "contact") if full else ("free_cap",), progress)


def study(patient: PatientModel, folder: Path, skulls: Sequence[SkullName], progress: Progress) -> dict[str, Any]:
    """Run the study on any patient; see :func:`run`."""
    system = assemble_system(patient.mesh, material_of(patient.tissue))
    cortex = np.unique(patient.mesh.facets["skull"])
    rows: list[Row] = []
    details = {}
    for skull in skulls:
        steady, pressure, histories, seconds = _solutions(system, skull, progress)
        rows += [row for history in histories for row in _rows(skull, history, steady, cortex)]
        for k, name in enumerate(CASES):
            rows.append(_row(skull, name, np.inf, steady[..., k], steady[..., k], pressure[:, k], cortex))
        early = histories[0]
        details[skull] = {
            "CPU, s": seconds,
            "left by the pattern of another time, %": _across_times(early, steady),
            "longer time steps at 40 minutes": _across_steps(system, skull, early, progress),
        }
    summary = {
        "nodes": len(patient.mesh.nodes),
        "fluid_level": FLUID_LEVEL,
        "skulls": details,
        "rows": [_plain(r) for r in rows],
    }
    write_results(folder, summary, [_plain(row) for row in rows])
    write_figure(folder / "mannitol.png", chart(rows, skulls[0]))
    return summary


def chart(rows: Sequence[Row], skull: str) -> Figure:
    """Draw size and pattern over time for one model of the skull."""
    figure = Figure(figsize=(15, 4.6), layout="constrained")
    size, share, left = figure.subplots(1, 3)
    colors = dict(zip(CASES, ("#9ecae1", "#4292c6", "#084594", "#d95f02"), strict=True))
    for name, color in colors.items():
        own = [row for row in rows if row.case == name and row.skull == skull]
        timed = [row for row in own if np.isfinite(row.minutes)]
        minutes = [row.minutes for row in timed]
        size.loglog(minutes, [row.mean_mm for row in timed], "o-", color=color, label=name)
        size.axhline(next(row.mean_mm for row in own if np.isinf(row.minutes)), color=color, linewidth=0.8, linestyle=":")
        share.semilogx(minutes, [row.scale for row in timed], "o-", color=color, label=name)
        left.loglog(minutes, [max(row.left_percent, 0.1) for row in timed], "o-", color=color, label=name)
    size.set_title("mean shift of the cortex, mm; dotted: steady", fontsize=9)
    share.set_title("best multiple of the steady field: the weight that stands for the time", fontsize=9)
    share.set_ylim(0.0, 1.05)
    left.set_title("what that multiple leaves of the field, % (below 0.1: drawn there)", fontsize=9)
    for axes in (size, share, left):
        _time_axis(axes)
    return figure


def _time_axis(axes: Axes) -> None:
    axes.axvspan(SURGICAL_S[0] / 60.0, SURGICAL_S[-1] / 60.0, color="0.92", zorder=0)
    ticks = {10: "10 min", 20: "20", 40: "40", 60: "1 h", 120: "2 h", 360: "6 h", 1440: "24 h"}
    axes.set_xticks(list(ticks), list(ticks.values()), fontsize=8)
    axes.minorticks_off()
    axes.set_xlabel("time since the mechanism began (grey: of surgery)")
    axes.grid(visible=True, which="both", alpha=0.25)
    axes.legend(fontsize=8)


def _solutions(
    system: System, skull: SkullName, progress: Progress
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[History, History], dict[str, float]]:
    """Steady fields (N, 3, cases) and pressures, the histories with fine and with coarse steps, and processor times."""
    cases = list(CASES.values())
    with Stopwatch() as steady_watch:
        steady = np.empty((len(system.head.nodes), 3, len(cases)))
        model = SteadyModel(system, [SUPINE], skull=skull)
        for block in model.solve(cases):
            steady[:, :, block.cases] = block.displacement
    with Stopwatch() as fine_watch:
        fine = TransientModel(system, [SUPINE], duration_s=LATER_S[0], dt_s=FINE_S, skull=skull)
        early = fine.history(cases, (*SURGICAL_S, LATER_S[0]), _staged(progress, f"two hours, {skull}"))
    coarse = TransientModel(system, [SUPINE], duration_s=LATER_S[-1], dt_s=COARSE_S, skull=skull)
    late = coarse.history(cases, LATER_S[1:], _staged(progress, f"a day, {skull}"))
    seconds = {"steady": steady_watch.cpu_s, f"{fine.steps.count} steps of {FINE_S:g} s": fine_watch.cpu_s}
    return steady, model.pressure(cases), (early, late), seconds


def _rows(skull: str, history: History, steady: NDArray[np.float64], cortex: NDArray[np.integer]) -> list[Row]:
    return [
        _row(skull, name, time_s / 60.0, history.displacement[t, :, :, k], steady[..., k], history.pressure[t, :, k], cortex)
        for k, name in enumerate(CASES)
        for t, time_s in enumerate(history.times_s)
    ]


def _row(
    skull: str,
    name: str,
    minutes: float,
    field: NDArray[np.float64],
    steady: NDArray[np.float64],
    pressure: NDArray[np.float64],
    cortex: NDArray[np.integer],
) -> Row:
    scale, remainder = _left(field, steady)
    shift_mm, left_mm = (m_to_mm(np.linalg.norm(vectors, axis=1)) for vectors in (field[cortex], remainder))
    return Row(
        skull=skull,
        case=name,
        minutes=minutes,
        largest_mm=float(shift_mm.max()),
        mean_mm=float(shift_mm.mean()),
        lowest_pressure_pa=float(pressure.min()),
        highest_pressure_pa=float(pressure.max()),
        cosine=float(np.vdot(field, steady) / (np.linalg.norm(field) * np.linalg.norm(steady))),
        scale=scale,
        left_percent=_percent(remainder, field),
        left_mean_mm=float(left_mm.mean()),
        left_largest_mm=float(left_mm.max()),
    )


def _left(field: NDArray[np.float64], pattern: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Best multiple of a pattern, from 0 to 1 as a weight is, and what it leaves of a field."""
    scale = float(np.clip(np.vdot(field, pattern) / np.vdot(pattern, pattern), 0.0, 1.0))
    return scale, field - scale * pattern


def _percent(part: NDArray[np.float64], whole: NDArray[np.float64]) -> float:
    return 100.0 * float(np.linalg.norm(part) / np.linalg.norm(whole))


def _unlike(field: NDArray[np.float64], pattern: NDArray[np.float64]) -> float:
    """Fit a multiple of a pattern to a field; what it leaves, in percent of the field."""
    return _percent(field - np.vdot(field, pattern) / np.vdot(pattern, pattern) * pattern, field)


def _across_times(early: History, steady: NDArray[np.float64]) -> dict[str, dict[str, list[float]]]:
    """Fit the pattern of each time to the fields at 10, 20, 40, 60 and 120 minutes; what it leaves, in percent.

    Here a pattern may be multiplied by any factor: an earlier pattern may stand for a later field too.
    """
    names = [f"{time_s / 60.0:g} min" for time_s in early.times_s]
    result: dict[str, dict[str, list[float]]] = {}
    for k, case in enumerate(CASES):
        patterns = [*zip(names, early.displacement[..., k], strict=True), ("steady", steady[..., k])]
        result[case] = {}
        for name, pattern in patterns:
            result[case][name] = [_unlike(field, pattern) for field in early.displacement[..., k]]
    return result


def _across_steps(system: System, skull: SkullName, early: History, progress: Progress) -> dict[str, dict[str, float]]:
    """Compare the field at 40 minutes by long time steps with that by steps of one minute, in percent of it.

    Its difference, and what the best multiple of it leaves: how far its pattern is wrong.
    """
    at = int(np.argmin(np.abs(early.times_s - SURGICAL_S[2])))
    result: dict[str, dict[str, float]] = {}
    for dt_s in DT_S:
        model = TransientModel(system, [SUPINE], duration_s=SURGICAL_S[2], dt_s=dt_s, skull=skull)
        with Stopwatch() as watch:
            field = model.history(list(CASES.values()), SURGICAL_S[2:3], _staged(progress, f"dt {dt_s:g} s, {skull}"))
        made = result[f"{dt_s:g} s"] = {"CPU, s": watch.cpu_s}
        for k, case in enumerate(CASES):
            exact, long = early.displacement[at, ..., k], field.displacement[0, ..., k]
            made[f"{case}: difference, %"] = _percent(long - exact, exact)
            made[f"{case}: pattern, %"] = _unlike(exact, long)
    return result


def _plain(row: Row) -> dict[str, object]:
    """Give a row as a dictionary, with the word steady where JSON has no infinity."""
    plain = asdict(row)
    return {**plain, "minutes": "steady"} if np.isinf(row.minutes) else plain


def _staged(progress: Progress, stage: str) -> Progress:
    return lambda _, fraction: progress(stage, fraction)
