"""Labels, tumour masks, the template's anatomy, the drawn tumour."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import rigid, transform_points
from brainshift_ros.image.labels import add_tumor, cropped, edge_warnings, labels_on_grid
from brainshift_ros.image.landmarks import read_septa_landmarks, read_template_landmarks
from brainshift_ros.image.resample import sample
from brainshift_ros.image.tumor import TumorShape, draw_tumor
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.resources import resource
from brainshift_ros.simulation.synthetic_grid import reoriented
from brainshift_ros.units import mm_to_m

T = np.diag([0.002, 0.002, 0.002, 1.0])


def ball(center: float = 15.0, radius: float = 10.0) -> Volume:
    distance = np.linalg.norm(np.indices((30, 30, 30)) - center, axis=0)
    return Volume((distance < radius).astype(np.uint8), T)


@pytest.mark.parametrize("value", [6, -1, 1.5])
def test_strange_label_values_are_named(value: float) -> None:
    labels = ball().data.astype(float)
    labels[15, 15, 15] = value
    with pytest.raises(InputError, match=f"{value:g}"):
        labels_on_grid(Volume(labels, T), ball())


def test_labels_stored_as_scaled_floats_are_taken_as_whole_numbers() -> None:
    scaled = ball().data * np.float32(0.9999)
    np.testing.assert_array_equal(labels_on_grid(Volume(scaled, T), ball()).data, ball().data)


def test_labels_elsewhere_are_refused() -> None:
    shifted = T.copy()
    shifted[:3, 3] = 0.5
    with pytest.raises(InputError, match="0 % of its brain"):
        labels_on_grid(Volume(ball().data, shifted), ball())


def test_labels_on_a_coarser_grid_keep_their_place() -> None:
    coarse = Volume(ball().data[::3, ::3, ::3], T @ np.diag([3.0, 3.0, 3.0, 1.0]))
    on_grid = labels_on_grid(coarse, ball())
    overlap = 2 * np.sum((on_grid.data > 0) & (ball().data > 0)) / (on_grid.data.sum() + ball().data.sum())
    assert overlap > 0.85


def test_tumour_mask_faults() -> None:
    with pytest.raises(InputError, match="marks no voxel"):
        add_tumor(ball(), Volume(np.zeros((5, 5, 5)), T))
    with pytest.raises(InputError, match="lies in the brain"):
        add_tumor(ball(), ball(center=24.0, radius=5.0))
    tumor = add_tumor(ball(), ball(radius=4.0))
    np.testing.assert_array_equal(tumor.data == Region.TUMOR, ball(radius=4.0).data > 0)


def test_several_tumours_are_kept() -> None:
    two = Volume(ball(9.0, 3.0).data | ball(20.0, 2.5).data, T)
    labels = add_tumor(ball(radius=14.0), two)
    np.testing.assert_array_equal(labels.data == Region.TUMOR, two.data > 0)
    third = add_tumor(labels, ball(15.0, 2.0))
    np.testing.assert_array_equal(third.data == Region.TUMOR, (two.data | ball(15.0, 2.0).data) > 0)


def test_a_tumour_of_a_few_voxels_is_kept_or_refused_with_the_reason() -> None:
    few = np.zeros_like(ball().data)
    few[15, 15, 14:17] = 1
    assert np.count_nonzero(add_tumor(ball(), Volume(few, T)).data == Region.TUMOR) == 3
    between = np.zeros((120, 120, 120), np.uint8)
    between[61, 61, 61] = 1  # on a grid four times as fine, between the voxels of the labels
    fine = Volume(between, T @ np.diag([0.25, 0.25, 0.25, 1.0]))
    with pytest.raises(InputError, match=r"marks 1 voxel\(s\), so little that none"):
        add_tumor(ball(), fine)


@settings(max_examples=15, deadline=None)
@given(
    angles=st.tuples(*[st.floats(-45.0, 45.0)] * 3),
    edges_mm=st.tuples(st.floats(0.8, 1.6), st.floats(0.8, 1.6), st.floats(0.8, 3.0)),
    order=st.permutations(range(3)),
)
def test_labels_and_tumours_come_from_any_grid(angles: tuple, edges_mm: tuple, order: list[int]) -> None:
    """A ball drawn on an oblique, anisotropic grid keeps its place and, within the voxels' size, its volume."""
    shape = np.ceil(70.0 / np.array(edges_mm)).astype(int)
    T_other = rigid(Rotation.from_euler("xyz", angles, degrees=True), [0.03, 0.03, 0.03]) @ np.diag([*mm_to_m(edges_mm), 1.0])
    T_other[:3, 3] -= T_other[:3, :3] @ (0.5 * (shape - 1))
    points = transform_points(T_other, np.moveaxis(np.indices(tuple(shape)), 0, -1))
    distance = np.linalg.norm(points - 0.03, axis=-1)
    drawn = reoriented(Volume((distance < 0.02).astype(np.uint8), T_other), order)
    tumor = reoriented(Volume(distance < 0.010, T_other), order, (-1, 1, -1))
    labels = add_tumor(labels_on_grid(drawn, ball()), tumor)
    for radius_m, mask in ((0.02, labels.data > 0), (0.010, labels.data == Region.TUMOR)):
        assert np.count_nonzero(mask) * 8e-9 == pytest.approx(4 / 3 * np.pi * radius_m**3, rel=0.15)
        centre = transform_points(T, np.argwhere(mask).mean(axis=0))
        np.testing.assert_allclose(centre, 0.03, atol=0.001)


