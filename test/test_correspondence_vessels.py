"""Vessel tracing on painted vessels whose centre lines are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from simulation_cases import scan_case
from vessel_cases import CORTEX, FORK, PIXEL_M, WAVE, flat_scan, sample

from brainshift_ros.geometry import transform_points
from brainshift_ros.vessels.minimal_path import trace_between
from brainshift_ros.vessels.speculars import repair_speculars, specular_mask
from brainshift_ros.vessels.tracing import trace_vessels, vessels_of_points
from brainshift_ros.vessels.vesselness import blood_contrast, vesselness


@pytest.mark.parametrize("width_px", [3, 5, 9])
def test_centre_lines_lie_on_the_vessels(width_px):
    truth = [WAVE, *FORK]
    tree = trace_vessels(flat_scan(truth, width_px))
    traced = np.concatenate([path.pixels[:, ::-1] for path in tree.paths])
    known = np.concatenate([sample(line) for line in truth])
    to_truth = cKDTree(known).query(traced)[0]
    to_trace = cKDTree(traced).query(known)[0]
    assert np.mean(to_truth < 1.5) > 0.97  # nothing traced that is not there
    assert np.mean(to_trace < 2.5) > 0.95  # nothing left out
    assert np.median(to_truth) < 0.8


def test_the_branch_point_and_the_ends_are_found():
    tree = trace_vessels(flat_scan(FORK, 5))
    assert np.linalg.norm(tree.branch_points - [150, 160], axis=1).min() < 5.0
    for column, row in ((40, 170), (290, 110), (210, 220)):
        assert np.linalg.norm(tree.ends - [row, column], axis=1).min() < 6.0


def test_widths_are_the_painted_ones():
    medians = [np.median(np.concatenate([p.width_m for p in trace_vessels(flat_scan([WAVE], w)).paths])) for w in (3, 9)]
    assert medians == [pytest.approx(3 * PIXEL_M, abs=0.6 * PIXEL_M), pytest.approx(9 * PIXEL_M, abs=PIXEL_M)]


def test_a_thin_vessel_beside_a_wide_one_keeps_its_width():
    wide = [(column, row + 16) for column, row in WAVE]
    narrow = trace_vessels(flat_scan([WAVE], 3))
    both = flat_scan([WAVE], 3).rgb.astype(float) * (flat_scan([wide], 9).rgb / CORTEX)
    tree = trace_vessels(replace(flat_scan([], 3), rgb=np.clip(both, 0, 255).astype(np.uint8)))
    pixels = np.concatenate([path.pixels for path in tree.paths])
    width = np.concatenate([path.width_m for path in tree.paths])
    on_narrow = cKDTree(sample(WAVE)).query(pixels[:, ::-1])[0] < 2.0
    alone = np.median(np.concatenate([path.width_m for path in narrow.paths]))
    assert np.median(width[on_narrow]) == pytest.approx(alone, abs=0.6 * PIXEL_M)
    assert np.median(width[~on_narrow]) > 2.0 * alone


def test_a_shadow_is_no_vessel():
    shade = np.ones((240, 320))
    shade[:, 150:156] = 0.45  # as dark as a sulcus, as narrow as a vessel
    shade[120:, :] *= 0.7
    tree = trace_vessels(flat_scan([], 3, shade=shade))
    assert tree.length_m < 2e-3
    # The same darkness in the colour of blood is one.
    assert trace_vessels(flat_scan([[(152, 10), (152, 230)]], 5)).length_m > 35e-3


def test_light_does_not_change_the_contrast_of_blood():
    rgb = flat_scan([WAVE], 5).rgb.astype(float)
    weight = np.ones(rgb.shape[:2], np.float32)
    bright = vesselness(blood_contrast(rgb, weight, 20.0), PIXEL_M)
    dim = vesselness(blood_contrast(0.6 * rgb, weight, 20.0), PIXEL_M)
    on = bright > 0.2
    assert on.sum() > 500
    assert np.median(dim[on] / bright[on]) == pytest.approx(1.0, abs=0.25)


def test_glints_are_found_repaired_and_bridged():
    glints = [(150, 66, 5), (220, 72, 6)]
    scan = flat_scan([WAVE], 5, glints=glints)
    mask = specular_mask(scan.rgb)
    assert all(mask[row, column] for column, row, _ in glints)
    assert mask.mean() < 0.01
    repaired, _ = repair_speculars(scan.rgb)
    assert repaired[mask].min(axis=-1).max() < 150
    np.testing.assert_array_equal(repaired[~mask], scan.rgb[~mask])
    clean, glinting = trace_vessels(flat_scan([WAVE], 5)), trace_vessels(scan)
    assert glinting.length_m > 0.9 * clean.length_m


def test_a_given_pair_of_ends_is_joined_along_the_vessel():
    scan = flat_scan([WAVE], 5)
    weight = np.ones(scan.rgb.shape[:2], np.float32)
    strength = vesselness(blood_contrast(scan.rgb, weight, 20.0), PIXEL_M)
    start, end = ((round(WAVE[k][1]), round(WAVE[k][0])) for k in (2, -3))
    path = trace_between(strength, start, end)
    assert tuple(path[0]) == start
    assert tuple(path[-1]) == end
    distance = cKDTree(sample(WAVE)).query(path[:, ::-1])[0]
    assert distance.max() < 2.5
    chord = np.linspace(start, end, 200)
    assert cKDTree(sample(WAVE)).query(chord[:, ::-1])[0].max() > 8.0  # the straight line would have left it


def test_vessels_of_a_simulated_cortex_are_the_painted_ones():
    case = scan_case(2, 8.0)
    region = np.isfinite(case.first.current).all(axis=-1)
    tree = trace_vessels(case.first.scan, region)
    traced = np.concatenate([path.pixels for path in tree.paths if not path.bridged]).astype(int)
    material = case.first.material[traced[:, 0], traced[:, 1]]
    at = transform_points(case.scene.craniotomy.T_craniotomy_patient, material[np.isfinite(material).all(axis=1)])[:, :2]
    painted = np.concatenate([vessel.path for vessel in case.scene.vessels])
    distance = cKDTree(painted).query(at)[0]
    assert np.mean(distance < 0.8e-3) > 0.9
    assert tree.length_m > 0.25
    assert len(tree.branch_points) > 10


def test_no_vessels_no_paths():
    tree = trace_vessels(flat_scan([], 3))
    assert tree.paths == ()
    assert tree.branch_points.shape == (0, 2)
    assert tree.length_m == 0.0


def test_points_belong_to_the_vessel_they_lie_on():
    scan = flat_scan([[(20, 40), (300, 40)], [(20, 160), (300, 160)]], 5)
    tree = trace_vessels(scan)
    on_first, on_second, nowhere = np.array([[100, 41, 0.3], [200, 158, 0.3], [150, 100, 0.3]]) * [PIXEL_M, PIXEL_M, 1.0]
    ids = vessels_of_points(tree, scan, np.stack([on_first, on_first + np.array([20e-3, 0, 0]), on_second, nowhere]))
    assert ids[0] == ids[1] != ids[2]
    assert ids[3] == -1
    assert vessels_of_points(trace_vessels(flat_scan([], 3)), scan, on_first[None]).tolist() == [-1]
