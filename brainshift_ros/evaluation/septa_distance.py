"""Closest-point distances between two versions of falx and tentorium, as in figure 25 of the thesis."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from brainshift_ros.evaluation.distances import DistanceFigures, figures_of
from brainshift_ros.image.labels import cropped
from brainshift_ros.image.resample import sample
from brainshift_ros.image.volume import Volume
from brainshift_ros.septa.sheets import Septum
from brainshift_ros.septa.side import side_of_sheet
from brainshift_ros.surface.queries import closest_points
from brainshift_ros.surface.surface import Surface
from brainshift_ros.surface.surfacing import merged
from brainshift_ros.units import m_to_mm, mm_to_m

#: Gaps of the brain mask narrower than twice this are inside the brain: the fissures in which the septa lie.
FISSURE_MM = 6.0

_POINT_SPACING_MM = 1.0


@dataclass(frozen=True)
class SheetDistance:
    """Distances inside the brain, from points on one version of a sheet to the closest point of the other.

    Attributes
    ----------
    to_manual
        From the automatic sheet: how far it is off. None if none of it lies inside the brain.
    from_manual
        From the manual sheet: large where the automatic one is too short.
    """

    to_manual: DistanceFigures | None
    from_manual: DistanceFigures | None


def septa_distances(automatic: Sequence[Septum], manual: Sequence[Septum], labels: Volume) -> Mapping[str, SheetDistance]:
    """Compare falx and tentorium, part by part.

    Parts are the falx, its anterior, middle and posterior third (equal lengths along the anterior-posterior extent of the
    manual falx inside the brain), left and right tentorium (sides of the manual falx), and all together. Points are spread
    evenly over the sheets; those outside the brain, whose fissures are filled, do not count, for there a sheet's extent is
    arbitrary.

    Parameters
    ----------
    automatic, manual
        Falx and tentoria; what either lacks is left out.
    labels
        The manual label image.
    """
    brain = _with_fissures(labels)
    report: dict[str, SheetDistance] = {}
    falx, tentorium = (_compared(name, automatic, manual, brain) for name in ("falx", "tentorium"))
    if falx is not None:
        report["falx"] = falx.figures()
        y = falx.manual_points[:, 1]
        bounds = np.linspace(y.min(), y.max(), 4)[1:3] if y.size else np.zeros(2)
        report["falx_posterior"] = falx.figures(lambda points: points[:, 1] < bounds[0])
        report["falx_middle"] = falx.figures(lambda points: (points[:, 1] >= bounds[0]) & (points[:, 1] < bounds[1]))
        report["falx_anterior"] = falx.figures(lambda points: points[:, 1] >= bounds[1])
    if tentorium is not None:
        is_right = _right_of(_joined(manual, "falx"))
        report["tentorium_left"] = tentorium.figures(lambda points: ~is_right(points))
        report["tentorium_right"] = tentorium.figures(is_right)
    compared = [sheets for sheets in (falx, tentorium) if sheets is not None]
    if compared:
        report["all"] = SheetDistance(
            figures_of(np.concatenate([sheets.to_manual for sheets in compared])),
            figures_of(np.concatenate([sheets.from_manual for sheets in compared])),
        )
    return report


@dataclass(frozen=True)
class _Compared:
    """Points inside the brain on both versions of a sheet, (n, 3), and the distance of each to the other version, metres."""

    automatic_points: NDArray[np.float64]
    to_manual: NDArray[np.float64]
    manual_points: NDArray[np.float64]
    from_manual: NDArray[np.float64]

    def figures(self, chosen: Callable[[NDArray[np.float64]], NDArray[np.bool_]] | None = None) -> SheetDistance:
        if chosen is None:
            return SheetDistance(figures_of(self.to_manual), figures_of(self.from_manual))
        return SheetDistance(
            figures_of(self.to_manual[chosen(self.automatic_points)]), figures_of(self.from_manual[chosen(self.manual_points)])
        )


def _compared(name: str, automatic: Sequence[Septum], manual: Sequence[Septum], brain: Volume) -> _Compared | None:
    ours, theirs = _joined(automatic, name), _joined(manual, name)
    if ours is None or theirs is None:
        return None
    on_ours, on_theirs = (points_on(sheet) for sheet in (ours, theirs))
    on_ours, on_theirs = (points[sample(brain, points, "nearest") > 0] for points in (on_ours, on_theirs))
    return _Compared(on_ours, closest_points(theirs, on_ours).distance, on_theirs, closest_points(ours, on_theirs).distance)


def points_on(surface: Surface, spacing_mm: float = _POINT_SPACING_MM) -> NDArray[np.float64]:
    """Spread points evenly over a surface, one for each square of `spacing_mm`; the same surface gives the same points."""
    corners = surface.vertices[surface.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    count = int(np.ceil(area.sum() / mm_to_m(spacing_mm) ** 2))
    # Stratified: one point in each of `count` equal shares of the area.
    rng = np.random.default_rng(0)
    face = np.searchsorted(np.cumsum(area), (np.arange(count) + rng.random(count)) / count * area.sum())
    face = np.minimum(face, len(area) - 1)
    root, along = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1.0 - root, root * (1.0 - along), root * along], axis=1)
    return np.einsum("ni,nik->nk", weights, corners[face])


def _joined(septa: Iterable[Septum], name: str) -> Surface | None:
    surfaces = [septum.surface for septum in septa if septum.name == name]
    return merged(surfaces) if surfaces else None


def _right_of(falx: Surface | None) -> Callable[[NDArray[np.float64]], NDArray[np.bool_]]:
    """Tell right from left by the falx, or without one by the patient's x axis."""
    if falx is None:
        return lambda points: points[:, 0] >= 0.0
    return lambda points: side_of_sheet(falx, points).height >= 0.0


def _with_fissures(labels: Volume) -> Volume:
    """Brain mask closed by a ball of radius `FISSURE_MM`, cropped to the brain."""
    edges_mm = m_to_mm(np.linalg.norm(labels.T_patient_voxel[:3, :3], axis=0))
    margin = int(np.ceil(FISSURE_MM / edges_mm.min())) + 1
    small = cropped(labels, labels.data > 0, margin)
    brain = np.pad(small.data > 0, margin)
    near = ndimage.distance_transform_edt(~brain, sampling=edges_mm) <= FISSURE_MM
    closed = ndimage.distance_transform_edt(near, sampling=edges_mm) > FISSURE_MM
    inner = (slice(margin, -margin),) * 3
    return Volume((closed | brain)[inner].astype(np.uint8), small.T_patient_voxel)
