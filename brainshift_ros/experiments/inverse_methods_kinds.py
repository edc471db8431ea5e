"""Part of :mod:`brainshift_ros.experiments.inverse_methods`: kinds of truths, from the atlas's own model to other models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from brainshift_ros.experiments.inverse_truths import CONE_DEG, PLANNED, TruthSpec, drawn_truth, tilted

#: The kind that the headline figures are of: linear theory and skull contact, as in the atlas.
CONTACT = "as the atlas models it"

#: An error of the tracker between two scans, and how far a cavity falls in.
OFFSET_MM, COLLAPSE_MM = 2.0, 5.0

#: Soft brains at finite strain find no equilibrium: these keep to the smaller shifts of the thesis's patients.
_FINITE_SHIFT_MM = (4.0, 8.0)

#: How far outside the atlas's cone an orientation is, degrees.
_OUTSIDE_DEG = (5.0, 20.0)


@dataclass(frozen=True)
class Kind:
    """Truths that differ from the atlas in the same way.

    Attributes
    ----------
    name
        For tables and charts.
    specs
        The truths.
    nodes, mesh_seeds
        Of their meshes.
    offset_mm
        Error that all measured points share.
    collapse_mm
        By how much the tumour's cavity falls in.
    """

    name: str
    specs: Sequence[TruthSpec]
    nodes: int
    mesh_seeds: tuple[int, ...] = (1,)
    offset_mm: float = 0.0
    collapse_mm: float = 0.0


def kinds(full: bool) -> tuple[Kind, ...]:
    """All kinds, the atlas's own first; no two truths share a seed, so each has a stiffness field of its own."""
    first, each, at_finite_strain = (60, 12, 8) if full else (12, 3, 1)
    nodes, meshes = (10_000, (1, 2)) if full else (3_500, (1,))
    seeds = iter(range(1000))

    def some(count: int) -> list[int]:
        return [next(seeds) for _ in range(count)]

    contact = [drawn_truth(seed) for seed in some(first)]
    return (
        Kind(CONTACT, contact, nodes, meshes),
        Kind("finite strain", [_finite(seed) for seed in some(at_finite_strain)], 5_000 if full else 3_500),
        Kind("free cap", [drawn_truth(seed, skull="free_cap") for seed in some(each)], nodes, meshes),
        Kind("outside the cone", [_outside(seed) for seed in some(each)], nodes, meshes),
        Kind("tracker off by 2 mm", [drawn_truth(seed) for seed in some(each)], nodes, meshes, offset_mm=OFFSET_MM),
        Kind("cavity collapses", [_resected(seed) for seed in some(each)], nodes, meshes, collapse_mm=COLLAPSE_MM),
    )


def _finite(seed: int) -> TruthSpec:
    shift_mm = float(np.random.default_rng([seed, 8]).uniform(*_FINITE_SHIFT_MM))
    return replace(drawn_truth(seed), mannitol=0.0, permeability=0.0, finite_strain=True, surface_shift_mm=shift_mm)


def _outside(seed: int) -> TruthSpec:
    rng = np.random.default_rng([seed, 27])
    angle_deg, azimuth = CONE_DEG + rng.uniform(*_OUTSIDE_DEG), float(rng.uniform(0.0, 2.0 * np.pi))
    return replace(drawn_truth(seed), direction=tilted(PLANNED, float(np.radians(angle_deg)), azimuth))


def _resected(seed: int) -> TruthSpec:
    return replace(drawn_truth(seed), resected=True)
