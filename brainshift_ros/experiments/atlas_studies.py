"""Parts that the studies of what an atlas needs share (thesis, chapter V): two kinds of truths, estimates, statistics.

The thesis takes its truths from the model and mesh that made the atlas, without noise. Such a truth shows what the choice of
columns does and nothing else. Here each study holds its finding against truths of another mesh and stiffness as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import ranksums, wilcoxon

from brainshift_ros.atlas.entry import AtlasEntry
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.experiments.inverse_cases import Targets, measure, opening_facets
from brainshift_ros.experiments.inverse_truths import PLANNED, Direction, InverseTruth, TruthSpec
from brainshift_ros.experiments.patients import craniotomy_opening
from brainshift_ros.experiments.skull_cases import MemoryAtlas
from brainshift_ros.geometry import tangent_frame, unit
from brainshift_ros.image.volume import Region
from brainshift_ros.inverse.appended import AppendedAtlas
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.inverse.robust import fit_robustly
from brainshift_ros.inverse.rows import rows_at_points
from brainshift_ros.mechanics.cases import Case
from brainshift_ros.mechanics.skull import SkullName
from brainshift_ros.mechanics.steady import SteadyModel
from brainshift_ros.mechanics.submesh import SHEETS
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mesh.locate import Located, PointLocator
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.simulation.truth import varied_material
from brainshift_ros.units import mm_to_m

Progress = Callable[[str, float], None]
Row = dict[str, Any]

#: A measurement in the craniotomy; the thesis's patients have 15 to 24 points.
POINTS, NOISE_M = 20, float(mm_to_m(0.5))


#: Errors that differ by less are the same: no tracker tells them apart.
SAME_MM = 0.1


@dataclass(frozen=True)
class Setting:
    """A kind of truth, and how it is measured.

    Attributes
    ----------
    name
        For tables and charts.
    skull
        Of atlas and truth.
    stiffness_spread
        Of the truth's tissue; see :class:`~brainshift_ros.experiments.inverse_truths.TruthSpec`.
    points
        Random points of the cortex in the craniotomy, with noise; 0 takes all of its nodes, without.
    options
        Of the estimate.
    """

    name: str
    skull: SkullName
    stiffness_spread: float
    points: int
    options: InverseOptions = field(default_factory=InverseOptions)

    def measured(self, truth: InverseTruth, rng: np.random.Generator) -> HomologousPoints:
        """Measure a truth."""
        return measure(truth, self.points, NOISE_M, rng) if self.points else measure_nodes(truth)


#: Exact data hold no outliers: none are looked for.
AS_THESIS = Setting("as in the thesis", "free_cap", 0.0, 0, InverseOptions(outlier_sigmas=1e6))
INDEPENDENT = Setting("independent", "contact", 0.25, POINTS)


def measure_nodes(truth: InverseTruth) -> HomologousPoints:
    """All nodes of the cortex in the craniotomy and their exact displacements, as in figure 20 (b).

    Those on septa are left out: two nodes lie there at one place, and a locator may find either.
    """
    sheets = [truth.mesh.facets[name].ravel() for name in SHEETS if name in truth.mesh.facets]
    nodes = np.setdiff1d(opening_facets(truth.mesh, truth.tissue), np.concatenate([np.zeros(0, np.int32), *sheets]))
    return HomologousPoints(truth.mesh.nodes[nodes], truth.displacement[nodes], np.full(len(nodes), NOISE_M))


def solve_together(patient: PatientModel, specs: Sequence[TruthSpec]) -> list[InverseTruth]:
    """Truths of gravity alone at table 1's stiffness; those of one stiffness field and state share their factorisation.

    The same as :func:`~brainshift_ros.experiments.inverse_truths.solve_truth` for each, in a tenth of the time.

    Parameters
    ----------
    patient
        Their mesh.
    specs
        Without mannitol, a given shift or finite strain.

    Raises
    ------
    ValueError
        A spec asks for one of them.
    """
    if any(spec.mannitol > 0.0 or spec.surface_shift_mm is not None or spec.finite_strain for spec in specs):
        raise ValueError("only linear truths of gravity at its own size can be solved together")
    alike: dict[tuple[int, float, bool, SkullName], list[int]] = {}
    for number, spec in enumerate(specs):
        alike.setdefault((spec.seed, spec.stiffness_spread, spec.resected, spec.skull), []).append(number)
    found: dict[int, InverseTruth] = {}
    opening = craniotomy_opening(patient.mesh)
    for (seed, spread, resected, skull), numbers in alike.items():
        system = assemble_system(patient.mesh, varied_material(patient, seed, spread), resected=resected)
        cases = [Case("gravity", specs[number].direction, specs[number].fluid_level) for number in numbers]
        model = SteadyModel(system, [case.gravity_direction for case in cases], skull=skull, opening=opening)
        tissue = system.submesh.node_of >= 0
        for block in model.solve(cases):
            for place, case in enumerate(block.cases):
                number = numbers[case]
                found[number] = InverseTruth(specs[number], patient.mesh, block.displacement[:, :, place], tissue)
    return [found[number] for number in range(len(specs))]


def at_orientation(atlas: MemoryAtlas, direction: Direction) -> NDArray[np.bool_]:
    """Columns (m,) of one head orientation."""
    return np.array([entry.gravity_direction == direction for entry in atlas.entries])


def column_truth(atlas: MemoryAtlas, column: int) -> InverseTruth:
    """Take a column of an atlas for the truth."""
    entry, mesh = atlas.entries[column], atlas.mesh
    spec = TruthSpec(0, entry.gravity_direction, entry.fluid_level, entry.resected, stiffness_spread=0.0)
    if entry.mechanism == "mannitol":
        spec = replace(spec, mannitol=1.0, permeability=entry.intensity)
    tissue = np.ones(len(mesh.nodes), dtype=bool)
    if entry.resected:
        tissue[:] = False
        tissue[mesh.elements[mesh.region != Region.TUMOR]] = True
    return InverseTruth(spec, mesh, atlas.E[:, :, column].astype(np.float64), tissue)


class Judge:
    """Estimates from atlases that share a mesh, and their errors.

    Parameters
    ----------
    mesh
        Of the atlases.
    """

    def __init__(self, mesh: TetMesh) -> None:
        self._points, self._targets = PointLocator(mesh), _OnceLocator(mesh)

    def rows(self, atlas: MemoryAtlas, truth: InverseTruth, measured: HomologousPoints, options: InverseOptions) -> list[Row]:
        """Errors by target group, each with what the weights say.

        The fit is that of :func:`brainshift_ros.inverse.estimate.estimate_shift`, without its standard deviations.
        """
        whole = AppendedAtlas(atlas, None)
        rows = rows_at_points(whole, measured, locator=self._points, max_outside_mm=options.max_outside_mm)
        points, u, sigma = (values[rows.kept] for values in (measured.points, measured.displacements, measured.sigma))
        fit = fit_robustly(points, rows.M, u, sigma, whole.groups, method=options.method, outlier_sigmas=options.outlier_sigmas)
        weights = fit.solution.weights
        active = np.flatnonzero(weights)
        told = weights_told(atlas.entries, weights, truth.spec.direction)
        targets = Targets(truth, atlas, self._targets)
        return [told | row for row in targets.errors(whole.columns(active) @ weights[active])]


class _OnceLocator(PointLocator):
    """Finds the nodes of a mesh once: truths on one mesh share them."""

    _asked: ArrayLike | None = None
    _found: Located

    def locate(self, points: ArrayLike, max_outside_m: float = 0.0) -> Located:
        if points is not self._asked:
            self._asked, self._found = points, super().locate(points, max_outside_m)
        return self._found


def weights_told(entries: Sequence[AtlasEntry], weights: NDArray[np.float64], direction: Direction) -> Row:
    """Sum of the weights, how many count, mannitol's share, and how far their mean orientation is from the true one.

    Parameters
    ----------
    entries, weights
        Of the columns, m each.
    direction
        Along which gravity truly pulled.

    Returns
    -------
    dict
        ``nonzero`` counts the weights of the working set, ``nonzero_1_percent`` those that hold 1 % of their sum at least.
        Where all weights are zero, share and angle are NaN.
    """
    total = float(weights.sum())
    directions = np.array([entry.gravity_direction for entry in entries])
    drug = np.array([entry.mechanism == "mannitol" for entry in entries])
    mean = weights @ directions
    angle = np.degrees(np.arccos(np.clip(unit(mean) @ np.asarray(direction), -1.0, 1.0))) if total > 0.0 else np.nan
    return {
        "nonzero": int((weights > 0.0).sum()),
        "nonzero_1_percent": int((weights > 0.01 * total).sum()) if total > 0.0 else 0,
        "weight_sum": total,
        "mannitol_share": float(weights[drug].sum() / total) if total > 0.0 else np.nan,
        "orientation_error_deg": float(angle),
    }


def degrees_from_plan(direction: Direction) -> float:
    """Angle from a direction of gravity to the planned one."""
    return float(polar(np.array([direction]))[0][0])


def polar(directions: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angle from the planned direction, degrees, and azimuth around it, radians, of directions (n, 3)."""
    x, y, z = tangent_frame(PLANNED) @ directions.T
    return np.degrees(np.arccos(np.clip(z, -1.0, 1.0))), np.arctan2(y, x)


def values_of(rows: Iterable[Mapping[str, Any]], column: str, **labels: object) -> NDArray[np.float64]:
    """Take a column of those rows that bear all the labels."""
    return np.array(
        [row[column] for row in rows if all(row[name] == label for name, label in labels.items())], dtype=np.float64
    )


def rank_sum_p(first: ArrayLike, second: ArrayLike) -> float:
    """Two-sided p of the Wilcoxon rank sum test, unpaired."""
    return float(ranksums(first, second).pvalue)


def signed_rank_p(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Two-sided p of the Wilcoxon signed rank test, paired; 1 where all pairs are equal."""
    return 1.0 if np.array_equal(first, second) else float(wilcoxon(first, second).pvalue)


def p_text(p: float) -> str:
    """Write a p-value for a sentence."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"
