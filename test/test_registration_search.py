"""Registration without a pose, what it starts from, and handedness: cloud, picture and scanner side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from simulation_cases import mni_target, scan_case

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import tangent_frame, transform_points, unit
from brainshift_ros.registration.handedness import bulge
from brainshift_ros.registration.lattice import lattice_around
from brainshift_ros.registration.nearest_grid import make_nearest_grid
from brainshift_ros.registration.patch import OrientedPoints, scan_patch
from brainshift_ros.registration.register import register_scan
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.registration.search import SearchArea, poses_over
from brainshift_ros.registration.target import CortexTarget


def area(case, radius_m=0.03):
    """Where the craniotomy was planned, a centimetre off."""
    return SearchArea(case.scene.craniotomy.center + np.array([0.006, -0.006, 0.004]), radius_m)


def part_of_target(center, radius_m, *copies):
    """Only the cortex around a place, laid there and once more at each offset."""
    whole = mni_target()
    inside = np.linalg.norm(whole.points - center, axis=1) < radius_m
    points = np.concatenate([whole.points[inside] + offset for offset in ([0.0, 0.0, 0.0], *copies)])
    normals = np.tile(whole.normals[inside], (1 + len(copies), 1))
    return CortexTarget(points, normals, cKDTree(points), make_nearest_grid(points))


def test_a_search_over_the_planned_area_finds_the_place():
    case = scan_case(1)
    result = register_scan(case.first.scan, mni_target(), None, near=area(case, 0.02))
    assert result.accepted, result.reasons
    assert result.start == "search"
    assert max(case.tre_mm(result.T_patient_tracker)) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_search_over_the_whole_cortex_finds_the_place(seed):
    case = scan_case(seed)
    result = register_scan(case.first.scan, mni_target(), None)
    assert result.accepted, result.reasons
    assert max(case.tre_mm(result.T_patient_tracker)) < 1.0


def test_where_nothing_fits_the_search_says_so():
    case = scan_case(1)
    elsewhere = SearchArea(case.scene.craniotomy.center * [-1, 1, 1], 0.015)
    result = register_scan(case.first.scan, mni_target(), None, near=elsewhere)
    assert not result.accepted
    assert result.reasons


def test_where_two_places_fit_the_search_says_so():
    case = scan_case(1)
    twice = part_of_target(case.scene.craniotomy.center, 0.045, [0.15, 0.0, 0.0])
    result = register_scan(case.first.scan, twice, None)
    assert not result.accepted
    assert result.reasons == ("it fits nearly as well elsewhere (1 other places)",)


def test_an_area_beside_the_cortex_is_named():
    with pytest.raises(InputError, match="no exposed cortex"):
        register_scan(scan_case(1).first.scan, mni_target(), None, near=SearchArea(np.array([2.0, 0.0, 0.0]), 0.03))


@pytest.mark.parametrize("fault", ["cloud", "picture"])
def test_a_mirrored_cloud_or_picture_is_named(fault):
    case = scan_case(2)
    scan = case.first.scan
    if fault == "cloud":
        wrong = replace(scan, points=scan.points * np.float32([1, -1, 1]))
    else:
        wrong = replace(scan, points=scan.points[::-1].copy(), rgb=scan.rgb[::-1].copy())
    result = register_scan(wrong, mni_target(), None, near=area(case, 0.015))
    assert not result.accepted
    assert f"the {fault} is mirrored" in result.reasons[0]


def sphere_patch(radius_m, facing):
    rng = np.random.default_rng(0)
    directions = unit(rng.normal(size=(4000, 3)) * 0.2 + [0.0, 0.0, 1.0])
    return OrientedPoints(radius_m * directions, facing * directions)


@pytest.mark.parametrize("facing", [1.0, -1.0])
def test_bulge_is_the_mean_curvature_towards_the_facing_side(facing):
    assert bulge(sphere_patch(0.07, facing)) == pytest.approx(facing / 0.07, rel=0.1)


def test_normals_of_a_scan_face_the_scanner_and_blocks_are_means():
    """A tilted plane in front of a scanner at the origin that looks along z, x right and y down (REP 118)."""
    v, u = np.indices((60, 80))
    x, y = (u - 40) * 5e-4, (v - 30) * 5e-4
    points = np.stack([x, y, 0.3 + 0.3 * x], axis=-1).astype(np.float32)
    points[10:12, 10:12] = np.nan
    scan = OrganisedScan(points, np.zeros((60, 80, 3), np.uint8), "tracker", 0)
    patch = scan_patch(scan, np.ones((60, 80), dtype=bool), 2e-3)
    assert patch.block == 4
    cloud = patch.cloud()
    np.testing.assert_allclose(cloud.normals, np.broadcast_to(unit([0.3, 0.0, -1.0]), cloud.normals.shape), atol=0.01)
    np.testing.assert_allclose(patch.points[5, 5], points[20:24, 20:24].reshape(-1, 3).mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(patch.points[2, 2], np.nanmean(points[8:12, 8:12].reshape(-1, 3), axis=0), atol=1e-6)


def test_the_table_of_nearest_points_agrees_with_the_tree():
    target = mni_target()
    rng = np.random.default_rng(0)
    asked = target.points[rng.integers(len(target.points), size=3000)] + rng.normal(0.0, 4e-3, (3000, 3))
    distance, _ = target.tree.query(asked)
    index = target.grid.lookup(asked)
    found = index >= 0
    assert found[distance < 10e-3].all()
    excess = np.linalg.norm(asked - target.points[index], axis=1)[found] - distance[found]
    assert excess.max() < 2 * np.sqrt(3) * 1.5e-3, "a voxel's diagonal at each end"
    assert np.median(excess) < 0.3e-3
    assert (target.grid.lookup(np.full((2, 3), 5.0)) == -1).all()


def test_lattice_moves_along_the_surface_and_turns_about_its_normal():
    cloud = sphere_patch(0.07, 1.0)
    starts = lattice_around(np.eye(4), cloud, spacing_m=5e-3, radius_m=10e-3, turns_deg=(-12.0, 0.0, 12.0))
    assert len(starts) == 19 * 3
    np.testing.assert_allclose(starts[0], np.eye(4), atol=1e-12)
    moved = np.array([transform_points(start, cloud.points.mean(axis=0)) for start in starts]) - cloud.points.mean(axis=0)
    normal = unit(cloud.normals.mean(axis=0))
    assert np.abs(moved @ normal).max() < 1e-12
    assert np.linalg.norm(moved, axis=1).max() == pytest.approx(10e-3)
    assert np.abs(starts[:, :3, :3] @ normal - normal).max() < 1e-12


def test_search_lays_the_scan_outward_on_the_cortex_at_every_turn():
    target, cloud = mni_target(), sphere_patch(0.07, 1.0)
    center = scan_case(1).scene.craniotomy.center
    starts = poses_over(target, cloud, SearchArea(center, 0.02), spacing_m=13e-3, turn_deg=90.0)
    middles = np.array([transform_points(start, cloud.points.mean(axis=0)) for start in starts])
    assert np.linalg.norm(middles - center, axis=1).max() <= 0.02
    facing = starts[:, :3, :3] @ unit(cloud.normals.mean(axis=0))
    assert (facing @ scan_case(1).scene.craniotomy.axis > 0.5).all()
    first = tangent_frame(cloud.normals.mean(axis=0))[0]
    turns = (starts[:, :3, :3] @ first).reshape(-1, 4, 3)
    np.testing.assert_allclose(np.einsum("pik,pik->pi", turns, np.roll(turns, 1, axis=1)), 0.0, atol=1e-9)
