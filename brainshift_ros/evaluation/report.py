"""What an automatic segmentation is worth against a manual one (spec P2; thesis, chapter V, table 7 and figure 25)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from brainshift_ros.errors import InputError
from brainshift_ros.evaluation.overlap import RegionAgreement, region_agreement
from brainshift_ros.evaluation.septa_distance import SheetDistance, septa_distances
from brainshift_ros.evaluation.slice_errors import VISIBLE_MM, SliceErrors, slice_errors
from brainshift_ros.image.resample import resample
from brainshift_ros.image.volume import Volume
from brainshift_ros.septa.sheets import Septum


@dataclass(frozen=True)
class SegmentationReport:
    """Agreement of an automatic with a manual segmentation.

    Attributes
    ----------
    regions
        "brain" and the names of regions in lower case, each with Dice, volumes and surface distances.
    slices
        Slices that would need editing.
    septa
        "falx", "falx_anterior", "falx_middle", "falx_posterior", "tentorium_left", "tentorium_right" and "all"; empty
        without septa on both sides.
    warnings
        What a reader must know.
    """

    regions: Mapping[str, RegionAgreement]
    slices: SliceErrors
    septa: Mapping[str, SheetDistance]
    warnings: tuple[str, ...]

    def to_json(self) -> dict[str, object]:
        """Give all figures as plain dictionaries, lists, numbers and strings, as :mod:`json` writes them."""
        slices = asdict(self.slices)
        slices["with_errors"] = list(self.slices.with_errors)
        return {
            "regions": {name: asdict(agreement) for name, agreement in self.regions.items()},
            "slices": slices,
            "septa": {name: asdict(distance) for name, distance in self.septa.items()},
            "warnings": list(self.warnings),
        }


def compare_segmentations(
    automatic: Volume,
    manual: Volume,
    automatic_septa: Sequence[Septum] = (),
    manual_septa: Sequence[Septum] = (),
    *,
    slice_axis: int | None = None,
    visible_mm: float = VISIBLE_MM,
) -> SegmentationReport:
    """Compare two segmentations of one patient.

    Parameters
    ----------
    automatic, manual
        Values of :class:`~brainshift_ros.image.volume.Region`; compared on the grid of the manual one.
    automatic_septa, manual_septa
        Falx and tentoria, in the patient frame.
    slice_axis
        Image axis across the slices that are counted; by default they are axial.
    visible_mm
        A slice counts as wrong if a disc of this diameter fits into a disagreement.

    Raises
    ------
    InputError
        One of them labels nothing, or they do not overlap at all.
    """
    for name, labels in (("automatic labels", automatic), ("manual labels", manual)):
        if not np.any(labels.data):
            raise InputError(name, "label no voxel", "give label images with the brain in them")
    on_grid = resample(automatic, manual, "nearest")
    if not np.any((on_grid.data > 0) & (manual.data > 0)):
        problem = "have no voxel in common with the manual ones"
        raise InputError("automatic labels", problem, "compare segmentations of one patient, in one frame")
    regions = region_agreement(on_grid, manual)
    septa = septa_distances(automatic_septa, manual_septa, manual)
    warnings = [
        f"the {'automatic' if agreement.automatic_ml == 0.0 else 'manual'} labels hold no {name.replace('_', ' ')}"
        for name, agreement in regions.items()
        if agreement.surface is None
    ]
    warnings += [
        f"no part of the automatic {name.replace('_', ' ')} lies in the brain"
        for name, distance in septa.items()
        if distance.to_manual is None
    ]
    errors = slice_errors(on_grid, manual, slice_axis, visible_mm)
    return SegmentationReport(regions, errors, septa, tuple(warnings))
