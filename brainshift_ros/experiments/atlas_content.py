"""What an atlas holds, and what of it an estimate uses: principal components, non-zero weights, shares (thesis, chapter V).

The thesis finds that 3 to 6 components hold 99 % of the power of the atlas at the measured points, and that estimates have 1 to
6 non-zero weights. Here the components are counted for the whole field too, since what the points do not tell apart may still
move the rest of the brain differently; and the mechanisms' shares (figure 17) are held against truths that know theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.entry import AtlasEntry
from brainshift_ros.experiments.atlas_content_chart import chart
from brainshift_ros.experiments.atlas_studies import AS_THESIS, INDEPENDENT, Judge, at_orientation, column_truth, values_of
from brainshift_ros.experiments.inverse_cases import columns_where, study_atlas, study_scene, subset
from brainshift_ros.experiments.inverse_truths import InverseTruth, drawn_truth, solved_truths, truth_patients
from brainshift_ros.experiments.results import write_figure, write_results, write_table
from brainshift_ros.experiments.skull_cases import MemoryAtlas
from brainshift_ros.inverse.appended import AppendedAtlas
from brainshift_ros.inverse.rows import rows_at_points
from brainshift_ros.mesh.locate import PointLocator

Progress = Callable[[str, float], None]
Row = dict[str, Any]

#: Parts of the atlas whose components are counted.
PARTS: Mapping[str, Callable[[AtlasEntry], bool]] = {
    "gravity": lambda entry: entry.mechanism == "gravity",
    "mannitol": lambda entry: entry.mechanism == "mannitol",
    "gravity and mannitol": lambda entry: True,
}
WHOLE = "gravity and mannitol"

#: The same columns less their mean; and those of the thesis's model of the skull.
CENTRED, FREE_CAP = "both, less their mean", "both, free cap"

#: Shares of the power that components are counted for.
SHARES = (0.95, 0.99, 0.999)

SPARSE, FIELD = "measured points", "whole field"

#: The thesis's numbers of components for 99 %, and of non-zero weights.
COMPONENTS, NONZERO = (3, 6), (1, 6)


def run(folder: Path, full: bool, progress: Progress) -> dict[str, Any]:
    """Count components and weights.

    Parameters
    ----------
    folder
        Gets summary.json, table.csv (estimates), components.csv and atlas_content.png, and keeps meshes, atlas and truths.
    full
        60 orientations, 60 truths, meshes of 8,000 and 10,000 nodes; else 30, 16, 3,000 and 3,000.
    progress
        Called with stage and fraction done.

    Returns
    -------
    dict
        What summary.json holds; `thesis_holds_here` says whether the thesis's numbers are met.
    """
    orientations, count, nodes, truth_nodes = (60, 60, 8_000, 10_000) if full else (30, 16, 3_000, 3_000)
    atlas, free_cap = (
        study_atlas(folder, study_scene(orientations=orientations, skull=setting.skull), progress, nodes=nodes)
        for setting in (INDEPENDENT, AS_THESIS)
    )
    specs = [drawn_truth(seed) for seed in range(count)]
    truths = list(solved_truths(folder, truth_patients(folder, truth_nodes, progress), specs, progress))
    progress("components", 0.0)
    spectra = spectra_of(atlas, free_cap, truths[:8])
    components = list(counted(spectra))
    progress("components", 1.0)
    rows = list(estimates(atlas, free_cap, truths, progress))
    summary = summary_of(rows, components)
    write_table(folder / "components.csv", components)
    write_results(folder, summary, rows)
    write_figure(folder / "atlas_content.png", chart(spectra, rows, COMPONENTS, NONZERO))
    return summary


def spectra_of(
    atlas: MemoryAtlas, free_cap: MemoryAtlas, truths: Sequence[InverseTruth]
) -> dict[tuple[str, str], list[NDArray[np.float64]]]:
    """Power of the principal components, by part of the atlas and by where it is looked at; in falling order, summing to 1.

    Power is the squared singular value of the matrix itself, since the weights have to make up the mean of the columns too. The
    thesis does not say whether it takes the mean off first: for all columns together both are given.

    Parameters
    ----------
    atlas, free_cap
        All columns, with skull contact and with the thesis's free cap, on one mesh.
    truths
        Their points, :data:`~brainshift_ros.experiments.atlas_studies.POINTS` each, are one sparse atlas each.
    """
    parts = {part: subset(atlas, columns_where(atlas, chosen)) for part, chosen in PARTS.items()}
    parts |= {CENTRED: replace(atlas, E=atlas.E - atlas.E.mean(axis=2, keepdims=True)), FREE_CAP: free_cap}
    locator = PointLocator(atlas.mesh)
    measured = [INDEPENDENT.measured(truth, np.random.default_rng([truth.spec.seed, 17])) for truth in truths]
    spectra = {}
    for name, part in parts.items():
        sparse = [rows_at_points(AppendedAtlas(part, None), points, locator=locator).M for points in measured]
        spectra[name, SPARSE] = [power(M.reshape(-1, M.shape[2])) for M in sparse]
        spectra[name, FIELD] = [power(part.E.reshape(-1, part.E.shape[2]))]
    return spectra


def power(matrix: NDArray) -> NDArray[np.float64]:
    """Squared singular values of a matrix as shares of their sum, falling; by the Gram matrix of the shorter side."""
    matrix = np.asarray(matrix, dtype=np.float64)
    gram = matrix @ matrix.T if matrix.shape[0] < matrix.shape[1] else matrix.T @ matrix
    eigenvalues = np.maximum(np.linalg.eigvalsh(gram)[::-1], 0.0)
    return eigenvalues / eigenvalues.sum()


def components_for(spectrum: NDArray[np.float64], share: float) -> int:
    """Smallest number of components that hold a share of the power."""
    return min(int(np.searchsorted(np.cumsum(spectrum), share)) + 1, len(spectrum))


def counted(spectra: Mapping[tuple[str, str], Sequence[NDArray[np.float64]]]) -> Iterator[Row]:
    """Least, median and largest number of components that hold each share."""
    for (part, where), many in spectra.items():
        for share in SHARES:
            counts = [components_for(spectrum, share) for spectrum in many]
            yield {
                "atlas": part,
                "where": where,
                "share_percent": round(100.0 * share, 1),
                "components_min": min(counts),
                "components_median": float(np.median(counts)),
                "components_max": max(counts),
            }


def estimates(atlas: MemoryAtlas, free_cap: MemoryAtlas, truths: Sequence[InverseTruth], progress: Progress) -> Iterator[Row]:
    """Weights of an estimate of every truth; of exact columns left out of the free-cap atlas as well, one for each truth.

    The latter are the thesis's truths: one orientation is left out, one of its columns is measured at all nodes in the opening.
    """
    judge = Judge(atlas.mesh)
    directions = list(dict.fromkeys(entry.gravity_direction for entry in free_cap.entries))
    for number, truth in enumerate(truths):
        progress("estimates", number / len(truths))
        direction = directions[number * len(directions) // len(truths)]
        own = at_orientation(free_cap, direction)
        rest, columns = subset(free_cap, ~own), np.flatnonzero(own)
        exact = column_truth(free_cap, int(columns[number % len(columns)]))
        for setting, of, taken in ((AS_THESIS, rest, exact), (INDEPENDENT, atlas, truth)):
            measured = setting.measured(taken, np.random.default_rng([number, 17]))
            labels = {
                "truths": setting.name,
                "truth": number,
                "resected": taken.spec.resected,
                "true_mannitol": taken.spec.mannitol,
            }
            found = judge.rows(of, taken, measured, setting.options)
            yield from (labels | row for row in found if row["group"] == "surface")
    progress("estimates", 1.0)


def summary_of(rows: Sequence[Row], components: Sequence[Row]) -> dict[str, Any]:
    """Sum up components, weights and shares, and say whether the thesis's numbers are met."""
    kinds = list(dict.fromkeys(row["truths"] for row in rows))
    nonzero = {
        kind: {
            column: {
                "median": float(np.median(values)),
                "min": int(values.min()),
                "max": int(values.max()),
                "within_thesis_percent": _within(values, NONZERO),
            }
            for column in ("nonzero", "nonzero_1_percent")
            for values in [values_of(rows, column, truths=kind)]
        }
        for kind in kinds
    }
    return {
        "thesis_holds_here": f"{_told_components(components)} {_told_weights(nonzero)}",
        "shares": _told_shares(rows),
        "nonzero_weights": nonzero,
        "components": list(components),
    }


