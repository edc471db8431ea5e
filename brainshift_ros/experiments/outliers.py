"""Find how many wrong points an estimate bears, how wrong they may be, and whether it is said (E6, E8).

Some of the measured points are given a displacement that is off by 3 to 20 mm: *scattered*, each point in a direction of its
own, as by a vessel taken for another; or *clustered*, neighbours all by the same vector, as by a flap of tissue or a part of
the scan that has slipped. The second kind agrees with itself, and draws a fit to it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.experiments.inverse_cases import Targets, measure, study_atlas, study_scene
from brainshift_ros.experiments.inverse_truths import InverseTruth, drawn_truth, solved_truths, truth_patients
from brainshift_ros.experiments.results import write_figure, write_results
from brainshift_ros.experiments.skull_cases import MemoryAtlas
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.inverse.span import AtlasSpan, atlas_span
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.units import mm_to_m

Progress = Callable[[str, float], None]
Row = dict[str, Any]

KINDS = ("scattered", "clustered")
SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
SIZES_MM = (3.0, 6.0, 12.0, 20.0)

#: Threshold of outliers by name: the default, and one that keeps every point.
FITS = {"robust": InverseOptions().outlier_sigmas, "all points kept": np.inf}

#: Wrong points cost no more than this, over the same points without them: then the estimate holds.
BEARABLE_MM = 0.5

POINTS, NOISE_MM = 24, 0.5
SEEDS, MORE_SEEDS = range(2000, 2008), range(2000, 2024)
SIZES, MORE_SIZES = (3_000, 3_500), (8_000, 10_000)

_GROUPS = ("surface", "subsurface", "deep")
_COLORS = ("#9ecae1", "#4292c6", "#08519c", "#08306b")


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Spoil measured points of truths, and estimate with robustness and without.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv and outliers.png, and keeps meshes, atlas and truths.
    full
        24 truths on finer meshes instead of 8.
    progress
        Called with stage and fraction done.
    """
    (atlas_nodes, truth_nodes), seeds = (MORE_SIZES, MORE_SEEDS) if full else (SIZES, SEEDS)
    atlas = study_atlas(folder, study_scene(orientations=60 if full else 20), progress, nodes=atlas_nodes)
    locator, span = PointLocator(atlas.mesh), atlas_span(atlas)
    patients = truth_patients(folder, truth_nodes, progress)
    rows: list[Row] = []
    for truth in solved_truths(folder, patients, map(drawn_truth, seeds), progress):
        rows += _rows(atlas, truth, locator, span)
    summary = {"truths": len(seeds), "points": POINTS, "noise_mm": NOISE_MM, **summary_of(rows)}
    write_results(folder, summary, rows)
    write_figure(folder / "outliers.png", chart(rows))
    return summary


def spoiled(
    measured: HomologousPoints, kind: str, share: float, size_m: float, rng: np.random.Generator
) -> tuple[HomologousPoints, NDArray[np.bool_]]:
    """Give some points a wrong displacement.

    Parameters
    ----------
    measured
        Right points.
    kind
        ``scattered`` or ``clustered``.
    share
        Of the points.
    size_m
        Length of the error, metres.
    rng
        Decides points and directions.

    Returns
    -------
    The points, and which of them are wrong, shape (n,).
    """
    n = len(measured.points)
    count = round(share * n)
    if kind == "clustered":
        middle = measured.points[rng.integers(n)]
        ids = np.argsort(np.linalg.norm(measured.points - middle, axis=1))[:count]
        vectors = np.tile(rng.normal(size=3), (count, 1))
    else:
        ids = rng.choice(n, count, replace=False)
        vectors = rng.normal(size=(count, 3))
    displacements, wrong = measured.displacements.copy(), np.zeros(n, dtype=bool)
    displacements[ids] += size_m * vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    wrong[ids] = True
    return HomologousPoints(measured.points, displacements, measured.sigma), wrong


def _rows(atlas: MemoryAtlas, truth: InverseTruth, locator: PointLocator, span: AtlasSpan) -> Iterator[Row]:
    targets = Targets(truth, atlas, locator)
    seed = truth.spec.seed
    measured = measure(truth, POINTS, float(mm_to_m(NOISE_MM)), np.random.default_rng([seed, 8]))
    for kind in KINDS:
        for size_mm in SIZES_MM:
            for share in SHARES:
                rng = np.random.default_rng([seed, round(100 * share), round(size_mm)])
                points, wrong = spoiled(measured, kind, share, float(mm_to_m(size_mm)), rng)
                for fit, threshold in FITS.items():
                    options = InverseOptions(outlier_sigmas=threshold)
                    estimate = estimate_shift(atlas, points, options=options, locator=locator, span=span)
                    errors = {row["group"]: row["error_mm"] for row in targets.errors(estimate.field.displacement)}
                    kept = np.ones(len(wrong), dtype=bool) if len(estimate.used) != len(wrong) else estimate.used
                    yield {
                        "seed": seed,
                        "kind": kind,
                        "size_mm": size_mm,
                        "share": share,
                        "fit": fit,
                        **{f"{group}_mm": errors[group] for group in _GROUPS},
                        "wrong": int(wrong.sum()),
                        "wrong_dropped": int((~kept & wrong).sum()),
                        "right_dropped": int((~kept & ~wrong).sum()),
                        "valid": estimate.valid,
                        "said": bool(estimate.warnings or estimate.reasons),
                    }


