"""Stamps of a case's scans: what is out of order, doubled or of another day is named, and a new case begins afresh."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainshift_ros.errors import InputError
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.wire.stamps import ScanStamps

SECOND = 10**9
NOW = 1_700_000_000 * SECOND


def scan(stamp_ns, content=0):
    points = np.full((2, 2, 3), content, dtype=np.float32)
    return OrganisedScan(points, np.zeros((2, 2, 3), dtype=np.uint8), "tracker", stamp_ns)


@given(st.lists(st.integers(1, 3600), min_size=1, max_size=8))
def test_scans_in_order_are_admitted_and_again_after_a_reset(steps_s):
    stamps = ScanStamps()
    times = NOW + np.cumsum(steps_s) * SECOND
    for _ in range(2):
        admitted = [stamps.admit(scan(int(time)), NOW) for time in times]
        assert not any(item.duplicate for item in admitted)
        stamps.reset()


@given(st.lists(st.integers(1, 3600), min_size=2, max_size=8))
def test_a_case_replayed_without_reset_gives_only_its_last_scan_again(steps_s):
    stamps = ScanStamps()
    times = [int(time) for time in NOW + np.cumsum(steps_s) * SECOND]
    for number, time in enumerate(times):
        stamps.admit(scan(time, number))
    again = [stamps.admit(scan(time, number)) for number, time in enumerate(times)]
    assert [item.duplicate for item in again] == [True] * (len(times) - 1) + [False]
    assert all(item.warnings for item in again)
    assert not stamps.admit(scan(times[-1] + 1, 0)).duplicate, "and what comes after it is new"


@pytest.mark.parametrize(("stamp_ns", "said"), [(0, "its stamp is zero"), (NOW, "its stamp is that of the scan before")])
def test_without_stamps_that_differ_the_order_of_arrival_counts(stamp_ns, said):
    stamps = ScanStamps()
    assert stamps.admit(scan(NOW), NOW).warnings == ()
    admitted = stamps.admit(scan(stamp_ns, 1), NOW)
    assert not admitted.duplicate
    assert said in admitted.warnings[0]


@pytest.mark.parametrize(
    ("stamp_ns", "fault"),
    [
        (NOW - SECOND // 2, "lies 0.500 s before that of an earlier scan"),
        (NOW + 49 * 3600 * SECOND, "lies 49 h after the scan before; call ~/reset"),
    ],
)
def test_what_would_mix_up_the_order_is_refused_and_changes_nothing(stamp_ns, fault):
    stamps = ScanStamps()
    stamps.admit(scan(NOW))
    with pytest.raises(InputError) as caught:
        stamps.admit(scan(stamp_ns, 1), NOW)
    assert fault in str(caught.value)
    assert caught.value.source == "lrs/points"
    assert not stamps.admit(scan(NOW + SECOND), NOW).duplicate


def test_a_clock_that_is_merely_wrong_is_reported():
    later = NOW + 3 * 3600 * SECOND
    assert ScanStamps().admit(scan(later), NOW).warnings == ("its stamp lies 3.0 h in the future of this node's clock",)
    assert ScanStamps().admit(scan(later), 0).warnings == (), "simulated time that has not begun says nothing"
    assert ScanStamps().admit(scan(SECOND), NOW).warnings == (), "a recorded case is replayed long after it"
