"""Part of :mod:`brainshift_ros.experiments.dense_field`: the inverse driven by points on one side (figure 56)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.atlas.orientations import directions_in_cone
from brainshift_ros.correspondence.dense import interpolate
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.experiments.inverse_cases import Targets, measure_facets, opening_facets
from brainshift_ros.experiments.inverse_truths import InverseTruth, TruthSpec, solve_truth
from brainshift_ros.experiments.patients import template_patient
from brainshift_ros.experiments.skull_cases import SKULLS, MemoryAtlas, build_memory_atlas
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.span import AtlasSpan, atlas_span
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.registration.thinning import voxel_means
from brainshift_ros.simulation.truth import direction_between
from brainshift_ros.units import m_to_mm, mm_to_m

Row = dict[str, Any]
Progress = Callable[[str, float], None]
Side = Callable[[NDArray[np.float64]], NDArray[np.bool_]]

#: Ways to drive the inverse, in the order of the charts.
SPARSE = "measured points only"
UNWEIGHTED = "dense, all alike"
DIAGONAL = "dense, own sigmas (8.3)"
THINNED = "dense, sigmas raised for correlation"
COVARIANCE = "dense, covariance (8.5)"
METHODS = (SPARSE, UNWEIGHTED, DIAGONAL, THINNED, COVARIANCE)

#: Share of the opening that holds the measured points, from one side.
COVERAGES: Mapping[str, float] = {"even": 1.0, "one-sided": 0.35}

POINTS, NOISE_M, SPACING_M = 20, float(mm_to_m(0.4)), float(mm_to_m(4.0))

#: What the atlas cannot follow of a truth of another stiffness, for (8.5).
MODEL_SIGMA_M = float(mm_to_m(0.5))

_SKULL = SKULLS["contact, high cap"]
_PLANNED = (0.0, -0.94, -0.34)
_CONE, _ORIENTATIONS, _LEVELS = float(np.radians(20.0)), 20, (0.35, 0.5, 0.65)
_BESIDE_M = 0.01


def estimates(folder: Path, full: bool, seeds: range, progress: Progress) -> list[Row]:
    """Errors by target group of every method, coverage and truth.

    Parameters
    ----------
    folder
        Keeps the meshes.
    full
        Finer meshes.
    seeds
        One truth each: its direction, fluid level, stiffness, and the drawn points.
    progress
        Called with stage and fraction done.
    """
    truth_nodes, atlas_nodes = (10_000, 8_000) if full else (3_500, 3_000)
    truth_patient = template_patient(folder, truth_nodes, 1, progress)
    atlas_patient = template_patient(folder, atlas_nodes, 0, progress)
    system = assemble_system(atlas_patient.mesh, material_of(atlas_patient.tissue))
    progress("atlas", 0.0)
    atlas, _ = build_memory_atlas({False: system}, _PLANNED, _CONE, _ORIENTATIONS, _LEVELS, _SKULL)
    progress("atlas", 1.0)
    locator, span = PointLocator(atlas.mesh), atlas_span(atlas)
    planned = directions_in_cone(_PLANNED, _CONE, _ORIENTATIONS)
    rows: list[Row] = []
    for number, seed in enumerate(seeds):
        progress("truths and estimates", number / len(seeds))
        rng = np.random.default_rng([seed, 56])
        # Every truth pulls where the atlas has no entry, between those of a cone that is turned for each.
        x, y, z = direction_between(planned[rng.permutation(len(planned))[:12]], _PLANNED, _CONE)
        spec = TruthSpec(seed, (float(x), float(y), float(z)), float(rng.uniform(0.38, 0.62)), skull=_SKULL.model)
        truth = solve_truth(truth_patient, spec)
        targets = Targets(truth, atlas, locator)
        surface = targets.groups["surface"]
        for coverage, share in COVERAGES.items():
            measured, measured_side = _measured(truth, share, rng)
            near = measured_side(truth.mesh.nodes[surface])
            sides = {"surface, measured side": surface[near], "surface, other side": surface[~near]}
            for method, field, told in _estimates(atlas, locator, span, measured):
                labels = {"seed": seed, "coverage": coverage, "method": method}
                rows += [labels | row | told for row in targets.errors(field, sides)]
    progress("truths and estimates", 1.0)
    return rows


def _estimates(
    atlas: MemoryAtlas, locator: PointLocator, span: AtlasSpan, measured: HomologousPoints
) -> Iterator[tuple[str, NDArray[np.float64], Row]]:
    """Each method's displacement at the atlas's nodes, and what the dense field said of itself."""

    def solved(points: HomologousPoints, covariance: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        return estimate_shift(atlas, points, covariance=covariance, locator=locator, span=span).field.displacement

    dense = interpolate(measured, _cortex_points(atlas.mesh))
    told = {
        "dense_points": len(dense.points),
        "sigma_mm_p95": float(m_to_mm(np.quantile(dense.sigma, 0.95))),
        "farthest_mm": float(m_to_mm(dense.distance_m.max())),
    }
    alike = np.full(len(dense.points), float(np.median(measured.sigma)))
    yield SPARSE, solved(measured), told
    yield UNWEIGHTED, solved(HomologousPoints(dense.points, dense.displacements, alike)), told
    yield DIAGONAL, solved(dense.as_points()), told
    yield THINNED, solved(dense.as_independent_points()), told
    yield COVARIANCE, solved(dense.as_points(), dense.covariance(MODEL_SIGMA_M)), told


def _cortex_points(mesh: TetMesh) -> NDArray[np.float64]:
    """Points of the cortex in the opening, about `SPACING_M` apart, from its facets cut into 16."""
    corners = mesh.nodes[opening_facets(mesh)]
    steps = (np.arange(4) + 1 / 3) / 4.0
    shares = np.array([(a, b, 1.0 - a - b) for a in steps for b in steps if a + b < 1.0])
    return voxel_means(np.einsum("ka,nai->nki", shares, corners).reshape(-1, 3), SPACING_M)[0]


def _measured(truth: InverseTruth, share: float, rng: np.random.Generator) -> tuple[HomologousPoints, Side]:
    """Noisy points of the truth's cortex within the lowest `share` along a random direction, and a test for that side."""
    facets = opening_facets(truth.mesh)
    corners = truth.mesh.nodes[facets]
    middle, centers = corners.reshape(-1, 3).mean(axis=0), corners.mean(axis=1)
    _, _, axes = np.linalg.svd(centers - centers.mean(axis=0), full_matrices=False)
    angle = rng.uniform(0.0, 2 * np.pi)
    direction = np.array([np.cos(angle), np.sin(angle)]) @ axes[:2]
    along = (centers - middle) @ direction
    limit = np.quantile(along, share)
    measured = measure_facets(truth, facets[along <= limit], POINTS, NOISE_M, rng)
    return measured, lambda at: (at - middle) @ direction <= limit
