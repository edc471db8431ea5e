"""Part of :mod:`brainshift_ros.experiments.uncertainty`: estimates of known truths, and their errors in standard deviations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from brainshift_ros.experiments.inverse_cases import Targets, measure
from brainshift_ros.experiments.inverse_truths import InverseTruth, TruthSpec, drawn_truth
from brainshift_ros.experiments.skull_cases import MemoryAtlas
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.inverse.span import atlas_span
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.units import m_to_mm, mm_to_m

Progress = Callable[[str, float], None]

#: Truths were drawn with seeds from here on to tune the constants of :mod:`brainshift_ros.inverse.discrepancy`; the study's
#: own are below.
TUNING_SEEDS = range(1000, 1048)

#: The brain's stiffness varies more or less than in the studies of accuracy.
_SPREADS = (0.15, 0.25, 0.4)

#: Finite strain is solved up to this shift, mm: softer brains find no equilibrium in the skull.
_MOST_STRAINED_MM = 12.0

#: Edges of the bins of distance to the nearest measured point, mm.
DISTANCES_MM = (0.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 80.0, 110.0, 160.0)


def varied_truth(seed: int) -> TruthSpec:
    """Draw a truth; some have a free cap, some are at finite strain, and their stiffness varies by 15 to 40 %."""
    spec = drawn_truth(seed, "free_cap" if seed % 8 == 5 else "contact")
    spread = float(np.random.default_rng([seed, 3]).choice(_SPREADS))
    if seed % 6 == 0 and spec.skull == "contact":
        assert spec.surface_shift_mm is not None
        shift_mm = min(spec.surface_shift_mm, _MOST_STRAINED_MM)
        spec = replace(spec, finite_strain=True, mannitol=0.0, permeability=0.0, surface_shift_mm=shift_mm)
    return replace(spec, stiffness_spread=spread)


def kind_of(spec: TruthSpec) -> str:
    """Name the model of a truth."""
    if spec.finite_strain:
        return "finite strain"
    if spec.skull == "free_cap":
        return "free cap"
    return "gravity and mannitol" if spec.mannitol > 0.0 else "gravity"


@dataclass(frozen=True)
class Scored:
    """Errors of one estimate at the targets of one group, or at one distance from the points.

    Attributes
    ----------
    labels
        Of truth, measurement and method, and ``group``.
    ratio
        Shape (k,), error of a component over its standard deviation, absolute.
    error_mm, std_mm
        Root mean squares of a component.
    """

    labels: dict[str, object]
    ratio: NDArray[np.float32]
    error_mm: float
    std_mm: float


def scored_estimates(
    atlas: MemoryAtlas,
    truths: Iterable[InverseTruth],
    methods: Sequence[str],
    counts: Sequence[int],
    noises_mm: Sequence[float],
) -> Iterator[Scored]:
    """Estimate each truth by every method from each number of points at each noise; score by group and by distance.

    Parameters
    ----------
    atlas
        In use.
    truths
        On other meshes.
    methods
        Names in :data:`brainshift_ros.inverse.methods.METHODS`.
    counts, noises_mm
        Of the measured points.
    """
    locator, span = PointLocator(atlas.mesh), atlas_span(atlas)
    for truth in truths:
        targets = Targets(truth, atlas, locator)
        for count in counts:
            for noise_mm in noises_mm:
                rng = np.random.default_rng([truth.spec.seed, count, int(1000 * noise_mm)])
                measured = measure(truth, count, float(mm_to_m(noise_mm)), rng)
                places = _places(truth, targets, measured.points)
                for method in methods:
                    options = InverseOptions(method=method)
                    estimate = estimate_shift(atlas, measured, options=options, locator=locator, span=span)
                    error = np.abs(targets.difference(estimate.field.displacement))
                    std = targets.at_targets(estimate.field.std)
                    labels = {
                        "seed": truth.spec.seed,
                        "truth": kind_of(truth.spec),
                        "resected": truth.spec.resected,
                        "points": count,
                        "noise_mm": noise_mm,
                        "method": method,
                    }
                    for name, ids in places.items():
                        own, deviation = error[ids], std[ids, None]
                        yield Scored(
                            labels | {"group": name, "targets": len(ids)},
                            (own / deviation).ravel().astype(np.float32),
                            float(m_to_mm(np.sqrt(np.mean(own**2)))),
                            float(m_to_mm(np.sqrt(np.mean(deviation**2)))),
                        )


def distance_name(low_mm: float, high_mm: float) -> str:
    """Name of a bin of distances."""
    return f"{low_mm:g} to {high_mm:g} mm"


def _places(truth: InverseTruth, targets: Targets, points: NDArray[np.float64]) -> dict[str, NDArray[np.intp]]:
    """Target nodes by group, and all of them by distance to the nearest measured point."""
    everything = np.unique(np.concatenate(list(targets.groups.values())))
    distance = m_to_mm(cKDTree(points).query(truth.mesh.nodes[everything])[0])
    places = dict(targets.groups)
    for low, high in pairwise(DISTANCES_MM):
        ids = everything[(distance >= low) & (distance < high)]
        if len(ids):
            places[distance_name(low, high)] = ids
    return places
