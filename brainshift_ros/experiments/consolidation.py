"""Consolidation in time against analytic series, and where its pressure would oscillate without the stabilisation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, cast

import numpy as np
import scipy.sparse as sp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray

from brainshift_ros.experiments.consolidation_analytic import CryerSphere, PorousMedium, TerzaghiColumn
from brainshift_ros.experiments.consolidation_problem import Problem, ball, brezzi_pitkaranta, column, edge_lengths
from brainshift_ros.experiments.results import write_figure, write_results, write_table
from brainshift_ros.mechanics.fluid import Fluid
from brainshift_ros.mechanics.space import ElementName
from brainshift_ros.mechanics.stabilization import SAFETY, stabilization

Progress = Callable[[str, float], None]
Table = list[dict[str, Any]]

ELEMENTS: tuple[ElementName, ...] = ("P1", "P2")

#: White matter, and what table 1 leaves at zero or one: a fluid that can be compressed, and alpha below one.
WHITE = PorousMedium(youngs_modulus=2100.0, poissons_ratio=0.45, conductivity=1e-10)
COMPRESSIBLE = PorousMedium(youngs_modulus=2100.0, poissons_ratio=0.45, conductivity=1e-10, biot=0.8, storage=1e-4)

#: Softer against volume change than the brain, so that the Mandel-Cryer effect is plain.
SOFT = PorousMedium(youngs_modulus=2100.0, poissons_ratio=0.2, conductivity=1e-10)

#: Grey matter's conductivity, table 1.
GREY_CONDUCTIVITY = 5e-12

#: Load, Pa; height of the column and radius of the ball, m.
LOAD, HEIGHT, RADIUS = 1000.0, 0.1, 0.07

#: Time c t / L^2 at which errors are taken, and the end of the curves.
ERROR_TIME, CURVE_TIME = 0.1, 0.4

#: Column whose pressure oscillates: cells of 1 cm, inner nodes moved by up to a quarter of one.
ROUGH_CELLS, ROUGH_SIZE, ROUGH_H, IRREGULAR = (4, 4, 10), (0.04, 0.04, HEIGHT), 0.01, 0.25

#: Time steps in units of h^2 / (6 (lambda + 2 mu) k), k that of white matter.
STEPS = (0.01, 0.1, 1.0, 10.0, 100.0)
MORE_STEPS = (0.001, 0.03, 0.3, 3.0, 30.0)

#: No stabilisation: what is left only keeps the matrix regular.
NONE = 1e-9


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Compare with Terzaghi's and Cryer's series, then measure the overshoot of the pressure.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv (errors), overshoot.csv, terms.csv, consolidation.png and stabilization.png.
    full
        Finer meshes and more time steps.
    progress
        Called with stage and fraction done.
    """
    errors = error_table(full, progress)
    curves = cryer_curves(16 if full else 8, 80, progress)
    overshoots = overshoot_table(sorted((*STEPS, *MORE_STEPS) if full else STEPS), progress)
    terms = term_table((0.5, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0) if full else (0.5, 1.0, 1.25, 1.5), progress)
    summary = {"errors": errors, "cryer": curves, "overshoot": overshoots, "terms": terms, "chosen_multiple": SAFETY}
    write_results(folder, summary, errors)
    write_table(folder / "overshoot.csv", overshoots)
    write_table(folder / "terms.csv", terms)
    write_figure(folder / "consolidation.png", accuracy_chart(errors, curves))
    write_figure(folder / "stabilization.png", stability_chart(overshoots, terms))
    return summary


def error_table(full: bool, progress: Progress) -> Table:
    """Errors of Terzaghi's column and Cryer's ball at one time, by element, cells and time steps."""
    columns, balls = ((5, 10, 20, 40), (4, 8, 16)) if full else ((5, 10, 20), (4, 8))
    counts = (5, 20, 80, 320) if full else (5, 20, 80)
    jobs = [("Terzaghi", medium, cells) for medium in (WHITE, COMPRESSIBLE) for cells in columns]
    jobs += [("Cryer", medium, cells) for medium in (SOFT, COMPRESSIBLE) for cells in balls]
    rows: Table = []
    for number, ((name, medium, cells), element) in enumerate(product(jobs, ELEMENTS)):
        progress("errors", number / (len(jobs) * len(ELEMENTS)))
        if name == "Cryer" and element == "P2" and cells > balls[1]:
            continue
        problem, exact, length = _benchmark(name, medium, cells, element)
        duration_s = ERROR_TIME * length**2 / medium.consolidation
        for count in counts:
            *_, last = problem.follow(duration_s, count)
            error = problem.error(last.pressure[:, 0], exact(duration_s), LOAD)
            rows.append({
                "problem": name, "nu": medium.poissons_ratio, "alpha": medium.biot, "1/S, 1/Pa": medium.storage,
                "element": element, "cells": cells, "steps": count, "RMS error of p / load": error,
                "residual": last.residual,
            })  # fmt: skip
    progress("errors", 1.0)
    return rows


