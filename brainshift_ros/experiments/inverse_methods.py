"""Compare least squares, Tikhonov and the constrained method where nothing was measured.

The thesis (4.3) constrains the weights because methods without constraints fitted the measured surface and were wrong far
away. Here all are fitted to the same noisy points of simulated truths, and judged by target groups from the surface to the
other hemisphere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import false_discovery_control, wilcoxon

from brainshift_ros.experiments import inverse_methods_chart as charts
from brainshift_ros.experiments.inverse_cases import study_atlas, study_scene
from brainshift_ros.experiments.inverse_methods_cases import (
    BEST_CONSTRAINED,
    CONSTRAINED,
    MEAN,
    METHODS,
    NO_LIMIT,
    NOISES_MM,
    POINTS,
    SHIPPED,
    Comparison,
)
from brainshift_ros.experiments.inverse_methods_kinds import CONTACT, kinds
from brainshift_ros.experiments.inverse_truths import collapsed, solved_truth, truth_patients
from brainshift_ros.experiments.results import write_figure, write_results, write_table
from brainshift_ros.simulation.contact_newton import NoEquilibriumError
from brainshift_ros.units import mm_to_m

Progress = Callable[[str, float], None]
Row = dict[str, Any]

#: Targets far from all measured points; midline targets are between.
FAR = ("deep", "contralateral")

#: What the issue asks of the constrained method, mean correction in percent.
ASKED = {"surface": 85.0, "subsurface": 75.0}

#: A method fails far away if its median correction there is more than this below the constrained method's, in percentage
#: points, and Wilcoxon's test says that the difference is none of chance.
_MARGIN, _SIGNIFICANT = 10.0, 0.01

_NO_FIT = "not applicable, since it fits the data no better,"


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Compare the methods.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv (all estimates), comparison.csv (their means), by_distance.csv, methods.png, distance.png,
        lambda.png and model_error.png, and keeps meshes, atlas and truths.
    full
        60 truths, and 12 with each of some model errors, on 10,000 nodes with an atlas of 720 entries on 20,000; else 12, and
        3, on small meshes with as many entries.
    progress
        Called with stage and fraction done.

    Returns
    -------
    dict
        What summary.json holds; its `thesis_holds_here` says whether the thesis's finding is reproduced.
    """
    atlas = study_atlas(folder, study_scene(), progress, nodes=20_000 if full else 3_000)
    comparison = Comparison(atlas)
    rows: list[Row] = []
    by_distance: list[Row] = []
    unsolved: list[str] = []
    for kind in kinds(full):
        patients = truth_patients(folder, kind.nodes, progress, kind.mesh_seeds)
        for number, spec in enumerate(kind.specs):
            progress(f"truths: {kind.name}", number / len(kind.specs))
            try:
                truth = solved_truth(folder, patients[spec.seed // 4 % len(patients)], spec)
            except NoEquilibriumError as error:
                unsolved.append(f"{kind.name}, truth {spec.seed}: {error}")
                continue
            if kind.collapse_mm:
                truth = collapsed(truth, float(mm_to_m(kind.collapse_mm)))
            grouped, distant = comparison.rows(truth, kind.offset_mm)
            rows += [{"kind": kind.name, "resected": spec.resected, "mannitol": spec.mannitol > 0.0} | row for row in grouped]
            by_distance += [{"kind": kind.name} | row for row in distant]
        progress(f"truths: {kind.name}", 1.0)
    summary = summary_of(rows) | {"atlas_entries": len(atlas.entries), "truths without equilibrium": unsolved}
    write_results(folder, summary, rows)
    write_table(folder / "comparison.csv", comparison_table(rows))
    write_table(folder / "by_distance.csv", by_distance)
    like_the_atlas = [row for row in rows if row["kind"] == CONTACT]
    write_figure(folder / "methods.png", charts.by_group(like_the_atlas))
    write_figure(folder / "distance.png", charts.over_distance([row for row in by_distance if row["kind"] == CONTACT]))
    write_figure(folder / "lambda.png", charts.over_lambda(like_the_atlas))
    write_figure(folder / "model_error.png", charts.by_kind(rows))
    return summary


def summary_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Means, medians and tests by kind of truth, method and group."""
    names = list(dict.fromkeys(row["kind"] for row in rows))
    of_kind = {name: [row for row in rows if row["kind"] == name] for name in names}
    main = of_kind[CONTACT]
    return {
        "truths": {name: len({row["truth"] for row in part}) for name, part in of_kind.items()},
        "points": list(POINTS),
        "noise_mm": list(NOISES_MM),
        "thesis_holds_here": thesis_line(main),
        "thesis_holds_with_model_error": thesis_line([row for row in rows if row["kind"] != CONTACT]),
        "asked": asked_line(main),
        "correction_percent_mean": {
            name: {f"noise {noise:g} mm": by_method(part, np.mean, noise) for noise in NOISES_MM}
            for name, part in of_kind.items()
        },
        "correction_percent_median": {name: by_method(part, np.median) for name, part in of_kind.items()},
        "ceiling_percent_mean": {name: by_method(part, np.mean, 0.0) for name, part in of_kind.items()},
        "worse_than_no_correction_percent": by_method(main, lambda values: 100.0 * np.mean(np.array(values) < 0.0)),
        "constrained_better_by_percentage_points": {
            CONTACT: signed_rank_tests(main),
            "with model error": signed_rank_tests([row for row in rows if row["kind"] != CONTACT]),
        },
        "shipped_method_by_truth": _by_truth(main),
        "weights": _weights([row for row in main if row["points"]]),
    }


def comparison_table(rows: Sequence[Row]) -> list[Row]:
    """Mean, standard deviation and median of the correction and mean error by kind of truth, noise, method and group."""
    parts: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        parts.setdefault((row["kind"], row["noise_mm"], row["method"], row["group"]), []).append(row)
    table = []
    for (kind, noise_mm, method, group), part in parts.items():
        correction = np.array([row["correction_percent"] for row in part])
        table.append(
            {
                "kind": kind,
                "noise_mm": noise_mm,
                "method": method,
                "group": group,
                "truths": len(part),
                "shift_mm_mean": float(np.mean([row["shift_mm"] for row in part])),
                "error_mm_mean": float(np.mean([row["error_mm"] for row in part])),
                "correction_percent_mean": float(correction.mean()),
                "correction_percent_std": float(correction.std()),
                "correction_percent_median": float(np.median(correction)),
                "worse_than_no_correction_percent": float(100.0 * np.mean(correction < 0.0)),
            }
        )
    return table


def asked_line(rows: Sequence[Row]) -> str:
    """Hold the shipped method against what is asked of it, and against the best fit of the whole field by its columns."""
    parts = []
    ceiling = by_method(rows, np.mean, 0.0)[BEST_CONSTRAINED]
    for group, asked in ASKED.items():
        for noise in NOISES_MM:
            own = [row for row in rows if (row["method"], row["group"], row["noise_mm"]) == (SHIPPED, group, noise)]
            values = [row["correction_percent"] for row in own]
            met = "met" if np.mean(values) >= asked else "missed"
            parts.append(f"{group}, {noise:g} mm noise: {np.mean(values):.1f} +- {np.std(values):.1f} % ({met}: {asked:g} %)")
        parts.append(f"{group}, the whole field known: {ceiling[group]:.1f} %")
    return "; ".join(parts)


def thesis_line(rows: Sequence[Row]) -> str:
    """Say for which methods the thesis's finding holds: a nice fit of the data, but wrong far away, which (3.9) is not."""
    medians, tested = by_method(rows, np.median), signed_rank_tests(rows)
    residual = {method: told["residual_mm"] for method, told in _weights([row for row in rows if row["points"]]).items()}
    own, groups = medians[CONSTRAINED], [group for group in FAR if group in medians[CONSTRAINED]]
    lists: dict[str, list[str]] = {verdict: [] for verdict in ("reproduced", "refuted", "undecided", _NO_FIT)}
    for method in METHODS:
        if method in (CONSTRAINED, NO_LIMIT):
            continue
        worse = [own[group] - medians[method][group] > _MARGIN for group in groups]
        by_chance = [tested[method][group]["p"] >= _SIGNIFICANT for group in groups]
        verdict = "reproduced" if not any(by_chance) else "undecided"
        verdict = _NO_FIT if residual[method] > residual[CONSTRAINED] else (verdict if all(worse) else "refuted")
        lists[verdict].append(f"{method} ({residual[method]:.2f} mm; {_percents(medians[method], ['surface', *groups])})")
    parts = [f"{verdict} for {', '.join(methods)}" for verdict, methods in lists.items() if methods]
    return (
        f"a nice fit of the data but wrong far away (residual at the points; median correction): {'; '.join(parts)}. "
        f"The constrained method: {residual[CONSTRAINED]:.2f} mm; {_percents(own, ['surface', *groups])}; without its limit on "
        f"the sum: {residual[NO_LIMIT]:.2f} mm; {_percents(medians[NO_LIMIT], ['surface', *groups])}"
    )


def signed_rank_tests(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """Wilcoxon's signed-rank test of the constrained method against each other one, paired by truth.

    A truth's correction is its mean over the noises. The p values are adjusted for their number (Benjamini and Yekutieli).
    """
    measured = [row for row in rows if row["points"]]
    groups = list(dict.fromkeys(row["group"] for row in measured))
    others = [MEAN, *(method for method in METHODS if method != CONSTRAINED)]
    pairs = [(method, group) for method in others for group in groups]
    differences = [_per_truth(measured, CONSTRAINED, group) - _per_truth(measured, method, group) for method, group in pairs]
    p = false_discovery_control([wilcoxon(part).pvalue for part in differences], method="by")
    result: dict[str, dict[str, dict[str, float]]] = {method: {} for method in others}
    for (method, group), part, value in zip(pairs, differences, p, strict=True):
        result[method][group] = {"median": round(float(np.median(part)), 2), "p": float(f"{value:.2e}")}
    return result


def _per_truth(rows: Iterable[Row], method: str, group: str) -> np.ndarray:
    values: dict[int, list[float]] = {}
    for row in rows:
        if row["method"] == method and row["group"] == group:
            values.setdefault(row["truth"], []).append(row["correction_percent"])
    return np.array([np.mean(values[truth]) for truth in sorted(values)])


def by_method(
    rows: Iterable[Row], statistic: Callable[..., Any], noise_mm: float | None = None, column: str = "correction_percent"
) -> dict[str, dict[str, float]]:
    """Statistic of a column by method and group; over both noises if none is named. With 0 mm it is of the ceilings."""
    values: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        if row["noise_mm"] == noise_mm or (noise_mm is None and row["points"]):
            values.setdefault(row["method"], {}).setdefault(row["group"], []).append(row[column])
    return {
        method: {group: round(float(statistic(part)), 2) for group, part in groups.items()} for method, groups in values.items()
    }


def _by_truth(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Mean correction of the shipped method for truths of some size and state."""
    own = [row for row in rows if row["method"] == SHIPPED]
    size = {row["truth"]: row["shift_mm"] for row in own if row["group"] == "surface"}
    states: dict[str, Callable[[Row], bool]] = {
        "surface moved by less than 8 mm": lambda row: size[row["truth"]] < 8.0,
        "surface moved by 8 to 14 mm": lambda row: 8.0 <= size[row["truth"]] < 14.0,
        "surface moved by 14 mm or more": lambda row: size[row["truth"]] >= 14.0,
        "resected": lambda row: row["resected"],
        "not resected": lambda row: not row["resected"],
        "with mannitol": lambda row: row["mannitol"],
        "without mannitol": lambda row: not row["mannitol"],
    }
    parts = {state: [row for row in own if chosen(row)] for state, chosen in states.items()}
    return {state: by_method(part, np.mean)[SHIPPED] for state, part in parts.items() if part}


def _weights(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Medians of what is told of the weights."""
    once = [row for row in rows if row["group"] == "surface"]
    keys = ("residual_mm", "nonzero", "negative", "sum_of_sizes", "cpu_s")
    return {
        method: {key: float(np.median([row[key] for row in once if row["method"] == method])) for key in keys}
        for method in (*METHODS, SHIPPED)
    }


def _percents(values: Mapping[str, float], groups: Iterable[str]) -> str:
    return ", ".join(f"{group} {values[group]:.0f} %" for group in groups)
