"""The opening in scans that are far from what a scanner aimed at a craniotomy delivers."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.errors import InputError
from brainshift_ros.registration.opening import opening_mask, pixel_spacing
from brainshift_ros.registration.scan import OrganisedScan

PIXEL_M = 2e-4
ROW, COLUMN = np.indices((480, 640))
FROM_MIDDLE = np.hypot(ROW - 240, COLUMN - 320)


def scan(seen, rgb=None):
    """A gently waved plane at 0.3 m, seen where the mask says."""
    x, y = (COLUMN - 320) * PIXEL_M, (ROW - 240) * PIXEL_M
    points = np.stack([x, y, 0.3 + 0.002 * np.sin(COLUMN / 30)], axis=-1).astype(np.float32)
    points[~seen] = np.nan
    noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    return OrganisedScan(points, noise if rgb is None else rgb, "tracker", 0)


@pytest.mark.parametrize(
    "seen",
    [
        (FROM_MIDDLE > 150) & (FROM_MIDDLE < 230),
        (np.hypot(ROW - 240, COLUMN - 100) < 60) | (np.hypot(ROW - 240, COLUMN - 540) < 60),
    ],
    ids=["ring", "two islands"],
)
def test_where_the_middle_was_not_seen_all_seen_pixels_pass(seen):
    np.testing.assert_array_equal(opening_mask(scan(seen)), seen)


def test_one_flat_colour_in_the_middle_is_enough_to_find_its_edge():
    disc = FROM_MIDDLE < 120
    rgb = np.where(disc[..., None], [200, 150, 140], [10, 100, 100]).astype(np.uint8)
    opening = opening_mask(scan(np.ones_like(disc), rgb))
    assert opening[FROM_MIDDLE < 90].all()
    assert not opening[~disc].any()


def test_points_without_neighbours_in_their_row_have_no_spacing():
    with pytest.raises(InputError, match="too scattered"):
        pixel_spacing(scan(COLUMN % 17 == 3))
