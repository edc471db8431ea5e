"""A case at the scanner: order of pose and scans, refusals that do not block, nothing left after reset."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from simulation_cases import mni_target, scan_case

from brainshift_ros.correspondence.guides_file import GuideMarks
from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, transform_points
from brainshift_ros.graph import PATIENT_FRAME
from brainshift_ros.pictures.scan import pixels_of, scan_page
from brainshift_ros.session.session import LrsSession
from brainshift_ros.units import m_to_mm, mm_to_m


@pytest.fixture
def session():
    return LrsSession(mni_target())


def test_first_scan_registers_and_later_scan_gives_points_in_the_patient(session, tmp_path):
    case = scan_case(2)
    assert session.set_initial_pose(case.start(8.0, 6.0)) is None
    first = session.add_scan(case.first.scan)
    assert first.registration is not None
    assert first.registration.accepted
    assert first.homologous is None
    assert first.registered is not None
    assert first.registered.frame_id == PATIENT_FRAME
    later = session.add_scan(case.later.scan)
    assert later.registration is first.registration
    points = later.homologous
    assert points is not None
    assert len(points.points) >= 20
    true_points = transform_points(case.T_patient_tracker @ invert_rigid(first.registration.T_patient_tracker), points.points)
    assert m_to_mm(np.linalg.norm(true_points - points.points, axis=1)).max() < 1.0
    error_mm = m_to_mm(np.linalg.norm(points.displacements - case.shift(true_points), axis=1))
    assert np.median(error_mm) < 0.8
    assert np.quantile(error_mm, 0.95) < 2.0
    assert (points.sigma > 0).all()
    for update in (first, later):
        assert all(np.isfinite(v) for v in update.diagnostics.values() if not isinstance(v, str))
        assert all(seconds >= 0 for seconds in update.times_s.values())
    scan_page(tmp_path / "scan.png", first.registered, session.vessels(), later.registered, points)
    assert (tmp_path / "scan.png").stat().st_size > 50_000


def test_a_scan_before_its_pose_waits_for_it(session):
    case = scan_case(2)
    waiting = session.add_scan(case.first.scan)
    assert waiting.registration is None
    assert waiting.warnings
    update = session.set_initial_pose(case.start(5.0, 4.0))
    assert update is not None
    assert update.registration is not None
    assert update.registration.accepted
    assert session.add_scan(case.later.scan).homologous is not None


def test_a_refused_registration_gives_way_to_a_better_pose_or_scan(session):
    case = scan_case(2)
    wrong = np.diag([-1.0, -1.0, 1.0, 1.0]) @ case.T_patient_tracker
    session.set_initial_pose(wrong)
    refused = session.add_scan(case.first.scan)
    assert refused.registration is not None
    assert not refused.registration.accepted
    assert refused.registered is None
    assert any("refused" in warning for warning in refused.warnings)
    far_off = session.set_initial_pose(case.start(0.0, 90.0))
    assert far_off is not None
    for update in (refused, far_off):
        assert update.diagnostics["registration_reasons"]
        assert all(np.isfinite(value) for value in update.diagnostics.values() if not isinstance(value, str))
    better = session.set_initial_pose(case.start(5.0, 4.0))
    assert better is not None
    assert better.registration is not None
    assert better.registration.accepted


def test_an_unusable_scan_leaves_the_case_as_it_was(session):
    case = scan_case(2)
    session.set_initial_pose(case.start(5.0, 4.0))
    session.add_scan(case.first.scan)
    expected = session.add_scan(case.later.scan).homologous
    for spoilt in (
        replace(case.later.scan, points=np.full_like(case.later.scan.points, np.nan)),
        replace(case.later.scan, points=case.later.scan.points * 1000),
        replace(case.later.scan, rgb=np.zeros_like(case.later.scan.rgb)),
    ):
        with pytest.raises(InputError):
            session.add_scan(spoilt)
    with pytest.raises(InputError):
        session.set_initial_pose(np.zeros((4, 4)))
    after = session.add_scan(case.later.scan).homologous
    assert expected is not None
    assert after is not None
    np.testing.assert_array_equal(after.displacements, expected.displacements)


@pytest.fixture(scope="module")
def done():
    """A case that has its points; tests of this fixture leave registration and first scan as they are."""
    case, session = scan_case(2), LrsSession(mni_target())
    session.set_initial_pose(case.start(5.0, 4.0))
    first = session.add_scan(case.first.scan)
    return case, session, first, session.add_scan(case.later.scan)


def test_placing_comes_before_comparing_and_together_they_are_the_whole(done):
    case, session, _, whole = done
    placed = session.place(case.later.scan)
    assert placed.homologous is None
    np.testing.assert_array_equal(placed.registered.points, whole.registered.points)
    compared = session.compare()
    assert compared.registered is None
    np.testing.assert_array_equal(compared.homologous.displacements, whole.homologous.displacements)
    assert session.compare() is None, "there is nothing left to compare"


def test_a_pose_that_comes_after_the_registration_is_checked_and_changes_nothing(done):
    case, session, first, _ = done
    agreeing = session.set_initial_pose(case.T_patient_tracker)
    assert agreeing.warnings == ()
    assert agreeing.diagnostics["pose_disagreement_mm"] < 2.0
    away = case.start(0.0, 14.0)
    other = session.set_initial_pose(away)
    assert other.diagnostics["pose_disagreement_mm"] == pytest.approx(14.0, abs=2.0)
    assert "the registration is kept" in other.warnings[0]
    assert session.place(case.later.scan).registration is first.registration
    session.compare()


def test_guides_take_the_place_of_the_automatic_match(done):
    case, session, _, automatic = done
    pairs = true_pairs(case, 6)
    guided = session.set_guides(GuideMarks(*pairs))
    points = guided.homologous
    assert len(points.points) >= 20
    near, same = cKDTree(automatic.homologous.points).query(points.points)
    shared = near < 0.5e-3
    assert shared.sum() >= 15
    apart = points.displacements[shared] - automatic.homologous.displacements[same[shared]]
    assert np.median(np.linalg.norm(apart, axis=1)) < 0.2e-3
    with pytest.raises(InputError, match="lies outside the first scan"):
        session.set_guides(GuideMarks(pairs[0] + 1000.0, pairs[1]))


def true_pairs(case, count):
    """Pixels (row, column) of both scans that show the same material, from the simulator, spread over the opening."""
    later = np.argwhere(np.isfinite(case.later.material).all(axis=-1))
    tree = cKDTree(case.later.material[tuple(later.T)])
    first = np.argwhere(np.isfinite(case.first.material).all(axis=-1))
    distance, index = tree.query(case.first.material[tuple(first.T)])
    good = np.flatnonzero(distance < 0.2e-3)
    chosen = good[np.linspace(0, len(good) - 1, count + 2).astype(int)[1:-1]]
    return first[chosen].astype(float), later[index[chosen]].astype(float)


def test_a_dense_field_covers_the_craniotomy(done):
    case, session, first, _ = done
    field = session.dense(mm_to_m(3.0))
    assert len(field.points) > 200
    true_points = transform_points(case.T_patient_tracker @ invert_rigid(first.registration.T_patient_tracker), field.points)
    error_mm = m_to_mm(np.linalg.norm(field.displacements - case.shift(true_points), axis=1))
    assert np.median(error_mm) < 0.8
    assert (field.sigma > 0.0).all()
    with pytest.raises(InputError, match="a spacing of 0 mm"):
        session.dense(0.0)


def test_guides_and_dense_field_need_a_later_scan(session):
    with pytest.raises(InputError, match="there is no later scan to guide"):
        session.set_guides(GuideMarks(np.zeros((3, 2)), np.zeros((3, 2))))
    with pytest.raises(InputError, match="there are no homologous points"):
        session.dense(0.002)
    with pytest.raises(InputError, match="no scan is registered"):
        session.vessels()


def test_the_same_scan_again_has_not_moved(done):
    case, session, _, _ = done
    again = session.add_scan(replace(case.first.scan, stamp_ns=9_000_000_000))
    length_mm = m_to_mm(np.linalg.norm(again.homologous.displacements, axis=1))
    assert len(length_mm) >= 20
    assert length_mm.max() < 0.1


def test_a_later_scan_without_a_first_gives_no_points_by_itself(session):
    case = scan_case(2)
    session.set_initial_pose(case.start(5.0, 4.0))
    update = session.add_scan(case.later.scan)
    assert update.homologous is None
    assert update.registration is not None
    assert update.registration.accepted or update.registration.reasons


def test_a_first_scan_without_vessels_gives_way_to_the_next(session):
    case = scan_case(2)
    session.set_initial_pose(case.start(5.0, 4.0))
    cortex = np.isfinite(case.first.material).all(axis=-1)
    rgb = case.first.scan.rgb.copy()
    rgb[cortex] = np.median(rgb[cortex], axis=0)
    placed = session.place(replace(case.first.scan, rgb=rgb))
    assert placed.registration.accepted
    with pytest.raises(InputError, match="vessel features on the cortex"):
        session.compare()
    assert session.add_scan(case.first.scan).registration.accepted
    assert session.add_scan(case.later.scan).homologous is not None


def test_nothing_leaks_into_the_next_case(session):
    case, other = scan_case(1), scan_case(2)
    session.set_initial_pose(other.start(5.0, 4.0))
    session.add_scan(other.first.scan)
    session.add_scan(other.later.scan)
    session.reset()
    assert session.add_scan(case.first.scan).registration is None  # the old pose is gone
    session.reset()
    assert session.set_initial_pose(case.start(5.0, 4.0)) is None  # the waiting scan is gone
    used = session.add_scan(case.first.scan).registration
    fresh_session = LrsSession(mni_target())
    fresh_session.set_initial_pose(case.start(5.0, 4.0))
    fresh = fresh_session.add_scan(case.first.scan).registration
    assert used is not None
    assert fresh is not None
    np.testing.assert_array_equal(used.T_patient_tracker, fresh.T_patient_tracker)


def test_pixels_of_points_agree_with_the_scans_own_map():
    scan = scan_case(2).first.scan
    rows, columns = np.nonzero(scan.seen)
    pick = np.arange(0, len(rows), 501)
    pixels = pixels_of(scan, scan.points[rows[pick], columns[pick]].astype(np.float64))
    np.testing.assert_allclose(pixels, np.stack([columns[pick], rows[pick]], axis=-1), atol=1.0)


def test_a_page_needs_both_later_scan_and_points(tmp_path, session):
    case = scan_case(2)
    session.set_initial_pose(case.start(5.0, 4.0))
    first = session.add_scan(case.first.scan)
    with pytest.raises(InputError, match="scan page"):
        scan_page(tmp_path / "scan.png", first.registered, session.vessels(), later=case.later.scan)
    assert not (tmp_path / "scan.png").exists()
