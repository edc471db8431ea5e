"""Vessels marked by a person: minimal paths in two scans, matched along the vessel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from simulation_cases import scan_case
from vessel_cases import PIXEL_M, flat_scan

from brainshift_ros.correspondence.guided_vessels import VesselEnds, vessel_pairs
from brainshift_ros.errors import InputError
from brainshift_ros.geometry import transform_points
from brainshift_ros.units import m_to_mm

BEND = [(x, 110 + 25 * np.sin(x / 25) + 0.1 * x) for x in range(30, 291, 2)]
TWIGS = [[BEND[k], (BEND[k][0] + 12, BEND[k][1] + side * 30)] for k, side in ((25, 1), (48, -1), (80, 1), (105, -1))]
MOVED = np.array([14.0, -9.0])  # (column, row)


def moved(line):
    return [tuple(np.asarray(at) + MOVED) for at in line]


def px(column_row):
    return np.asarray(column_row, dtype=float)[..., ::-1]


@pytest.fixture(scope="module")
def scans():
    lines = [BEND, *TWIGS]
    return flat_scan(lines, 5), flat_scan([moved(line) for line in lines], 5)


def ends(a, b, offset=(0.0, 0.0)):
    return VesselEnds(px([a, b]), px([a, b]) + px(MOVED) + np.asarray(offset))


def error_px(guides):
    return np.linalg.norm(guides.later_px - guides.first_px - px(MOVED), axis=1)


def test_pairs_are_the_same_spots_of_the_vessel(scans):
    guides = vessel_pairs(*scans, [ends(BEND[5], BEND[-6])])
    assert len(guides.first_px) >= 15
    assert error_px(guides).max() < 2.0
    assert cKDTree(px(BEND)).query(guides.first_px)[0].max() < 3.0
    gaps = np.linalg.norm(np.diff(guides.first_px, axis=0), axis=1) * PIXEL_M
    assert np.median(gaps) == pytest.approx(3e-3, rel=0.3)


def test_ends_beside_the_vessel_and_along_it_are_made_good(scans):
    """Four pixels across at one end of the first scan; six along at both ends of the later one."""
    along = np.array([6.0, 0.0])
    first = px([BEND[10], BEND[-12]]) + np.array([[4.0, 0.0], [-3.0, 0.0]])
    later = px([np.asarray(BEND[10]) + MOVED + along, np.asarray(BEND[-12]) + MOVED + along])
    guides = vessel_pairs(*scans, [VesselEnds(first, later)])
    assert np.median(error_px(guides)) < 1.5
    assert error_px(guides).max() < 3.0


def test_a_glint_over_the_vessel_is_bridged(scans):
    later = flat_scan([moved(line) for line in [BEND, *TWIGS]], 5, glints=[(*np.round(moved(BEND)[60]).astype(int), 8)])
    guides = vessel_pairs(scans[0], later, [ends(BEND[5], BEND[-6])])
    assert np.quantile(error_px(guides), 0.9) < 2.5


def test_lost_range_along_the_vessel_is_filled(scans):
    points = scans[1].points.copy()
    points[:, 130:170] = np.nan
    guides = vessel_pairs(scans[0], replace(scans[1], points=points), [ends(BEND[5], BEND[-6])])
    assert error_px(guides).max() < 2.5


def test_several_vessels_join_into_one_set(scans):
    one, other = ends(BEND[5], BEND[60]), ends(TWIGS[2][0], TWIGS[2][1])
    both = vessel_pairs(*scans, [one, other])
    assert len(both.first_px) == sum(len(vessel_pairs(*scans, [each]).first_px) for each in (one, other))
    assert len(vessel_pairs(*scans, [other]).first_px) >= 3


@pytest.mark.parametrize(
    ("first", "later", "told"),
    [
        ([[300.0, 50.0], [100.0, 200.0]], None, "vessel 2, first scan, start.*row 300.*outside the picture of 240 x 320"),
        (None, [[100.0, 60.0], [100.0, 320.0]], "vessel 2, later scan, end.*column 320"),
        ([[np.nan, 50.0], [100.0, 200.0]], None, "vessel 2, first scan.*not finite"),
        ([[100.0, 50.0]], None, "vessel 2, first scan.*shape"),
        (px([BEND[15], BEND[20]]), None, "vessel 2, first scan.*apart"),
        ([[10.0, 10.0], [10.0, 100.0]], None, "vessel 2, first scan.*no vessel"),
    ],
)
def test_bad_ends_are_refused_by_name(scans, first, later, told):
    good = ends(BEND[5], BEND[60])
    bad = VesselEnds(good.first_px if first is None else np.array(first), good.later_px if later is None else np.array(later))
    with pytest.raises(InputError, match=told):
        vessel_pairs(*scans, [good, bad])


def test_without_vessels_or_range_there_is_a_reason(scans):
    with pytest.raises(InputError, match="mark at least one"):
        vessel_pairs(*scans, [])
    points = scans[1].points.copy()
    points[:, 100:] = np.nan
    with pytest.raises(InputError, match=r"vessel 1, later scan: the scan saw \d+ of"):
        vessel_pairs(scans[0], replace(scans[1], points=points), [ends(BEND[45], BEND[-6])])


def test_pairs_on_a_simulated_cortex_are_the_same_tissue():
    case = scan_case(2, 8.0)
    T = case.scene.craniotomy.T_craniotomy_patient
    rng = np.random.default_rng(0)
    places = []
    for scanned in (case.first, case.later):
        shown = np.argwhere(np.isfinite(scanned.material).all(axis=-1))
        places.append((shown, cKDTree(transform_points(T, scanned.material[tuple(shown.T)])[:, :2])))
    errors = []
    for vessel in case.scene.vessels:
        inside = np.hypot(*vessel.path.T) < case.scene.craniotomy.radius_m - 5e-3
        for _, tree in places:
            inside &= tree.query(vessel.path)[0] < 0.5e-3
        visible = np.flatnonzero(inside)
        if vessel.width.max() < 0.9e-3 or len(visible) < 40 or np.any(np.diff(visible) > 1):
            continue
        stretch = vessel.path[[visible[2], visible[min(60, len(visible) - 3)]]]
        marked = [shown[tree.query(stretch)[1]] + rng.uniform(-2.0, 2.0, (2, 2)) for shown, tree in places]
        guides = vessel_pairs(case.first.scan, case.later.scan, [VesselEnds(*marked)])
        tissue = [
            scanned.material[tuple(np.round(pixels).astype(int).T)]
            for scanned, pixels in ((case.first, guides.first_px), (case.later, guides.later_px))
        ]
        errors.append(m_to_mm(np.linalg.norm(tissue[0] - tissue[1], axis=1)))
    assert len(errors) >= 4
    assert np.nanmedian(np.concatenate(errors)) < 0.6
    assert np.mean([np.nanmax(error) < 2.5 for error in errors]) > 0.7
