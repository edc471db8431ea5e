"""The report on a segmentation: its figures against SimpleITK, and against shapes whose answers are known."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.evaluation.overlap import region_agreement
from brainshift_ros.evaluation.report import compare_segmentations
from brainshift_ros.evaluation.septa_distance import points_on, septa_distances
from brainshift_ros.evaluation.slice_errors import slice_errors, widest_disc_mm
from brainshift_ros.geometry import rigid, transform_points
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.septa.sheets import Septum
from brainshift_ros.surface.surface import Surface
from brainshift_ros.units import mm_to_m

SIZE = 60
T = np.diag([0.002, 0.002, 0.002, 1.0])
T[:3, 3] = -0.001 * (SIZE - 1)  # the image's middle at the origin


def ball(
    radius_mm: float, center_mm: tuple[float, float, float] = (0.0, 0.0, 0.0), T_patient_voxel: np.ndarray = T
) -> np.ndarray:
    points = transform_points(T_patient_voxel, np.moveaxis(np.indices((SIZE, SIZE, SIZE)), 0, -1))
    return np.linalg.norm(points - mm_to_m(center_mm), axis=-1) < mm_to_m(radius_mm)


def brain(shift_mm: float = 0.0) -> Volume:
    """A ball with all regions in it, the inner ones shifted along x."""
    labels = np.where(ball(50.0), Region.LEFT_CEREBRUM, Region.OUTSIDE).astype(np.uint8)
    labels[ball(50.0) & (np.indices(labels.shape)[0] >= SIZE // 2)] = Region.RIGHT_CEREBRUM
    labels[ball(15.0, (shift_mm, -25.0, -25.0))] = Region.CEREBELLUM
    labels[ball(8.0, (shift_mm, 0.0, -35.0))] = Region.BRAINSTEM
    labels[ball(10.0, (shift_mm - 20.0, 20.0, 20.0))] = Region.TUMOR
    return Volume(labels, T)


def test_dice_and_volumes_against_simpleitk() -> None:
    automatic, manual = brain(3.0), brain()
    found = region_agreement(automatic, manual)
    measures = sitk.LabelOverlapMeasuresImageFilter()
    measures.Execute(*(sitk.GetImageFromArray(volume.data) for volume in (manual, automatic)))
    for region in (Region.LEFT_CEREBRUM, Region.RIGHT_CEREBRUM, Region.CEREBELLUM, Region.BRAINSTEM, Region.TUMOR):
        assert found[region.name.lower()].dice == pytest.approx(measures.GetDiceCoefficient(int(region)))
        assert found[region.name.lower()].manual_ml == pytest.approx(np.sum(manual.data == region) * 8e-3)
    assert found["cerebellum"].dice < 0.9
    assert found["brain"].dice == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("edges_mm", [(2.0, 2.0, 2.0), (1.5, 2.0, 3.0)])
def test_largest_surface_distance_is_simpleitks_hausdorff_distance(edges_mm: tuple[float, float, float]) -> None:
    T_patient_voxel = np.diag([*mm_to_m(edges_mm), 1.0])
    T_patient_voxel[:3, 3] = -T_patient_voxel[:3, :3] @ np.full(3, 0.5 * (SIZE - 1))
    masks = [ball(*shape, T_patient_voxel).astype(np.uint8) for shape in ((26.0, (0, 0, 0)), (20.0, (3.0, 4.0, 2.0)))]
    found = region_agreement(*(Volume(mask, T_patient_voxel) for mask in masks))["brain"].surface
    images = [sitk.GetImageFromArray(mask.T) for mask in masks]
    for image in images:
        image.SetSpacing(edges_mm)
    hausdorff = sitk.HausdorffDistanceImageFilter()
    hausdorff.Execute(*images)
    assert found is not None
    assert found.max_mm == pytest.approx(hausdorff.GetHausdorffDistance())


def test_surface_distance_of_concentric_balls_is_the_difference_of_their_radii() -> None:
    found = region_agreement(Volume(ball(50.0).astype(np.uint8), T), Volume(ball(40.0).astype(np.uint8), T))["brain"].surface
    assert found is not None
    assert found.mean_mm == pytest.approx(10.0, abs=0.5)
    assert found.std_mm < 1.0
    assert found.p95_mm <= found.max_mm < 12.0


def test_slices_with_errors_are_those_into_which_the_disc_fits() -> None:
    manual = brain()
    lump = manual.data.copy()
    lump[53:57, 28:32, 20:25] = Region.RIGHT_CEREBRUM  # 8 x 8 mm beside the brain, in five slices
    found = slice_errors(Volume(lump, T), manual, visible_mm=6.0)
    assert (found.orientation, found.slices) == ("axial", SIZE)
    assert found.with_errors == (20, 21, 22, 23, 24)
    assert found.with_brain == np.sum((manual.data > 0).any(axis=(0, 1)))
    band = Volume(ball(52.0).astype(np.uint8), T)  # one voxel all around: what raters differ by
    assert slice_errors(band, manual, visible_mm=6.0).with_errors == ()
    assert slice_errors(manual, manual).thickest_mm == 0.0


@pytest.mark.parametrize(("axis", "orientation"), [(0, "sagittal"), (1, "coronal"), (2, "axial")])
def test_slices_are_named_by_anatomy_whatever_the_storage(axis: int, orientation: str) -> None:
    turned = Volume(np.moveaxis(brain().data, (0, 1, 2), (2, 0, 1)), T[:, [1, 2, 0, 3]])
    assert slice_errors(brain(), brain(), axis).orientation == orientation
    assert slice_errors(turned, turned).orientation == "axial"
    cut = turned.data.copy()
    cut[:, 30] = 0  # axis 1 is the body's long axis now
    assert slice_errors(Volume(cut, turned.T_patient_voxel), turned).with_errors == (30,)


def test_widest_disc() -> None:
    strip = np.zeros((40, 40), dtype=bool)
    strip[10:17, :] = True
    assert widest_disc_mm(strip, np.array([1.0, 1.0])) == pytest.approx(7.0)
    assert widest_disc_mm(strip, np.array([0.5, 1.0])) == pytest.approx(3.5)
    x, y = np.indices((40, 40)) - 20.0
    assert widest_disc_mm(x**2 + y**2 < 12.0**2, np.array([1.0, 1.0])) == pytest.approx(24.0, abs=1.0)
    assert widest_disc_mm(np.zeros((3, 3), dtype=bool), np.array([1.0, 1.0])) == 0.0


def rectangle(corner_mm: tuple, first_mm: tuple, second_mm: tuple, name: str, steps: int = 25) -> Septum:
    """A flat sheet from a corner along two edges; the normal is first x second."""
    u, v = np.meshgrid(*(np.linspace(0.0, 1.0, steps),) * 2, indexing="ij")
    points = np.array(corner_mm) + u[..., None] * np.array(first_mm) + v[..., None] * np.array(second_mm)
    index = np.arange(steps * steps).reshape(steps, steps)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.vstack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
    return Septum(name, Surface(mm_to_m(points.reshape(-1, 3)), faces))


def septa() -> tuple[Septum, ...]:
    return (
        rectangle((0.0, -60.0, 0.0), (0.0, 120.0, 0.0), (0.0, 0.0, 60.0), "falx"),
        rectangle((0.0, -50.0, 0.0), (-45.0, 0.0, 0.0), (0.0, 30.0, 0.0), "tentorium"),
        rectangle((0.0, -50.0, 0.0), (45.0, 0.0, 0.0), (0.0, 30.0, 0.0), "tentorium"),
    )


def moved(septum: Septum, shift: np.ndarray) -> Septum:
    return replace(septum, surface=Surface(septum.surface.vertices + shift, septum.surface.faces))


def test_shifted_sheets_are_as_far_as_they_were_shifted() -> None:
    falx, left, right = septa()
    shifted = moved(falx, mm_to_m([3.0, 0, 0])), moved(left, mm_to_m([0, 0, -2.0])), moved(right, mm_to_m([0, 0, 5.0]))
    found = septa_distances(shifted, septa(), brain())
    for part in ("falx", "falx_anterior", "falx_middle", "falx_posterior"):
        assert found[part].to_manual.mean_mm == pytest.approx(3.0, abs=1e-6), part
    assert found["tentorium_left"].to_manual.mean_mm == pytest.approx(2.0, abs=0.05)
    assert found["tentorium_right"].to_manual.mean_mm == pytest.approx(5.0, abs=0.05)
    assert found["all"].to_manual.max_mm >= 5.0
    assert (
        sum(found[f"falx_{third}"].to_manual.count for third in ("anterior", "middle", "posterior"))
        == found["falx"].to_manual.count
    )


def test_thirds_tell_where_the_falx_is_off() -> None:
    falx = septa()[0]
    forward = falx.surface.vertices[:, 1] > mm_to_m(22.0)
    bent = replace(falx, surface=Surface(falx.surface.vertices + forward[:, None] * mm_to_m([6.0, 0, 0]), falx.surface.faces))
    found = septa_distances([bent], [falx], brain())
    assert found["falx_anterior"].to_manual.mean_mm > 4.0
    assert found["falx_posterior"].to_manual.max_mm < 1e-6
    assert "tentorium_left" not in found


def test_a_sheet_that_is_too_short_shows_from_the_manual_side_only() -> None:
    falx = septa()[0]
    short = rectangle((0.0, -60.0, 0.0), (0.0, 60.0, 0.0), (0.0, 0.0, 60.0), "falx")
    found = septa_distances([short], [falx], brain())["falx"]
    assert found.to_manual.max_mm < 1e-6
    assert found.from_manual.max_mm > 45.0


def test_what_lies_outside_the_brain_does_not_count() -> None:
    falx = septa()[0]
    far = rectangle((0.0, -200.0, 0.0), (0.0, 400.0, 0.0), (0.0, 0.0, 200.0), "falx", steps=60)
    assert septa_distances([far], [falx], brain())["falx"].to_manual.max_mm < 1.5
    outside = moved(falx, mm_to_m([0.0, 0.0, 120.0]))
    report = compare_segmentations(brain(), brain(), [outside], [falx])
    assert report.septa["falx"].to_manual is None
    assert "no part of the automatic falx lies in the brain" in report.warnings


def test_the_fissure_counts_as_brain() -> None:
    split = brain()
    split.data[SIZE // 2 - 2 : SIZE // 2 + 2] = 0  # 8 mm between the hemispheres
    found = septa_distances([septa()[0]], [septa()[0]], split)["falx"].to_manual
    whole = septa_distances([septa()[0]], [septa()[0]], brain())["falx"].to_manual
    assert 0.9 * whole.count < found.count <= whole.count  # a groove is left along the brain's surface


def test_points_are_spread_evenly() -> None:
    sheet = rectangle((0.0, 0.0, 0.0), (40.0, 0.0, 0.0), (0.0, 80.0, 0.0), "falx").surface
    points = points_on(sheet, spacing_mm=1.0)
    assert len(points) == pytest.approx(3200, abs=1)
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=(4, 8))
    assert counts.min() > 80
    assert counts.max() < 120


def test_report_is_json_and_the_same_in_any_frame_of_storage() -> None:
    automatic, manual = brain(4.0), brain()
    plain = compare_segmentations(automatic, manual, septa(), septa())
    text = json.loads(json.dumps(plain.to_json()))
    assert text["regions"]["cerebellum"]["dice"] == plain.regions["cerebellum"].dice
    assert text["septa"]["falx_middle"]["to_manual"]["mean_mm"] == pytest.approx(0.0, abs=1e-9)
    flipped = Volume(automatic.data[::-1].copy(), automatic.T_patient_voxel @ np.diag([-1.0, 1, 1, 1]))
    flipped.T_patient_voxel[:3, 3] += automatic.T_patient_voxel[:3, 0] * (SIZE - 1)
    assert compare_segmentations(flipped, manual, septa(), septa()).to_json() == plain.to_json()


def test_oblique_patients_get_the_same_figures() -> None:
    T_turned = rigid(Rotation.from_euler("xyz", [8, -5, 12], degrees=True), [0.01, 0.02, 0.0])
    turned = [Volume(volume.data, T_turned @ T) for volume in (brain(4.0), brain())]
    plain, oblique = (region_agreement(*pair)["cerebellum"] for pair in ((brain(4.0), brain()), turned))
    assert oblique.dice == plain.dice
    assert oblique.surface.mean_mm == pytest.approx(plain.surface.mean_mm)


def test_faults() -> None:
    nothing = Volume(np.zeros_like(brain().data), T)
    with pytest.raises(InputError, match="automatic labels: label no voxel"):
        compare_segmentations(nothing, brain())
    elsewhere = Volume(brain().data, rigid(Rotation.identity(), [1.0, 0, 0]) @ T)
    with pytest.raises(InputError, match="no voxel in common"):
        compare_segmentations(elsewhere, brain())
    without = brain()
    without.data[without.data == Region.TUMOR] = Region.LEFT_CEREBRUM
    report = compare_segmentations(without, brain())
    assert report.regions["tumor"].dice == 0.0
    assert report.warnings == ("the automatic labels hold no tumor",)
