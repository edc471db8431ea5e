"""Lamp, instruments, cavity and tracker error of the scan simulator, each against its own geometry or physics."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulation_cases import CENTER, DIAMETER_M, SMALL_SCANNER, mni_cortex

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, rigid, transform_points
from brainshift_ros.simulation.cavity import Cavity
from brainshift_ros.simulation.instruments import spatula, suction_tube
from brainshift_ros.simulation.lighting import Lighting
from brainshift_ros.simulation.scan_shift import draw_shift
from brainshift_ros.simulation.scanner import Seen, scanner_pose, take_scan
from brainshift_ros.simulation.scene import make_scene
from brainshift_ros.surface.queries import RayCaster, inside
from brainshift_ros.surface.surfacing import enclosed_volume

CLEAN = replace(SMALL_SCANNER, width=160, height=120, range_noise_m=0.0, dropout_fraction=0.0, color_noise=0.0, speculars=False)
CAVITY = Cavity(center_m=(4e-3, -3e-3), radius_m=10e-3, depth_m=12e-3, seed=3)
TILTED = Lighting(direction=(0.4, 0.2, 1.0))


@lru_cache
def scene():
    return make_scene(mni_cortex(), CENTER, DIAMETER_M, seed=1)


def scan_with(**keywords):
    pose = scanner_pose(scene().craniotomy, CLEAN, 5.0, 0.0, 0.0)
    return take_scan(scene(), np.eye(4), pose, seed=1, scanner=CLEAN, **keywords)


scan = lru_cache(scan_with)  # instruments are arrays and cannot be keys


def in_opening(at):
    return transform_points(scene().craniotomy.T_craniotomy_patient, at)


def over_field(x, y, z):
    """Patient coordinates of craniotomy coordinates in millimetres."""
    return transform_points(invert_rigid(scene().craniotomy.T_craniotomy_patient), np.array([x, y, z]) * 1e-3)


# Instruments ---------------------------------------------------------------------------------------------------------


def test_rays_meet_a_tube_where_an_analytic_cylinder_is():
    tip, end, radius = np.array([0.01, -0.02, 0.03]), np.array([0.05, 0.06, 0.02]), 2e-3
    caster = RayCaster(suction_tube(tip, end, radius).surface)
    rng = np.random.default_rng(0)
    axis = (end - tip) / np.linalg.norm(end - tip)
    through = tip + rng.uniform(0.1, 0.9, (500, 1)) * (end - tip) + rng.uniform(-3e-3, 3e-3, (500, 3))
    directions = rng.normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = through - 0.2 * directions
    # |o + t d - its projection on the axis| = r
    o, d = ((v - np.outer(v @ axis, axis)) for v in (origins - tip, directions))
    a, b, c = (d * d).sum(axis=1), 2.0 * (o * d).sum(axis=1), (o * o).sum(axis=1) - radius**2
    nearest = np.sqrt(c + radius**2 - b * b / (4.0 * a))  # of the ray's line to the axis
    hit = nearest < 0.95 * radius
    expected = (-b[hit] - np.sqrt(b[hit] ** 2 - 4.0 * a[hit] * c[hit])) / (2.0 * a[hit])
    along = (origins[hit] - tip + expected[:, None] * directions[hit]) @ axis
    on_wall = (along > 1e-4) & (along < np.linalg.norm(end - tip) - 1e-4)
    found = caster.cast(origins, directions).distance
    assert on_wall.sum() > 100
    np.testing.assert_allclose(found[hit][on_wall], expected[on_wall], atol=2e-5)
    missed = nearest > 1.001 * radius
    assert missed.sum() > 50
    assert np.isinf(found[missed]).all()


def test_instruments_are_closed_and_turned_outward():
    tube = suction_tube([0.0, 0.0, 0.0], [0.0, 0.0, 0.1], radius_m=2e-3).surface
    assert enclosed_volume(tube) == pytest.approx(np.pi * 2e-3**2 * 0.1, rel=2e-3)
    blade = spatula([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.3, 0.0, 1.0], width_m=12e-3, thickness_m=1e-3).surface
    assert 0.7 < enclosed_volume(blade) / (0.1 * 12e-3 * 1e-3) <= 1.0
    assert inside(blade, np.array([[0.05, 0.0, 0.0], [0.05, 5e-3, 0.0], [0.05, 0.0, 2e-3]])).tolist() == [True, True, False]


def test_a_spatula_cannot_look_along_itself():
    with pytest.raises(InputError, match="spatula"):
        spatula([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [1.0, 0.0, 0.0])


def test_an_instrument_hides_cortex_and_changes_no_other_point():
    tube = suction_tube(over_field(0, 0, 8), over_field(80, 0, 60))
    without, with_tube = scan(), scan_with(instruments=(tube,))
    metal = with_tube.label == Seen.INSTRUMENT
    assert metal.mean() > 0.01
    assert np.isnan(with_tube.current[metal]).all()
    assert np.isnan(with_tube.material[metal]).all()
    # Rays run in single precision about another centre.
    same = ~metal & (with_tube.label == without.label)
    assert same.sum() > 0.999 * (~metal).sum()
    np.testing.assert_allclose(with_tube.current[same], without.current[same], atol=2e-6)
    assert with_tube.scan.seen[metal].mean() > 0.5


# Cavity --------------------------------------------------------------------------------------------------------------


def test_cortex_inside_the_rim_is_gone_and_the_bowl_lies_below_it():
    whole, cut = scan(), scan(cavity=CAVITY)
    hole = cut.label == Seen.CAVITY
    assert hole.any()
    assert np.isnan(cut.material[hole]).all()
    assert np.isnan(cut.current[hole]).all()
    left = cut.label == Seen.CORTEX
    assert CAVITY.beyond_rim_m(in_opening(cut.material[left])[:, :2]).min() > -1.5e-3  # faces on the rim are left whole
    was_inside = CAVITY.beyond_rim_m(in_opening(whole.material)[..., :2]) < -2e-3
    assert not (cut.label[was_inside] == Seen.CORTEX).any()
    assert not (cut.label[was_inside] == Seen.NOTHING).any()
    both = was_inside & cut.scan.seen & whole.scan.seen
    deeper = in_opening(whole.scan.points[both].astype(float))[:, 2] - in_opening(cut.scan.points[both].astype(float))[:, 2]
    assert deeper.max() == pytest.approx(CAVITY.depth_m, rel=0.35)
    assert (deeper > 1e-3).mean() > 0.95


def test_a_cavity_moves_with_the_tissue():
    slide = 6e-3 * scene().craniotomy.T_craniotomy_patient[0, :3]
    centers = []
    for displacement in (None, lambda points: np.broadcast_to(slide, points.shape)):
        moved = scan(cavity=CAVITY, displacement=displacement)
        hole = (moved.label == Seen.CAVITY) & moved.scan.seen
        centers.append(moved.scan.points[hole].mean(axis=0))
    np.testing.assert_allclose(centers[1] - centers[0], slide, atol=0.7e-3)


def test_a_cavity_has_no_vessels_and_is_bloody():
    cut = scan(cavity=CAVITY).scan.rgb.astype(float)
    hole, cortex = (scan(cavity=CAVITY).label == kind for kind in (Seen.CAVITY, Seen.CORTEX))
    redness = cut[..., 0] / (cut[..., 1] + 1.0)
    assert np.median(redness[hole]) > 1.5 * np.median(redness[cortex])


# Light ---------------------------------------------------------------------------------------------------------------


def test_lighting_changes_colours_and_no_geometry():
    one, other = scan(lighting=TILTED), scan(lighting=Lighting(exposure=0.7, temperature_k=4000.0, spot_radius_m=30e-3))
    np.testing.assert_array_equal(one.scan.points, other.scan.points)
    np.testing.assert_array_equal(one.material, other.material)
    np.testing.assert_array_equal(one.label, other.label)
    assert np.abs(one.scan.rgb.astype(int) - other.scan.rgb).mean() > 10


def test_warm_light_is_redder_and_the_balanced_one_neutral():
    np.testing.assert_allclose(Lighting(temperature_k=5000.0).gain(), 1.0)
    warm, cold = Lighting(temperature_k=3500.0).gain(), Lighting(temperature_k=7000.0, exposure=2.0).gain()
    assert warm[0] > 1.0 > warm[2]
    assert cold[0] < 2.0 < cold[2]
    assert cold[1] == pytest.approx(2.0)


def test_the_side_of_a_convex_brain_that_faces_the_lamp_is_the_bright_one():
    toward, away = (
        scan(lighting=Lighting(direction=(side * 0.8, 0.0, 1.0), ambient=0.0, shadows=False)).scan.rgb.astype(float)
        for side in (1.0, -1.0)
    )
    cortex = scan().label == Seen.CORTEX
    contrast = ((toward - away) / (toward + away + 1.0)).mean(axis=-1)[cortex]
    assert np.corrcoef(contrast, in_opening(scan().current)[cortex, 0])[0, 1] > 0.5


def test_an_instrument_throws_its_shadow_away_from_the_lamp():
    tube = suction_tube(over_field(0, -20, 20), over_field(0, 90, 60), radius_m=3e-3)
    low = Lighting(direction=(1.0, 0.0, 1.0), ambient=0.2)
    with_shadow, without = (scan_with(lighting=replace(low, shadows=on), instruments=(tube,)) for on in (True, False))
    cortex = with_shadow.label == Seen.CORTEX
    darker = (without.scan.rgb.astype(float) - with_shadow.scan.rgb).mean(axis=-1)
    # Shadows of the bone's edge fall near it: look where only the tube's can fall, 20 mm from the tube and away from the lamp.
    x, y = np.moveaxis(in_opening(with_shadow.current)[..., :2], -1, 0)
    middle = cortex & (np.abs(y + 12e-3) < 4e-3) & (np.abs(x) < 26e-3)
    assert x[middle & (darker > 25)].mean() < -10e-3
    assert (darker[middle & (x > 5e-3) & (x < 18e-3)] < 25).all()


# Tracker error, determinism, shifts -------------------------------------------------------------------------------------


def test_a_tracker_error_moves_the_points_by_its_transform_and_nothing_else():
    T_error = rigid(Rotation.from_rotvec([1e-3, -2e-3, 5e-4]), [2e-4, -1e-4, 3e-4])
    noisy = replace(CLEAN, range_noise_m=0.3e-3, color_noise=0.01, speculars=True, dropout_fraction=0.05)
    pose = scanner_pose(scene().craniotomy, noisy, 5.0, 0.0, 0.0)
    T_patient_tracker = rigid(Rotation.from_rotvec([0.3, -1.0, 0.6]), [0.4, -0.2, 0.9])
    true, wrong = (take_scan(scene(), T_patient_tracker, pose, seed=4, scanner=noisy, T_error=T) for T in (None, T_error))
    np.testing.assert_array_equal(true.scan.seen, wrong.scan.seen)
    expected = transform_points(T_error, true.scan.points[true.scan.seen].astype(float))
    np.testing.assert_allclose(wrong.scan.points[true.scan.seen], expected, atol=3e-7)  # float32
    np.testing.assert_array_equal(true.current, wrong.current)
    np.testing.assert_array_equal(true.scan.rgb, wrong.scan.rgb)


def test_a_drawn_shift_reaches_its_peak_and_does_not_fold_the_tissue():
    crown = scene().cortex.vertices[np.hypot(*in_opening(scene().cortex.vertices).T[:2]) < 0.5 * DIAMETER_M]
    for seed, peak_m in enumerate((3e-3, 12e-3, 30e-3)):
        shift = draw_shift(scene().craniotomy, crown, peak_m, np.random.default_rng(seed))
        assert np.linalg.norm(shift(crown), axis=1).max() == pytest.approx(peak_m, rel=1e-6)
        step = 1e-5
        gradient = np.stack([(shift(crown + step * e) - shift(crown)) / step for e in np.eye(3)], axis=-1)
        determinant = np.linalg.det(np.eye(3) + gradient)
        assert determinant.min() > 0.4
        inward = -(shift(crown) @ scene().craniotomy.axis)
        assert inward.max() > 0.4 * peak_m
