"""The scan simulator against its own geometry: truth, noise, texture that moves with the tissue, defects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from simulation_cases import CENTER, DIAMETER_M, SMALL_SCANNER, mni_cortex, scan_case

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import transform_points
from brainshift_ros.simulation.scanner import scanner_pose, take_scan
from brainshift_ros.simulation.scene import make_scene

CLEAN = replace(SMALL_SCANNER, range_noise_m=0.0, dropout_fraction=0.0, color_noise=0.0, speculars=False)


def test_points_are_the_truth_plus_noise_along_the_ray():
    case = scan_case(1)
    on_cortex = np.isfinite(case.first.current).all(axis=-1) & case.first.scan.seen
    in_patient = transform_points(case.T_patient_tracker, case.first.scan.points[on_cortex].astype(np.float64))
    error = in_patient - case.first.current[on_cortex]
    length = np.linalg.norm(error, axis=1)
    # The error of a range is one-dimensional: its length is half-normal with the scanner's sigma.
    assert np.sqrt(np.mean(length**2)) == pytest.approx(SMALL_SCANNER.range_noise_m, rel=0.03)
    assert np.std(error @ case.scene.craniotomy.axis) > 0.9 * SMALL_SCANNER.range_noise_m


def test_current_is_material_plus_shift_for_a_linear_shift():
    case = scan_case(1)
    center = case.scene.craniotomy.center
    gradient = np.array([[0.02, 0.05, 0.0], [-0.05, 0.01, 0.03], [0.0, 0.02, -0.04]])

    def linear(points):
        return (points - center) @ gradient.T + [0.003, -0.002, 0.001]

    pose = scanner_pose(case.scene.craniotomy, CLEAN, 5.0, 0.0, 0.0)
    scan = take_scan(case.scene, np.eye(4), pose, seed=0, displacement=linear, scanner=CLEAN)
    seen = np.isfinite(scan.material).all(axis=-1)
    np.testing.assert_allclose(scan.current[seen], scan.material[seen] + linear(scan.material[seen]), atol=2e-7)


def test_vessels_move_with_the_tissue():
    case = scan_case(1)
    pose = scanner_pose(case.scene.craniotomy, CLEAN, 0.0, 0.0, 0.0)
    still = take_scan(case.scene, np.eye(4), pose, seed=5, scanner=CLEAN)
    shift = 0.004 * np.cross(case.scene.craniotomy.axis, [0.0, 0.0, 1.0])
    moved = take_scan(
        case.scene, np.eye(4), pose, seed=5, scanner=CLEAN, displacement=lambda p: np.broadcast_to(shift, p.shape)
    )
    a, b = (np.isfinite(s.material).all(axis=-1) for s in (still, moved))
    distance, index = cKDTree(still.material[a]).query(moved.material[b])
    same = distance < 0.3e-3  # the grids are 0.36 mm wide and lie askew
    colors_there = still.scan.rgb[a][index[same], 1].astype(float)
    colors_here = moved.scan.rgb[b][same, 1].astype(float)
    assert np.corrcoef(colors_there, colors_here)[0, 1] > 0.93
    both = a & b
    in_place = np.corrcoef(still.scan.rgb[both][:, 1].astype(float), moved.scan.rgb[both][:, 1].astype(float))[0, 1]
    assert in_place < 0.9


def test_what_surrounds_the_opening_lies_above_the_cortex_and_is_not_cortex():
    case = scan_case(1)
    surround = case.first.scan.seen & ~np.isfinite(case.first.current).all(axis=-1)
    local = transform_points(
        case.scene.craniotomy.T_craniotomy_patient @ case.T_patient_tracker, case.first.scan.points[surround].astype(np.float64)
    )
    assert surround.mean() > 0.2
    assert np.quantile(np.hypot(local[:, 0], local[:, 1]), 0.02) > 0.9 * case.scene.craniotomy.radius_m


def test_same_seed_same_scan_other_seed_other_scan():
    case = scan_case(1)
    pose = scanner_pose(case.scene.craniotomy, SMALL_SCANNER, 5.0, 0.0, 0.0)
    one, two, other = (take_scan(case.scene, np.eye(4), pose, seed=s, scanner=SMALL_SCANNER).scan for s in (3, 3, 4))
    np.testing.assert_array_equal(one.points, two.points)
    np.testing.assert_array_equal(one.rgb, two.rgb)
    assert not np.array_equal(one.points, other.points, equal_nan=True)


def test_dropouts_and_glints_take_points_away():
    case = scan_case(1)
    pose = scanner_pose(case.scene.craniotomy, SMALL_SCANNER, 5.0, 0.0, 0.0)
    seen = {
        fraction: take_scan(
            case.scene, np.eye(4), pose, seed=3, scanner=replace(SMALL_SCANNER, dropout_fraction=fraction)
        ).scan.seen.mean()
        for fraction in (0.0, 0.3)
    }
    assert seen[0.0] - seen[0.3] == pytest.approx(0.3, abs=0.05)
    wet = take_scan(case.scene, np.eye(4), pose, seed=3, scanner=SMALL_SCANNER)
    glint = wet.specular > 0.9
    assert glint.any()
    assert wet.scan.seen[glint].mean() < 0.5


def test_a_displacement_per_vertex_equals_its_function():
    case = scan_case(1)
    pose = scanner_pose(case.scene.craniotomy, CLEAN, 5.0, 0.0, 0.0)
    by_function = take_scan(case.scene, np.eye(4), pose, seed=0, displacement=case.shift, scanner=CLEAN)
    by_vertex = take_scan(case.scene, np.eye(4), pose, seed=0, displacement=case.shift(mni_cortex().vertices), scanner=CLEAN)
    np.testing.assert_array_equal(by_function.scan.points, by_vertex.scan.points)


@pytest.mark.parametrize(
    ("center", "diameter", "named"),
    [(CENTER * 1000, DIAMETER_M, "craniotomy centre"), (CENTER, 70.0, "craniotomy diameter")],
)
def test_millimetres_are_refused(center, diameter, named):
    with pytest.raises(InputError, match=named):
        make_scene(mni_cortex(), center, diameter, seed=0)


def test_a_displacement_that_is_not_finite_is_refused():
    case = scan_case(1)
    pose = scanner_pose(case.scene.craniotomy, CLEAN, 5.0, 0.0, 0.0)
    with pytest.raises(InputError, match="displacement"):
        take_scan(case.scene, np.eye(4), pose, seed=0, displacement=lambda p: np.full(p.shape, np.nan), scanner=CLEAN)
