"""Registration against the simulator's truth, and its verdict on everything it must refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.spatial.transform import Rotation
from simulation_cases import mni_target, scan_case
from skimage.measure import marching_cubes

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, rigid, transform_points, unit
from brainshift_ros.registration.icp import robust_icp, tukey_weight
from brainshift_ros.registration.opening import opening_mask, pixel_spacing
from brainshift_ros.registration.patch import OrientedPoints
from brainshift_ros.registration.register import register_scan
from brainshift_ros.registration.target import prepare_target
from brainshift_ros.registration.verdict import skew
from brainshift_ros.surface.surface import Surface


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_recovers_the_tracker_within_a_millimetre_at_surface_and_depth(seed):
    case = scan_case(seed)
    result = register_scan(case.first.scan, mni_target(), case.start(10.0, 8.0, seed))
    surface_mm, deep_mm = case.tre_mm(result.T_patient_tracker)
    assert result.accepted, result.reasons
    assert surface_mm < 1.0
    assert deep_mm < 1.0
    np.testing.assert_allclose(result.T_patient_tracker[:3, :3] @ result.T_patient_tracker[:3, :3].T, np.eye(3), atol=1e-12)


def test_all_starts_in_the_basin_end_at_the_same_pose():
    case = scan_case(2)
    poses = [register_scan(case.first.scan, mni_target(), case.start(8.0, 6.0, s)).T_patient_tracker for s in range(2)]
    spread = transform_points(poses[0] @ invert_rigid(poses[1]), case.deep_target) - case.deep_target
    assert np.linalg.norm(spread) < 0.1e-3


def test_the_same_scan_gives_the_same_pose_bit_for_bit():
    case = scan_case(2)
    start = case.start(5.0, 4.0)
    first, second = (register_scan(case.first.scan, mni_target(), start) for _ in range(2))
    np.testing.assert_array_equal(first.T_patient_tracker, second.T_patient_tracker)
    np.testing.assert_array_equal(first.cortex_mask, second.cortex_mask)


def test_icp_undoes_a_known_transform_and_its_inverse():
    target = mni_target()
    near = target.tree.query_ball_point(target.points[len(target.points) // 2], 0.03)
    points = target.points[near]
    center = points.mean(axis=0)
    turn = Rotation.from_rotvec([0.05, -0.04, 0.06])
    moved = rigid(turn, center - turn.apply(center) + [0.001, -0.002, 0.0015])
    for T in (moved, invert_rigid(moved)):
        source = transform_points(invert_rigid(T), points)
        cloud = OrientedPoints(source, target.normals[near] @ T[:3, :3])
        pose = np.eye(4)
        for distance in (0.01, 0.004, 0.002):
            pose = robust_icp(cloud, target, pose, distance, 60).T_patient_tracker
        np.testing.assert_allclose(transform_points(pose, source), points, atol=0.05e-3)


def test_cortex_mask_holds_cortex():
    case = scan_case(3)
    mask = register_scan(case.first.scan, mni_target(), case.start(5.0, 4.0)).cortex_mask
    cortex = np.isfinite(case.first.current).all(axis=-1)
    assert (mask & cortex).sum() / mask.sum() > 0.8
    assert (mask & cortex).sum() / (cortex & case.first.scan.seen).sum() > 0.8
    assert not (mask & ~opening_mask(case.first.scan)).sum() > 0.1 * mask.sum()


@pytest.mark.parametrize(
    ("degrees", "millimetres"), [(60.0, 40.0), (180.0, 0.0), (10.0, 60.0)], ids=["turned and moved", "back to front", "far off"]
)
def test_a_start_outside_the_basin_is_never_accepted_wrongly(degrees, millimetres):
    case = scan_case(1)
    result = register_scan(case.first.scan, mni_target(), case.start(degrees, millimetres, 1))
    assert (not result.accepted and result.reasons) or max(case.tre_mm(result.T_patient_tracker)) < 1.0


@pytest.mark.parametrize(("degrees", "millimetres"), [(30.0, 10.0), (45.0, 15.0), (60.0, 0.0)])
def test_a_start_30_to_60_degrees_off_still_finds_the_place(degrees, millimetres):
    case = scan_case(2)
    result = register_scan(case.first.scan, mni_target(), case.start(degrees, millimetres, 3))
    assert result.accepted, result.reasons
    assert max(case.tre_mm(result.T_patient_tracker)) < 1.0


@pytest.mark.parametrize("share", [0.02, 0.6])
def test_dropouts_in_patches_do_not_matter(share):
    case = scan_case(3)
    noise = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=case.first.scan.seen.shape), 4.0)
    points = case.first.scan.points.copy()
    points[noise > np.quantile(noise, 1.0 - share)] = np.nan
    result = register_scan(replace(case.first.scan, points=points), mni_target(), case.start(10.0, 8.0))
    assert result.accepted, result.reasons
    assert max(case.tre_mm(result.T_patient_tracker)) < 1.5


def test_the_other_hemisphere_is_refused():
    case = scan_case(1)
    result = register_scan(case.first.scan, mni_target(), np.diag([-1.0, -1.0, 1.0, 1.0]) @ case.start(0.0, 0.0))
    assert not result.accepted
    assert result.reasons


def _replaced(case, points_patient):
    points = transform_points(invert_rigid(case.T_patient_tracker), points_patient).astype(np.float32)
    return replace(case.first.scan, points=points)


@pytest.mark.parametrize(
    ("shape", "named"),
    [
        ("plane", "gyri"),
        ("sphere", "gyri"),
        ("mirrored", "cloud is mirrored"),
        ("1.1", "scaled by 0.9"),
        ("0.9", "scaled by 1.1"),
    ],
)
def test_what_is_not_this_cortex_is_refused_and_named(shape, named):
    case = scan_case(1)
    craniotomy = case.scene.craniotomy
    points = transform_points(case.T_patient_tracker, case.first.scan.points.astype(np.float64))
    noise = np.random.default_rng(0).normal(0.0, 0.3e-3, points.shape)
    offset = points - craniotomy.center
    if shape == "plane":
        wrong = points - (offset @ craniotomy.axis)[..., None] * craniotomy.axis + noise
    elif shape == "sphere":
        middle = craniotomy.center - 0.07 * craniotomy.axis
        wrong = middle + 0.07 * unit(points - middle) + noise
    elif shape == "mirrored":
        side = unit(np.cross(craniotomy.axis, [0.0, 0.0, 1.0]))
        wrong = points - 2.0 * (offset @ side)[..., None] * side
    else:
        wrong = craniotomy.center + float(shape) * offset
    result = register_scan(_replaced(case, wrong), mni_target(), case.start(2.0, 2.0))
    assert not result.accepted
    assert named in "; ".join(result.reasons)


def test_millimetres_no_colour_and_too_few_points_are_named():
    case = scan_case(1)
    scan = case.first.scan
    with pytest.raises(InputError, match="millimetres"):
        register_scan(replace(scan, points=scan.points * 1000), mni_target(), case.start(0.0, 0.0))
    with pytest.raises(InputError, match="colour"):
        register_scan(replace(scan, rgb=np.full_like(scan.rgb, 90)), mni_target(), case.start(0.0, 0.0))
    few = scan.points.copy()
    few[5:] = np.nan
    with pytest.raises(InputError, match="were seen"):
        register_scan(replace(scan, points=few), mni_target(), case.start(0.0, 0.0))


@pytest.mark.parametrize("pose", [np.diag([-1.0, 1.0, 1.0, 1.0]), 2.0 * np.eye(4), np.full((4, 4), np.nan), np.eye(3)])
def test_an_initial_pose_that_is_not_rigid_is_named(pose):
    with pytest.raises(InputError, match="initial pose"):
        register_scan(scan_case(1).first.scan, mni_target(), pose)


def test_a_cortex_in_millimetres_is_refused():
    with pytest.raises(InputError, match="metres"):
        prepare_target(Surface(np.random.default_rng(0).normal(0, 70.0, (500, 3)), np.zeros((500, 3), np.int32)))


def test_the_target_leaves_out_what_lies_inside_the_head():
    grid = np.indices((44, 44, 44)) - 21.5
    radius = np.sqrt((grid**2).sum(axis=0))
    shell = np.clip(20.0 - radius, -1, 1) * np.clip(radius - 10.0, -1, 1)
    vertices, faces, _, _ = marching_cubes(shell, 0.0)
    surface = Surface((vertices - 21.5) * 3e-3, faces.astype(np.int32)[:, ::-1])
    corners = surface.vertices[surface.faces]
    if np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() < 0:
        surface = Surface(surface.vertices, surface.faces[:, ::-1])
    distance = np.linalg.norm(prepare_target(surface).points, axis=1)
    assert distance.min() > 0.055
    assert len(distance) > 5000


def test_predicted_error_grows_with_depth_and_follows_the_covariance():
    case = scan_case(1)
    result = register_scan(case.first.scan, mni_target(), case.start(5.0, 4.0))
    below = [result.predicted_tre_m(result.pivot - depth * case.scene.craniotomy.axis) for depth in (0.0, 0.05, 0.10)]
    assert 0.0 < below[0] < below[2] < 2e-3
    # Against a sample of the covariance itself.
    rng = np.random.default_rng(0)
    twists = rng.multivariate_normal(np.zeros(6), result.covariance, 4000)
    lever = -0.1 * case.scene.craniotomy.axis
    errors = np.cross(twists[:, :3], lever) + twists[:, 3:]
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) == pytest.approx(below[2], rel=0.05)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-10, 10), min_size=6, max_size=6))
def test_skew_is_the_cross_product(values):
    a, b = np.array(values[:3]), np.array(values[3:])
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-12)


def test_tukey_weight_at_its_landmarks():
    np.testing.assert_allclose(tukey_weight(np.array([0.0, 0.5, 1.0, 3.0]), 1.0), [1.0, 0.5625, 0.0, 0.0])


def test_pixel_spacing_is_not_fooled_by_range_noise():
    u, v = np.meshgrid(np.arange(80), np.arange(60))
    points = np.stack([0.2e-3 * u, 0.2e-3 * v, np.zeros(u.shape)], axis=-1)
    points[..., 2] += np.random.default_rng(0).normal(0, 0.3e-3, u.shape)
    scan = replace(scan_case(1).first.scan, points=points.astype(np.float32), rgb=np.zeros((60, 80, 3), np.uint8))
    assert pixel_spacing(scan) == pytest.approx(0.2e-3, rel=0.03)