def _within(values: NDArray[np.float64], limits: tuple[int, int]) -> float:
    return round(float(100.0 * np.mean((values >= limits[0]) & (values <= limits[1]))), 1)


def _told_components(components: Sequence[Row]) -> str:
    def found(part: str, where: str, percent: float) -> Row:
        own = (part, where, percent)
        return next(row for row in components if (row["atlas"], row["where"], row["share_percent"]) == own)

    told, (low, high) = [], COMPONENTS
    names = {WHOLE: "as it stands", CENTRED: "less the mean column", FREE_CAP: "with the thesis's free cap"}
    for part, name in names.items():
        sparse, more = found(part, SPARSE, 99.0), found(part, SPARSE, 99.9)
        field = found(part, FIELD, 99.0)
        least, most = sparse["components_min"], sparse["components_max"]
        answer = "as many as" if low <= least and most <= high else "fewer than" if most < high else "more than"
        count = f"{least}" if least == most else f"{least} to {most}"
        told.append(
            f"{name} {count}, {answer} the thesis's {low} to {high} (99.9 %: {more['components_max']}; "
            f"99 % of the whole field: {field['components_max']})"
        )
    return f"Components that hold 99 % of the atlas at the measured points: {'; '.join(told)}."


def _told_weights(nonzero: Mapping[str, Mapping[str, Row]]) -> str:
    told, (low, high) = [], NONZERO
    for kind, found in nonzero.items():
        counts, large = found["nonzero"], found["nonzero_1_percent"]
        told.append(
            f"truths {kind}: {counts['min']} to {counts['max']}, median {counts['median']:g}, "
            f"{counts['within_thesis_percent']:g} % of the estimates within the thesis's {low} to {high}; "
            f"of weights over 1 % of their sum {large['min']} to {large['max']}, {large['within_thesis_percent']:g} % within"
        )
    return f"Non-zero weights, {'; '.join(told)}."


def _told_shares(rows: Sequence[Row]) -> str:
    """Say how well the weights tell the mechanisms apart."""
    own = [row for row in rows if row["truths"] == INDEPENDENT.name]
    without = np.array([row["mannitol_share"] for row in own if row["true_mannitol"] == 0.0])
    drug = [row for row in own if row["true_mannitol"] > 0.0]
    true, found = (np.array([row[column] for row in drug]) for column in ("true_mannitol", "mannitol_share"))
    correlation = float(np.corrcoef(true, found)[0, 1])
    return (
        f"Independent truths without the drug: mannitol's share of the weights is {100 * np.median(without):.0f} % in the "
        f"median, up to {100 * without.max():.0f} %; with it: {100 * np.median(found):.0f} %, "
        f"and its correlation with the drug's true load is {correlation:.2f} over {len(true)} truths."
    )
