"""A case at the scanner: order of pose and scans, refusals that do not block, nothing left after reset."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulation_cases import mni_target, scan_case

from brainshift_ros.correspondence.session import LrsSession
from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, transform_points
from brainshift_ros.graph import PATIENT_FRAME
from brainshift_ros.pictures.scan import pixels_of, scan_page
from brainshift_ros.units import m_to_mm


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
    assert first.vessels is not None
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
    scan_page(tmp_path / "scan.png", first.registered, first.vessels, later.registered, points)
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
    assert refused.vessels is None
    assert any("refused" in warning for warning in refused.warnings)
    far_off = session.set_initial_pose(case.start(0.0, 90.0))
    assert far_off is not None
    for update in (refused, far_off):
        assert "reasons" in update.diagnostics
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
        scan_page(tmp_path / "scan.png", first.registered, first.vessels, later=case.later.scan)
    assert not (tmp_path / "scan.png").exists()