def test_image_that_ends_inside_the_brain_is_said() -> None:
    whole = ball()
    assert edge_warnings(whole) == ()
    cut = Volume(whole.data[:, :, :18], T)
    (warning,) = edge_warnings(cut)
    area_cm2 = np.count_nonzero(cut.data[:, :, -1]) * 0.04
    assert warning.startswith(f"the image's superior edge cuts the brain over {area_cm2:.1f} cm^2")
    (flipped,) = edge_warnings(reoriented(cut, (2, 0, 1), (-1, 1, -1)))
    assert flipped == warning
    (left,) = edge_warnings(Volume(whole.data[12:], T))
    assert "left" in left
    stem = Volume(np.where(whole.data > 0, np.uint8(Region.BRAINSTEM), np.uint8(0))[:, :, 12:], T)
    assert edge_warnings(stem) == ()


def test_cropping_keeps_places() -> None:
    volume = Volume(np.random.default_rng(0).uniform(size=(30, 30, 30)), T)
    small = cropped(volume, ball(radius=5.0).data > 0, margin=2)
    point = transform_points(T, [15.0, 14.0, 17.0])
    assert small.data.size < volume.data.size
    assert sample(small, point) == pytest.approx(sample(volume, point))


# Places that any atlas of the MNI brain puts in these structures (mm, RAS).
LANDMARKS = [
    ((-28, 4, 30), Region.LEFT_CEREBRUM),  # frontal white matter
    ((28, -4, 30), Region.RIGHT_CEREBRUM),
    ((-10, -18, 8), Region.LEFT_CEREBRUM),  # thalamus
    ((12, -85, 4), Region.RIGHT_CEREBRUM),  # calcarine cortex
    ((-28, -20, -16), Region.LEFT_CEREBRUM),  # hippocampus
    ((30, -38, -20), Region.RIGHT_CEREBRUM),  # fusiform gyrus, just above the tentorium
    ((-24, -60, -35), Region.CEREBELLUM),
    ((2, -62, -18), Region.CEREBELLUM),  # vermis
    ((30, -72, -28), Region.CEREBELLUM),  # crus I, just below the tentorium
    ((0, -28, -30), Region.BRAINSTEM),  # pons
    ((0, -40, -55), Region.BRAINSTEM),  # medulla
    ((-8, -20, -14), Region.BRAINSTEM),  # cerebral peduncle
]


@pytest.mark.parametrize(("place_mm", "region"), LANDMARKS)
def test_template_labels_agree_with_anatomy(template_case: tuple[Volume, Volume], place_mm: tuple, region: Region) -> None:
    _, labels = template_case
    assert sample(labels, mm_to_m(place_mm), "nearest") == region


def test_template_volumes_are_human(template_case: tuple[Volume, Volume]) -> None:
    _, labels = template_case
    ml = np.bincount(labels.data.ravel(), minlength=6) * 8e-3
    assert 120 < ml[Region.CEREBELLUM] < 240
    assert 25 < ml[Region.BRAINSTEM] < 50
    assert abs(ml[Region.LEFT_CEREBRUM] + ml[Region.TUMOR] - ml[Region.RIGHT_CEREBRUM]) < 0.05 * ml[Region.RIGHT_CEREBRUM]


def test_drawn_tumour_has_its_size_and_stays_inside() -> None:
    t1, labels = Volume(ball(radius=14.0).data * 0.8, T), ball(radius=14.0)
    shape = TumorShape(center_mm=(30.0, 30.0, 30.0), diameter_mm=24.0)
    drawn, marked = draw_tumor(t1, labels, shape)
    ml = np.sum(marked.data == Region.TUMOR) * 8e-3
    assert ml == pytest.approx(4 / 3 * np.pi * 1.2**3, rel=0.15)
    np.testing.assert_array_equal(drawn.data[labels.data == 0], 0.0)
    other, _ = draw_tumor(t1, labels, TumorShape(center_mm=(30.0, 30.0, 30.0), diameter_mm=24.0, seed=8))
    assert np.any(other.data != drawn.data)
    with pytest.raises(InputError, match="wholly inside"):
        draw_tumor(t1, labels, TumorShape(center_mm=(8.0, 30.0, 30.0)))


def test_landmark_files(tmp_path: Path) -> None:
    shipped = resource("config/template_mni152.yaml")
    landmarks = read_template_landmarks(shipped)
    right = landmarks.septa.tentorium.right_side
    assert right.attachment[0][0] == -landmarks.septa.tentorium.left.attachment[0][0]
    assert read_septa_landmarks(shipped) == landmarks.septa
    bad = tmp_path / "septa.yaml"
    bad.write_text("septa: {straight_sinus: [[0, 0]], falx: 3}")
    with pytest.raises(InputError, match=r"septa\.falx"):
        read_septa_landmarks(bad)
    bad.write_text("{")
    with pytest.raises(InputError, match="is not YAML"):
        read_septa_landmarks(bad)
    bad.write_text("")
    with pytest.raises(InputError, match="holds no keys"):
        read_septa_landmarks(bad)
