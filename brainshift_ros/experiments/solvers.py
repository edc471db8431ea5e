"""Which solver finds the weights, how exactly, and in what time: KKT residual against processor time (E7, E8)."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.solvers_cases import SolverCase, cases
from brainshift_ros.experiments.stopwatch import Stopwatch
from brainshift_ros.inverse.methods import METHODS, Method
from brainshift_ros.solvers.threads import one_blas_thread

Progress = Callable[[str, float], None]
Row = dict[str, Any]

DEFAULT = "constrained"

#: Solvers of one problem, (3.9), and how they are drawn. The others answer other questions, by their own conditions.
CONSTRAINED: Mapping[str, tuple[str, str]] = {
    "constrained": ("o", "tab:red"),
    "nnls": ("s", "tab:blue"),
    "osqp": ("^", "tab:orange"),
    "clarabel": ("D", "tab:green"),
}
_OTHERS: Mapping[str, tuple[str, str]] = {
    "least_squares": ("x", "0.35"),
    "tikhonov": ("+", "0.35"),
    "tikhonov_gcv": ("1", "0.35"),
    "tikhonov_l_curve": ("2", "0.35"),
}

#: What the default must keep: KKT residual, and CPU seconds for 24 points and 720 columns, and for 5,000 rows.
MOST_KKT, MOST_SPARSE_S, MOST_DENSE_S = 1e-12, 0.010, 0.3

#: Solvers that take most of the study's time: they take the first truth, or the first three, and so many columns at most.
_SLOW: Mapping[str, int] = {"osqp": 1_500, "clarabel": 12_000}

_LEAST_DRAWN = 1e-18
_QUICK_S = 0.2


def run(folder: Path, full: bool, progress: Progress) -> dict[str, object]:
    """Solve every problem by every method.

    Parameters
    ----------
    folder
        Takes summary.json, table.csv and solvers.png, and keeps meshes, atlases and truths.
    full
        Ten truths instead of three, 15,000 rows, and 10,008 columns.
    progress
        Called with stage and fraction done.
    """
    truths, by_slow = (10, 3) if full else (3, 1)
    rows: list[Row] = []
    for case in cases(folder, full, range(truths), progress):
        progress("solvers", case.truth / truths)
        columns = case.problem.A.shape[1]
        with one_blas_thread():
            for name in (*CONSTRAINED, *_OTHERS):
                if name not in _SLOW or (case.truth < by_slow and columns <= _SLOW[name]):
                    rows.append(_row(case, name, METHODS[name]))
    progress("solvers", 1.0)
    summary = summarise(rows)
    write_results(folder, summary, rows)
    write_figure(folder / "solvers.png", chart(rows))
    return summary


def _row(case: SolverCase, name: str, solve: Method) -> Row:
    """Solve a problem; a quick solver five times, of which the median time counts."""
    times: list[tuple[float, float]] = []
    while not times or (len(times) < 5 and times[0][0] < _QUICK_S):
        with Stopwatch() as watch:
            solution = solve(case.problem)
        times.append((watch.cpu_s, watch.wall_s))
    return {
        "family": case.family,
        "case": case.name,
        "truth": case.truth,
        "rows": case.problem.A.shape[0],
        "columns": case.problem.A.shape[1],
        "method": name,
        "cpu_s": statistics.median(cpu for cpu, _ in times),
        "wall_s": statistics.median(wall for _, wall in times),
        "kkt_residual": solution.kkt_residual,
        "converged": solution.converged,
        "iterations": solution.iterations,
        "nonzero": int(np.count_nonzero(solution.weights)),
        "smallest_weight": float(solution.weights.min()),
        "largest_weight": float(solution.weights.max()),
        "residual_norm": solution.residual_norm,
    }


def summarise(rows: Sequence[Row]) -> dict[str, object]:
    """Time and exactness by family and method, and what that says of the default."""
    table = {
        family: {
            method: {
                "problems": len(own),
                "cpu_ms_median": 1e3 * statistics.median(row["cpu_s"] for row in own),
                "cpu_ms_max": 1e3 * max(row["cpu_s"] for row in own),
                "kkt_residual_max": max(row["kkt_residual"] for row in own),
                "not_converged": sum(not row["converged"] for row in own),
                "nonzero_median": statistics.median(row["nonzero"] for row in own),
            }
            for method in _methods(rows)
            if (own := _of(rows, family=family, method=method))
        }
        for family in _families(rows)
    }
    return {"default": DEFAULT, "why_default": why(rows), "blas_threads": 1, "families": table}


def why(rows: Sequence[Row]) -> str:
    """Say how the default compares with the other solvers of the same problem, and whether it keeps its limits."""
    own = {_key(row): row for row in _of(rows, method=DEFAULT)}
    worst, ratio = {}, {}
    for name in CONSTRAINED:
        theirs = _of(rows, method=name)
        worst[name] = max(row["kkt_residual"] for row in theirs)
        ratio[name] = statistics.median(row["cpu_s"] / own[_key(row)]["cpu_s"] for row in theirs)
    others = [name for name in CONSTRAINED if name != DEFAULT]
    sparse = [row["cpu_s"] for row in own.values() if row["family"].endswith(" 720 columns") and row["rows"] < 1000]
    dense = [row["cpu_s"] for row in own.values() if 4000 < row["rows"] < 6000]
    exact = "within" if worst[DEFAULT] <= MOST_KKT else "beyond"
    said = [
        f"{DEFAULT}: largest KKT residual over {len(own)} problems {worst[DEFAULT]:.0e}, {exact} {MOST_KKT:.0e}; "
        + ", ".join(f"{name} {worst[name]:.0e}" for name in others),
        "CPU time against it, median: " + ", ".join(f"{name} {ratio[name]:.1f} times" for name in others),
    ]
    for name, times, most in (("sparse", sparse, MOST_SPARSE_S), ("5,000 rows", dense, MOST_DENSE_S)):
        if times:
            kept = sum(time <= most for time in times)
            median = 1e3 * statistics.median(times)
            said.append(f"{name}: median {median:.1f} ms, {kept} of {len(times)} within {1e3 * most:g} ms of CPU")
    return "; ".join(said)


def chart(rows: Sequence[Row]) -> Figure:
    """Draw KKT residual over processor time, a panel a family; the best is at the lower left."""
    families = _families(rows)
    columns = 3
    figure = Figure(figsize=(15.5, 4.6 * -(-len(families) // columns)), layout="constrained")
    panels = np.atleast_1d(figure.subplots(-(-len(families) // columns), columns, sharex=True, sharey=True)).ravel()
    for axes, family in zip(panels, families, strict=False):
        for name, (marker, color) in (*CONSTRAINED.items(), *_OTHERS.items()):
            own = _of(rows, family=family, method=name)
            filled = name in CONSTRAINED
            axes.loglog(
                [1e3 * row["cpu_s"] for row in own],
                [max(row["kkt_residual"], _LEAST_DRAWN) for row in own],
                linestyle="none",
                marker=marker,
                color=color,
                markersize=7,
                alpha=0.75,
                markeredgecolor="black" if filled else color,
                markeredgewidth=0.5 if filled else 1.3,
                label=name if name in CONSTRAINED else f"{name} (own conditions)",
            )
        axes.axhline(MOST_KKT, color="0.5", linewidth=0.9)
        axes.axvline(1e3 * (MOST_DENSE_S if "rows" in family else MOST_SPARSE_S), color="0.5", linewidth=0.9, linestyle="--")
        axes.set_title(family, fontsize=10)
        axes.set_xlabel("CPU time, ms (one BLAS thread)")
        axes.tick_params(labelbottom=True, labelleft=True)
        axes.grid(visible=True, which="major", alpha=0.25)
    for axes in panels[::columns]:
        axes.set_ylabel("KKT residual, relative")
    for axes in panels[len(families) :]:
        axes.set_axis_off()
    handles, labels = panels[0].get_legend_handles_labels()
    spare = panels[-1] if len(families) < len(panels) else panels[0]
    spare.legend(handles, labels, fontsize=9, loc="center" if spare is not panels[0] else "best")
    figure.suptitle(
        f"The default, {DEFAULT}, is the exact active set. Grey: KKT residual {MOST_KKT:g}; dashed: {1e3 * MOST_SPARSE_S:g} ms,"
        f" {1e3 * MOST_DENSE_S:g} ms for dense rows. A residual below {_LEAST_DRAWN:g} is drawn there.",
        fontsize=10,
    )
    return figure


def _families(rows: Iterable[Row]) -> list[str]:
    return list(dict.fromkeys(row["family"] for row in rows))


def _methods(rows: Iterable[Row]) -> list[str]:
    return list(dict.fromkeys(row["method"] for row in rows))


def _key(row: Row) -> tuple[str, str, int]:
    return row["family"], row["case"], row["truth"]


def _of(rows: Iterable[Row], **labels: str) -> list[Row]:
    return [row for row in rows if all(row[key] == value for key, value in labels.items())]
