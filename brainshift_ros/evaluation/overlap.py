"""How well two label images agree, region by region."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.evaluation.distances import DistanceFigures, figures_of, surface_distances
from brainshift_ros.image.labels import voxel_volume
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.units import m3_to_ml

_REGIONS = tuple(region for region in Region if region != Region.OUTSIDE)


@dataclass(frozen=True)
class RegionAgreement:
    """Agreement on one region.

    Attributes
    ----------
    dice
        2 |A and M| / (|A| + |M|), 0 to 1.
    automatic_ml, manual_ml
        Volumes.
    surface
        Distances between the two surfaces, both directions together; None where one of them is missing.
    """

    dice: float
    automatic_ml: float
    manual_ml: float
    surface: DistanceFigures | None


def region_agreement(automatic: Volume, manual: Volume) -> Mapping[str, RegionAgreement]:
    """Compare the brain as a whole, then each region that either image labels.

    Parameters
    ----------
    automatic, manual
        Values of :class:`Region`, on one grid.
    """
    masks: dict[str, tuple[NDArray[np.bool_], NDArray[np.bool_]]] = {"brain": (automatic.data > 0, manual.data > 0)}
    for region in _REGIONS:
        masks[region.name.lower()] = automatic.data == region, manual.data == region
    edges = np.linalg.norm(manual.T_patient_voxel[:3, :3], axis=0)
    millilitres = float(m3_to_ml(voxel_volume(manual)))
    found = {}
    for name, (a, m) in masks.items():
        sizes = int(np.count_nonzero(a)), int(np.count_nonzero(m))
        if not any(sizes):
            continue
        surface = figures_of(surface_distances(a, m, edges)) if all(sizes) else None
        found[name] = RegionAgreement(dice(a, m), sizes[0] * millilitres, sizes[1] * millilitres, surface)
    return found


def dice(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Overlap of two masks (Dice 1945); 1 if both are empty."""
    total = np.count_nonzero(a) + np.count_nonzero(b)
    return float(2.0 * np.count_nonzero(a & b) / total) if total else 1.0
