"""Paired-point registration: against truth, against Monte Carlo, and what it must refuse."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.geometry import invert_rigid, rigid, transform_points
from brainshift_ros.registration.fiducials import register_fiducials
from brainshift_ros.registration.fiducials_file import read_fiducials
from brainshift_ros.resources import resource
from brainshift_ros.units import m_to_mm, mm_to_m

#: Skin fiducials around a head, and a tumour below them.
PATIENT = mm_to_m([[0, 95, -20], [70, 20, -10], [-72, 15, -5], [40, 70, 60], [-35, 75, 55], [10, -10, 98], [60, -40, 70]])
TUMOUR, FAR = (-0.030, 0.035, 0.030), (0.0, -0.060, -0.060)
FLE_M = 1.2e-3
TRUTH = rigid(Rotation.from_rotvec([0.4, -1.1, 2.0]), [0.3, -0.8, 1.4])


def measured(fle_m, rng, patient=PATIENT):
    """Tracker coordinates with an isotropic error whose length has the given root mean square."""
    return transform_points(invert_rigid(TRUTH), patient + rng.normal(0.0, fle_m / np.sqrt(3.0), patient.shape))


@lru_cache
def errors(count, target, trials=600, fle_m=FLE_M):
    """FRE, estimated FLE and TRE of many registrations; and the TRE that is predicted of the true FLE."""
    rng, patient = np.random.default_rng(0), PATIENT[:count]
    found = [register_fiducials(measured(fle_m, rng, patient), patient) for _ in range(trials)]
    tre = [np.linalg.norm(transform_points(f.T_patient_tracker @ invert_rigid(TRUTH), target) - target) for f in found]
    predicted = register_fiducials(measured(0.0, rng, patient), patient, fle_m).predicted_tre_m(target)
    return np.array([f.fre_m for f in found]), np.array([f.fle_m for f in found]), np.array(tre), predicted


def test_exact_pairs_give_the_exact_transform():
    found = register_fiducials(measured(0.0, np.random.default_rng(0)), PATIENT)
    np.testing.assert_allclose(found.T_patient_tracker, TRUTH, atol=1e-12)
    assert found.fre_m < 1e-12
    assert not found.warnings


@pytest.mark.parametrize(("count", "target"), [(7, TUMOUR), (4, TUMOUR), (7, FAR)])
def test_predicted_tre_is_the_simulated_one(count, target):
    """Fitzpatrick, West and Maurer (1998) hold to a few per cent, near the fiducials and far from them."""
    fre, fle, tre, predicted = errors(count, target)
    assert np.sqrt(np.mean(tre**2)) == pytest.approx(predicted, rel=0.08)
    assert np.sqrt(np.mean(fle**2)) == pytest.approx(FLE_M, rel=0.05)
    assert np.sqrt(np.mean(fre**2)) == pytest.approx(FLE_M * np.sqrt(1 - 2 / count), rel=0.05)


def test_fre_is_no_measure_of_tre():
    fre, _, tre, _ = errors(7, TUMOUR)
    assert abs(np.corrcoef(fre, tre)[0, 1]) < 0.12


@pytest.mark.parametrize(("count", "fre_mm", "tre_mm"), [(6, 0.6, 1.8), (5, 0.7, 1.9), (7, 0.7, 1.9)])
def test_table_10_lies_where_theory_says_and_above(count, fre_mm, tre_mm):
    """The thesis measured TRE of 1.8 to 1.9 mm at FRE of 0.6 to 0.7 mm.

    Isotropic theory predicts more than FRE (its TRE holds the localisation of each target too) and less than was measured:
    a small FRE promised what the targets did not keep.
    """
    fle_m = float(mm_to_m(fre_mm)) / np.sqrt(1 - 2 / count)
    exact = measured(0.0, np.random.default_rng(0), PATIENT[:count])
    predicted = register_fiducials(exact, PATIENT[:count], fle_m).predicted_tre_m(TUMOUR)
    assert fre_mm < m_to_mm(np.hypot(predicted, fle_m)) < tre_mm


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_the_order_of_the_pairs_and_the_frame_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    tracker = measured(1e-3, rng)
    order = rng.permutation(len(PATIENT))
    moved = rigid(Rotation.random(random_state=seed), rng.normal(size=3))
    first = register_fiducials(tracker, PATIENT)
    second = register_fiducials(transform_points(moved, tracker)[order], PATIENT[order])
    np.testing.assert_allclose(second.T_patient_tracker @ moved, first.T_patient_tracker, atol=1e-9)
    assert second.fre_m == pytest.approx(first.fre_m)
    assert second.predicted_tre_m(TUMOUR) == pytest.approx(first.predicted_tre_m(TUMOUR))


@pytest.mark.parametrize(
    ("tracker", "patient", "word"),
    [
        (PATIENT[:2], PATIENT[:2], "only 2"),
        (PATIENT, PATIENT[:5], "shapes"),
        (np.full_like(PATIENT, np.nan), PATIENT, "not finite"),
        (np.outer(np.arange(5), [0.01, 0.02, 0.0]), np.outer(np.arange(5), [0.01, 0.02, 0.0]), "one line"),
        (m_to_mm(PATIENT), m_to_mm(PATIENT), "metres"),
        (PATIENT * [-1, 1, 1], PATIENT, "mirrored"),
        (PATIENT[::-1], PATIENT, "order"),
    ],
    ids=["two", "unpaired", "nan", "line", "millimetres", "mirrored", "shuffled"],
)
def test_what_cannot_be_registered_is_named(tracker, patient, word):
    with pytest.raises(InputError, match=word):
        register_fiducials(tracker, patient)


def test_a_fiducial_that_moved_is_named():
    tracker = measured(0.3e-3, np.random.default_rng(3))
    tracker[2] += 12e-3
    found = register_fiducials(tracker, PATIENT, names=list("abcdefg"))
    assert any("fiducial c is off" in warning for warning in found.warnings)


def write(path, **changes):
    entries = [
        {"name": f"f{i}", "patient_mm": [float(v) for v in m_to_mm(p)], "tracker_mm": [float(v) for v in m_to_mm(t)]}
        for i, (p, t) in enumerate(zip(PATIENT, measured(0.0, np.random.default_rng(0)), strict=True))
    ]
    path.write_text(yaml.safe_dump({"fiducials": entries, **changes}), encoding="utf-8")
    return path


def test_the_shipped_example_can_be_registered():
    example = read_fiducials(resource("config/fiducials_example.yaml"))
    assert 0.0 < register_fiducials(example.tracker, example.patient, example.fle_m).fre_m < 1.5e-3


def test_the_file_holds_millimetres(tmp_path):
    pairs = read_fiducials(write(tmp_path / "fiducials.yaml", fle_mm=1.5))
    np.testing.assert_allclose(pairs.patient, PATIENT)
    assert pairs.fle_m == pytest.approx(1.5e-3)
    np.testing.assert_allclose(register_fiducials(*pairs).T_patient_tracker, TRUTH, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("fiducials: []", "fiducials"),
        ("fiducials: [{name: a, patient_mm: [1, 2], tracker_mm: [1, 2, 3]}]", "patient_mm"),
        ("nothing: 1", "nothing"),
        ("- 1", "no keys"),
    ],
)
def test_faults_of_the_file_are_named(tmp_path, text, word):
    path = tmp_path / "fiducials.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=word):
        read_fiducials(path)


def test_a_name_that_comes_twice_is_named(tmp_path):
    path = write(tmp_path / "fiducials.yaml")
    path.write_text(path.read_text(encoding="utf-8").replace("name: f1", "name: f0"), encoding="utf-8")
    with pytest.raises(InputError, match="f0 come twice"):
        read_fiducials(path)