def cryer_curves(cells: int, count: int, progress: Progress) -> dict[str, dict[str, list[float]]]:
    """Pressure at the ball's centre over time, computed and by the series, relative to the load."""
    curves = {}
    for number, medium in enumerate((SOFT, WHITE)):
        progress("curves", number / 2.0)
        sphere, problem = CryerSphere(medium, RADIUS, LOAD), ball(medium, cells, RADIUS, LOAD)
        unit_s = RADIUS**2 / medium.consolidation
        centre = int(np.argmin(np.linalg.norm(problem.space.mesh.nodes, axis=1)))
        states = [(state.time_s, state.pressure[centre, 0]) for state in problem.follow(CURVE_TIME * unit_s, count)]
        curves[f"nu = {medium.poissons_ratio:g}"] = {
            "c t / a^2": [time_s / unit_s for time_s, _ in states],
            "computed": [float(pressure) / LOAD for _, pressure in states],
            "series": [float(sphere.pressure(0.0, time_s)) / LOAD for time_s, _ in states],
        }
    progress("curves", 1.0)
    return curves


def overshoot_table(steps: Sequence[float], progress: Progress) -> Table:
    """Largest overshoot in the first three steps, by element, medium, time step, with stabilisation and without."""
    jobs = list(product(("homogeneous", "white over grey", "grey over white"), ELEMENTS))
    rows: Table = []
    for number, (layers, element) in enumerate(jobs):
        progress("overshoot", number / len(jobs))
        problem = _rough_column(layers, element)
        for step, stabilised in product(steps, (True, False)):
            percent = _overshoot(problem, step, None if stabilised else stabilization(problem.fluid, NONE))
            rows.append({
                "column": layers, "element": element, "stabilised": stabilised,
                "dt / dt_c": step, "overshoot, %": percent,
            })  # fmt: skip
    progress("overshoot", 1.0)
    return rows


def term_table(multiples: Sequence[float], progress: Progress) -> Table:
    """Overshoot at a tiny time step, and the error at a moderate time, by the term that stabilises.

    The difference of masses by its multiple, and the classical term by its factor and what it takes for h.
    """
    terms: dict[str, Callable[[Fluid], sp.csr_matrix]] = {
        f"masses, {multiple:g}": partial(stabilization, safety=multiple) for multiple in multiples
    }
    lengths: dict[str, Callable[..., NDArray[np.float64]]] = {"mean edge": np.mean, "longest edge": np.max}
    for (name, of_edges), part in product(lengths.items(), (4, 6)):
        terms[f"h²/{part}, {name}"] = partial(_classical, of_edges=of_edges, part=part)
    rows: Table = []
    for number, (element, (name, term)) in enumerate(product(ELEMENTS, terms.items())):
        progress("terms", number / (len(ELEMENTS) * len(terms)))
        rough = _rough_column("homogeneous", element)
        problem, exact, length = _benchmark("Cryer", SOFT, 8, element)
        duration_s = ERROR_TIME * length**2 / SOFT.consolidation
        *_, last = problem.follow(duration_s, 40, term(problem.fluid))
        rows.append({
            "element": element, "term": name, "overshoot, %": _overshoot(rough, STEPS[0], term(rough.fluid)),
            "RMS error of p / load": problem.error(last.pressure[:, 0], exact(duration_s), LOAD),
        })  # fmt: skip
    progress("terms", 1.0)
    return rows


def accuracy_chart(errors: Table, curves: dict[str, dict[str, list[float]]]) -> Figure:
    """Draw errors over the time step for each mesh, and the pressure at the ball's centre."""
    figure = Figure(figsize=(15, 4.6), layout="constrained")
    axes = figure.subplots(1, 3)
    for ax, name, nu in zip(axes, ("Terzaghi", "Cryer"), (WHITE.poissons_ratio, SOFT.poissons_ratio), strict=False):
        own = [row for row in errors if (row["problem"], row["nu"], row["alpha"]) == (name, nu, 1.0)]
        for element, style in zip(ELEMENTS, ("o-", "s:"), strict=True):
            for shade, cells in enumerate(sorted({row["cells"] for row in own})):
                line = [row for row in own if (row["element"], row["cells"]) == (element, cells)]
                values = [row["RMS error of p / load"] for row in line]
                label = f"{element}, {cells} cells" if line else None
                ax.loglog([row["steps"] for row in line], values, style, color=f"C{shade}", label=label)
        ax.set_title(f"{name}, nu = {nu:g}: RMS error of p / load at c t = {ERROR_TIME:g} L²", fontsize=9)
        counts = sorted({row["steps"] for row in own})
        ax.set_xticks(counts, [str(count) for count in counts])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.set_ylim(3e-4, 4e-2)
        ax.set_xlabel("time steps")
        _finish(ax)
    for color, (name, curve) in enumerate(curves.items()):
        axes[2].plot(curve["c t / a^2"], curve["series"], "-", color=f"C{color}", label=f"series, {name}")
        axes[2].plot(curve["c t / a^2"][::4], curve["computed"][::4], "o", color=f"C{color}", markersize=4, label="computed")
    axes[2].set_title("Mandel-Cryer effect: pressure at the ball's centre / load", fontsize=9)
    axes[2].set_xlabel("c t / a²")
    _finish(axes[2])
    return figure