def summary_of(rows: Sequence[Row]) -> dict[str, Any]:
    """Up to which share of wrong points the surface error stays bearable, by kind, size and fit; and what was dropped."""
    holds = {}
    for kind in KINDS:
        for fit in FITS:
            for size in SIZES_MM:
                own = [row for row in rows if (row["kind"], row["fit"], row["size_mm"]) == (kind, fit, size)]
                holds[f"{kind}, {size:g} mm, {fit}"] = _bearable_share(own)
    robust = [row for row in rows if row["fit"] == "robust"]
    clean = [row for row in robust if row["share"] == 0.0]
    largest = [row for row in robust if row["share"] == max(SHARES)]
    return {
        "bearable_mm": BEARABLE_MM,
        "holds_up_to_share": holds,
        "right_points_dropped_without_wrong_ones": sum(row["right_dropped"] for row in clean) / (POINTS * len(clean)),
        "valid_share_at_largest_share": float(np.mean([row["valid"] for row in largest])),
    }


def _bearable_share(rows: Sequence[Row]) -> float:
    """Largest share up to which the mean surface error grows by no more than is bearable."""
    errors = {share: np.mean([row["surface_mm"] for row in rows if row["share"] == share]) for share in SHARES}
    held = 0.0
    for share in SHARES:
        if errors[share] - errors[0.0] > BEARABLE_MM:
            break
        held = share
    return held


def chart(rows: Sequence[Row]) -> Figure:
    """Draw error at surface and in the depth over the share of wrong points, and how many of them were found."""
    figure = Figure(figsize=(16, 8.5), layout="constrained")
    for line, kind in zip(figure.subplots(2, 3), KINDS, strict=True):
        own = [row for row in rows if row["kind"] == kind]
        _errors(line[0], own, "surface_mm", f"{kind}: error at the surface")
        _errors(line[1], own, "deep_mm", f"{kind}: error in the depth")
        _found(line[2], own, f"{kind}: wrong points dropped, and the verdict")
    figure.suptitle(
        f"{POINTS} points of {NOISE_MM:g} mm noise, some of them wrong: fit with robustness (solid) and without (dotted)"
    )
    return figure


def _means(rows: Sequence[Row], key: str) -> list[float]:
    return [float(np.mean([row[key] for row in rows if row["share"] == share])) for share in SHARES]


def _errors(axes: Axes, rows: Sequence[Row], key: str, title: str) -> None:
    for size, color in zip(SIZES_MM, _COLORS, strict=True):
        for fit, style in zip(FITS, ("o-", "x:"), strict=True):
            own = [row for row in rows if row["size_mm"] == size and row["fit"] == fit]
            label = f"off by {size:g} mm" if fit == "robust" else None
            axes.plot([100 * share for share in SHARES], _means(own, key), style, color=color, label=label)
    axes.set(xlabel="wrong points, %", ylabel="mean error, mm", title=title)
    axes.set_ylim(0.0, None)
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8)


def _found(axes: Axes, rows: Sequence[Row], title: str) -> None:
    robust = [row for row in rows if row["fit"] == "robust"]
    for size, color in zip(SIZES_MM, _COLORS, strict=True):
        own = [row for row in robust if row["size_mm"] == size and row["wrong"] > 0]
        shares = [share for share in SHARES if share > 0.0]
        dropped = [np.mean([r["wrong_dropped"] / r["wrong"] for r in own if r["share"] == share]) for share in shares]
        axes.plot([100 * share for share in shares], [100 * part for part in dropped], "o-", color=color)
        valid = _means([row for row in robust if row["size_mm"] == size], "valid")
        axes.plot([100 * share for share in SHARES], [100 * part for part in valid], "--", color=color, linewidth=1)
    axes.plot([], [], "o-", color="0.4", label="wrong points dropped")
    axes.plot([], [], "--", color="0.4", label="estimates called valid")
    axes.set(xlabel="wrong points, %", ylabel="%", ylim=(-3, 103), title=title)
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8)
