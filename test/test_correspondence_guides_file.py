"""Marks of a person: what the file says arrives, and each fault in it is named."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.correspondence.guides_file import read_guides
from brainshift_ros.errors import InputError
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.resources import resource


def blank(rows=480, columns=640):
    return OrganisedScan(np.zeros((rows, columns, 3), np.float32), np.zeros((rows, columns, 3), np.uint8), "tracker", 1)


def test_the_shipped_example_is_read():
    marks = read_guides(resource("config/guides_example.yaml"))
    np.testing.assert_array_equal(marks.first_px[0], [150, 220])
    np.testing.assert_array_equal(marks.later_px[2], [262, 428])
    np.testing.assert_array_equal(marks.vessels[0].later_px, [[203, 306], [352, 344]])


def test_pairs_become_guides(tmp_path):
    path = tmp_path / "guides.yaml"
    path.write_text("pairs_px: [[1, 2, 3, 4], [5, 6, 7, 8], [9.5, 10, 11, 12]]")
    guides = read_guides(path).guides(blank(), blank())
    np.testing.assert_array_equal(guides.first_px, [[1, 2], [5, 6], [9.5, 10]])
    np.testing.assert_array_equal(guides.later_px, [[3, 4], [7, 8], [11, 12]])


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("pairs_px: []", "marks nothing"),
        ("pairs_px: [[1, 2, 3]]", "pairs_px.0.3"),
        ("pairs_px: [[1, 2, 3, .nan]]", "pairs_px.0.3: Input should be a finite number"),
        ("pairs: [[1, 2, 3, 4]]", "pairs: Extra inputs are not permitted"),
        ("vessels: [{first_px: [[1, 2]], later_px: [[1, 2], [3, 4]]}]", "vessels.0.first_px"),
        ("[1", "is not YAML"),
    ],
)
def test_faults_of_the_file_are_named(tmp_path, text, fault):
    path = tmp_path / "guides.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_guides(path)
    assert fault in str(caught.value)
    assert caught.value.source == str(path)


def test_a_mark_outside_its_picture_is_named(tmp_path):
    path = tmp_path / "guides.yaml"
    path.write_text("pairs_px: [[1, 2, 3, 4], [5, 6, 7, 8], [300, 10, 11, 12]]")
    with pytest.raises(InputError, match=r"\[300, 10\] lies outside the first scan of 240 rows and 320 columns"):
        read_guides(path).guides(blank(240, 320), blank())