def stability_chart(overshoots: Table, terms: Table) -> Figure:
    """Draw the overshoot over the time step, and for each term that stabilises beside the error it costs."""
    figure = Figure(figsize=(15, 4.6), layout="constrained")
    axes = figure.subplots(1, 3)
    colors = dict(zip(dict.fromkeys(row["column"] for row in overshoots), ("C0", "C1", "C2"), strict=True))
    for ax, element in zip(axes, ELEMENTS, strict=False):
        for (layers, color), stabilised in product(colors.items(), (False, True)):
            key = (element, layers, stabilised)
            own = [row for row in overshoots if (row["element"], row["column"], row["stabilised"]) == key]
            label = f"{layers}, {'stabilised' if stabilised else 'not stabilised'}"
            values = [max(row["overshoot, %"], 0.01) for row in own]
            ax.loglog([row["dt / dt_c"] for row in own], values, "o-" if stabilised else "s:", color=color, label=label)
        ax.set_title(f"{element}: pressure beyond its range, % (less than 0.01: at 0.01)", fontsize=9)
        ax.set_xlabel("time step / (h² / (6 (λ + 2μ) k_white))")
        ax.set_ylim(0.007, 400.0)
        _finish(ax)
    for element, style in zip(ELEMENTS, ("o-", "s:"), strict=True):
        own = [row for row in terms if row["element"] == element]
        points = {row["term"]: (100.0 * row["RMS error of p / load"], max(row["overshoot, %"], 0.01)) for row in own}
        masses = {name: point for name, point in points.items() if name.startswith("masses")}
        axes[2].loglog(*zip(*masses.values(), strict=True), style, color="C0", label=f"difference of masses, {element}")
        classical = [point for name, point in points.items() if name not in masses]
        axes[2].loglog(*zip(*classical, strict=True), style[0], color="C3", label=f"h² grad p · grad q, {element}")
        for name, point in points.items():
            beside = (4, 3) if name in masses else (4, -8)
            axes[2].annotate(name.removeprefix("masses, "), point, fontsize=6, xytext=beside, textcoords="offset points")
    axes[2].set_title("what a term leaves and costs; chosen: 1.5 for P1, 1.25 for P2", fontsize=9)
    axes[2].set_xlabel("RMS error of Cryer's p / load, %")
    axes[2].set_ylabel("overshoot, %", fontsize=8)
    _finish(axes[2])
    return figure


def _benchmark(
    name: str, medium: PorousMedium, cells: int, element: ElementName
) -> tuple[Problem, Callable[[float], NDArray[np.float64]], float]:
    """Problem, its exact pressure at the vertices over time, and its length."""
    if name == "Cryer":
        sphere, problem = CryerSphere(medium, RADIUS, LOAD), ball(medium, cells, RADIUS, LOAD, element=element)
        radii = np.linalg.norm(problem.space.mesh.nodes, axis=1)
        return problem, lambda time_s: sphere.pressure(radii, time_s), RADIUS
    series = TerzaghiColumn(medium, HEIGHT, LOAD)
    width = 2.0 * HEIGHT / cells
    problem = column(medium, (2, 2, cells), (width, width, HEIGHT), LOAD, element=element)
    heights = problem.space.mesh.nodes[:, 2]
    return problem, lambda time_s: series.pressure(heights, time_s), HEIGHT


def _rough_column(layers: str, element: ElementName) -> Problem:
    grey_part: dict[str, Callable[[NDArray[np.float64]], NDArray[np.bool_]]] = {
        "homogeneous": lambda height: np.zeros(len(height), dtype=bool),
        "white over grey": lambda height: height < HEIGHT / 2.0,
        "grey over white": lambda height: height > HEIGHT / 2.0,
    }

    def conductivity(height: NDArray[np.float64]) -> NDArray[np.float64]:
        return cast(NDArray[np.float64], np.where(grey_part[layers](height), GREY_CONDUCTIVITY, WHITE.conductivity))

    return column(WHITE, ROUGH_CELLS, ROUGH_SIZE, LOAD, element=element, irregular=IRREGULAR, conductivity=conductivity)


def _classical(fluid: Fluid, of_edges: Callable[..., NDArray[np.float64]], part: int) -> sp.csr_matrix:
    return brezzi_pitkaranta(fluid, of_edges(edge_lengths(fluid), axis=1), 1.0 / part)


def _overshoot(problem: Problem, step: float, term: sp.csr_matrix | None) -> float:
    """How far the pressure of the first three steps leaves the range from zero to the load, in percent of it."""
    dt_s = step * ROUGH_H**2 / (6.0 * WHITE.confined_modulus * WHITE.conductivity)
    states = list(problem.follow(3.0 * dt_s, 3, term))
    highest, lowest = (max(s.pressure.max() for s in states), min(s.pressure.min() for s in states))
    return 100.0 * max(0.0, highest / LOAD - 1.0, -lowest / LOAD)


def _finish(axes: Axes) -> None:
    axes.grid(visible=True, which="both", alpha=0.25)
    axes.legend(fontsize=7)
