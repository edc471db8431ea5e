"""Head orientations fill their cone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainshift_ros.atlas.orientations import directions_in_cone

axes = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@settings(max_examples=40, deadline=None)
@given(axes, st.floats(0.0, 90.0), st.integers(1, 200))
def test_unit_vectors_inside_the_cone_with_the_planned_one_first(axis, cone_deg, count):
    planned = np.array(axis) / np.linalg.norm(axis)
    directions = directions_in_cone(axis, np.radians(cone_deg), count)
    assert directions.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(directions[0], planned, atol=1e-14)
    assert np.all(directions @ planned >= np.cos(np.radians(cone_deg)) - 1e-12)


@pytest.mark.parametrize("count", [30, 60, 200])
def test_cone_is_filled_evenly(count):
    # Equal areas hold equal numbers: in the inner half of the area half of the directions, in each quarter turn a quarter.
    directions = directions_in_cone([0.0, 0.0, 1.0], np.radians(20.0), count)
    half_area = 1.0 - (1.0 - np.cos(np.radians(20.0))) / 2.0
    assert np.count_nonzero(directions[:, 2] > half_area) == pytest.approx(count / 2, abs=1)
    quarters = np.histogram(np.arctan2(directions[:, 1], directions[:, 0]), bins=4, range=(-np.pi, np.pi))[0]
    assert quarters == pytest.approx([count / 4] * 4, abs=3)
    gap = np.linalg.norm(directions[:, None] - directions[None], axis=2) + 9.0 * np.eye(count)
    nearest = gap.min(axis=1)
    assert nearest.max() < 1.8 * nearest.min()


def test_last_direction_lies_on_the_rim():
    directions = directions_in_cone([0.0, -0.94, -0.34], np.radians(20.0), 30)
    assert np.degrees(np.arccos(directions[-1] @ directions[0])) == pytest.approx(20.0)
