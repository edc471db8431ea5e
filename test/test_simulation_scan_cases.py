"""The numbered cases: the truth that they score with, their start, their coverage of conditions."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulation_cases import mni_cortex

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.experiments.scan_scores import covered_share
from brainshift_ros.geometry import invert_rigid, rigid, transform_points
from brainshift_ros.simulation import scan_cases
from brainshift_ros.simulation.scan_brains import brain
from brainshift_ros.simulation.scan_cases import make_scan_case
from brainshift_ros.simulation.scan_plan import CASES_A_ROUND, SHIFT_CLASSES_MM, Severity, case_plan
from brainshift_ros.simulation.scanner import Scanner, Seen
from brainshift_ros.surface.queries import closest_points

TINY = Scanner(width=160, height=120)


@pytest.fixture(scope="module", autouse=True)
def quick_brain():
    """The template's own cortex for every brain, which saves seconds: brains are tested below."""
    cortex = mni_cortex()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scan_cases, "brain", lambda number: (cortex, cortex))
        yield
    case.cache_clear()


@lru_cache
def case():
    """Number 4 has a cavity and instruments."""
    return make_scan_case(4, scanner=TINY)


def exact_points(T_patient_tracker):
    """What a perfect correspondence on the first scan's delivered points gives through a registration."""
    at = case().surface_targets()
    at = at[case().is_lasting_cortex(at)]
    to_patient = T_patient_tracker @ case().first.T_error @ invert_rigid(case().T_patient_tracker)
    displacement = case().shift(at) @ (T_patient_tracker @ invert_rigid(case().T_patient_tracker))[:3, :3].T
    return HomologousPoints(transform_points(to_patient, at), displacement, np.full(len(at), 1e-4))


def test_exact_points_have_no_error():
    points = exact_points(case().T_patient_tracker)
    assert len(points.points) > 100
    np.testing.assert_allclose(case().point_errors_m(points, case().T_patient_tracker), 0.0, atol=1e-12)


def test_a_registration_that_is_off_finds_the_same_tissue_and_turns_its_displacement():
    turn = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(2.0)])
    T = rigid(turn, [1e-3, 2e-3, 0.0]) @ case().T_patient_tracker
    points = exact_points(T)
    residual = case().point_residuals_m(points, T)
    true = turn.inv().apply(points.displacements)
    np.testing.assert_allclose(residual, points.displacements - true, atol=1e-9)
    assert np.linalg.norm(residual, axis=1).max() > 1e-5


def test_wrong_displacements_are_charged_in_full():
    points = exact_points(case().T_patient_tracker)
    wrong = replace(points, displacements=points.displacements + np.array([0.0, 3e-3, 4e-3]))
    np.testing.assert_allclose(case().point_errors_m(wrong, case().T_patient_tracker), 5e-3, atol=1e-12)


def test_points_that_are_no_cortex_or_resected_have_no_error():
    T_patient_craniotomy = invert_rigid(case().scene.craniotomy.T_craniotomy_patient)
    x, y = case().cavity.center_m
    at = transform_points(T_patient_craniotomy, np.array([[x, y, 0.0], [0.0, 0.0, 0.05]]))
    points = HomologousPoints(at, np.zeros((2, 3)), np.full(2, 1e-4))
    assert np.isnan(case().point_errors_m(points, case().T_patient_tracker)).all()
    nothing = HomologousPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert case().point_errors_m(nothing, case().T_patient_tracker).shape == (0,)


def test_target_errors_of_a_shifted_pose_are_that_shift():
    T = case().T_patient_tracker.copy()
    assert max(error.max() for error in case().tre_m(T)) < 1e-12
    T[:3, 3] += [0.0, 3e-3, 4e-3]
    on_surface, deep = case().tre_m(T)
    np.testing.assert_allclose(on_surface, 5e-3)
    np.testing.assert_allclose(deep, 5e-3)
    assert len(on_surface) > 100
    assert len(deep) == 12


def test_the_start_is_off_by_no_more_than_it_may():
    T = case().start @ invert_rigid(case().T_patient_tracker)
    center = case().scene.craniotomy.center
    assert 2.0 < np.rad2deg(Rotation.from_matrix(T[:3, :3]).magnitude()) <= 15.0
    assert 1e-3 < np.linalg.norm(transform_points(T, center) - center) <= 10e-3


@pytest.mark.slow
def test_brains_differ_and_a_model_differs_from_its_brain_by_a_segmentation_error():
    true, model = brain(1)
    assert np.abs(true.vertices - brain(2)[0].vertices).max() > 5e-3
    distance = closest_points(model, true.vertices[:: len(true.vertices) // 3000]).distance
    assert 0.1e-3 < np.median(distance) < 1.0e-3
    worse = closest_points(brain(1, 1.5e-3)[1], true.vertices[:: len(true.vertices) // 3000]).distance
    assert np.median(worse) > 1.5 * np.median(distance)


def test_a_case_is_what_its_tags_say():
    assert {"cavity", "instruments"} <= case().tags
    assert case().tags == case_plan(4).tags
    labels = np.bincount(case().later.label.ravel(), minlength=5)
    assert labels[Seen.CAVITY] > 20
    assert labels[Seen.INSTRUMENT] > 20
    assert not (case().first.label == Seen.CAVITY).any()


@pytest.mark.parametrize("first", [0, CASES_A_ROUND])
def test_a_round_covers_conditions_evenly(first):
    tags = [case_plan(number).tags for number in range(first, first + CASES_A_ROUND)]
    for wanted in ({"cavity"}, {"instruments"}):
        assert sum(wanted <= found for found in tags) == CASES_A_ROUND // 3
    assert sum({"cavity", "instruments"} <= found for found in tags) == CASES_A_ROUND // 9
    shifts = [next(tag for tag in found if tag.startswith("shift")) for found in tags]
    conditions = {(shift, "cavity" in found, "instruments" in found) for shift, found in zip(shifts, tags, strict=True)}
    assert len({shift for shift, _, _ in conditions}) == len(SHIFT_CLASSES_MM) + 1
    for lobe in ("frontal", "parietal", "temporal"):
        for side in ("left", "right"):
            assert sum({lobe, side} <= found for found in tags) == CASES_A_ROUND // 6


def test_coverage_is_the_share_of_lasting_cortex_near_a_point():
    everywhere = case().first.current[case().first.label == Seen.CORTEX]
    assert covered_share(case(), everywhere) == 1.0
    one = covered_share(case(), everywhere[:1])
    assert 0.0 < one < 0.3
    assert covered_share(case(), np.zeros((0, 3))) == 0.0


def test_a_case_is_the_same_each_time_but_for_what_severity_names():
    bloody = make_scan_case(4, scanner=TINY, severity=Severity(blood_share=0.6, dropout_fraction=0.5))
    np.testing.assert_array_equal(bloody.later.label, case().later.label)
    np.testing.assert_array_equal(bloody.later.material, case().later.material)
    np.testing.assert_array_equal(bloody.first.scan.rgb, case().first.scan.rgb)
    np.testing.assert_array_equal(bloody.start, case().start)
    np.testing.assert_array_equal(bloody.first.T_error, case().first.T_error)
    cortex = case().later.label == Seen.CORTEX
    assert bloody.later.scan.seen[cortex].mean() < case().later.scan.seen[cortex].mean() - 0.3
    with_film, without = (scan.scan.rgb[cortex, 1].astype(float) for scan in (bloody.later, case().later))
    assert np.mean(with_film < 0.6 * without) == pytest.approx(0.6, abs=0.15)
