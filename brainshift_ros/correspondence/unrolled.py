"""Stretches of vessel unrolled to straight strips of texture, and slid along each other until they agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

_STEP_M = 0.2e-3
_HALF_WIDTH_M = 2.0e-3
_WINDOW_SIGMA_M = 1.5e-3
_REACH_M = 2.0e-3
_STAY_PUT = 30.0  # correlation that a slide of one metre must gain
_LIKE_LENGTHS = 0.5  # correlation that lengths apart by a factor e must gain
_PATH_SIGMA_PX = 2.0  # smooths the staircase of a pixel path


@dataclass(frozen=True)
class Stretch:
    """A traced vessel in one scan.

    Attributes
    ----------
    pixels
        Shape (n, 2), (row, column), every 0.2 mm of its length.
    strip
        Shape (n, k), blood contrast across it, from left to right of its direction.
    length_m
        In 3-D, metres.
    """

    pixels: NDArray[np.float64]
    strip: NDArray[np.float32]
    length_m: float

    def at(self, share: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels at shares 0 to 1 of the length."""
        index = share * (len(self.pixels) - 1)
        return np.stack([np.interp(index, np.arange(len(self.pixels)), self.pixels[:, axis]) for axis in range(2)], axis=-1)


@dataclass(frozen=True)
class Match:
    """Two stretches that show the same vessel.

    Attributes
    ----------
    one, two
        The stretches.
    at_start, at_end
        How far the second one lies off along the vessel, metres.
    likeness
        Mean correlation of the strips, less what slides and unlike lengths cost.
    """

    one: Stretch
    two: Stretch
    at_start: float
    at_end: float
    likeness: float

    def pairs(self, spacing_m: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixels of both that belong together, shape (n, 2) each, n >= 3, about a spacing apart."""
        count = max(3, round(self.one.length_m / spacing_m) + 1)
        # What slid past an end of the other stretch has no partner there.
        low = max(0.0, -self.at_start / self.two.length_m)
        high = min(1.0, 1.0 - self.at_end / self.two.length_m)
        share = np.linspace(low, high, count)
        other = share + ((1.0 - share) * self.at_start + share * self.at_end) / self.two.length_m
        return self.one.at(share), self.two.at(np.clip(other, 0.0, 1.0))


def unroll(flat: NDArray[np.float32], path: NDArray[np.float64], along_m: NDArray[np.float64], pixel_m: float) -> Stretch:
    """Sample the contrast along and across a path.

    Parameters
    ----------
    flat
        Shape (H, W), blood contrast.
    path
        Shape (n, 2), (row, column).
    along_m
        Shape (n,), length up to each pixel, metres, increasing.
    pixel_m
        Pixel size, metres.
    """
    length_m = float(along_m[-1])
    even = np.linspace(0.0, length_m, max(2, round(length_m / _STEP_M) + 1))
    smooth = gaussian_filter1d(path, _PATH_SIGMA_PX, axis=0, mode="nearest")
    pixels = np.stack([np.interp(even, along_m, smooth[:, axis]) for axis in range(2)], axis=-1)
    tangent = np.gradient(gaussian_filter1d(pixels, _PATH_SIGMA_PX, axis=0, mode="nearest"), axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    offset = np.arange(-_HALF_WIDTH_M, _HALF_WIDTH_M + _STEP_M / 2, _STEP_M) / pixel_m
    row = (pixels[:, :1] - tangent[:, 1:] * offset).astype(np.float32)  # the normal of (dr, dc) is (-dc, dr)
    column = (pixels[:, 1:] + tangent[:, :1] * offset).astype(np.float32)
    strip = cv2.remap(flat, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return Stretch(pixels, np.asarray(strip, dtype=np.float32), length_m)


def best_match(ones: Sequence[Stretch], twos: Sequence[Stretch]) -> Match:
    """Match the two stretches, one of each scan, whose strips are most alike."""
    return max((_slid(one, two) for one in ones for two in twos), key=lambda match: match.likeness)


def _slid(one: Stretch, two: Stretch) -> Match:
    """Slide the second stretch along the first.

    Correlation of the strips over a window, for every place and slide, is averaged along a slide that grows linearly from
    start to end: two numbers from the whole length, so that a glint or an instrument over a part of it does no harm.
    """
    places = len(one.pixels)
    share = np.linspace(0.0, 1.0, places)
    slides = np.arange(-_REACH_M, _REACH_M + _STEP_M / 2, _STEP_M)
    likeness = np.stack([_likeness(one, two, share * (len(two.pixels) - 1) + slide / _STEP_M) for slide in slides])
    start, end = np.meshgrid(np.arange(len(slides)), np.arange(len(slides)), indexing="ij")
    between = np.round(start[..., None] * (1.0 - share) + end[..., None] * share).astype(int)
    gain = likeness[between, np.arange(places)].mean(axis=-1)
    gain -= _STAY_PUT * 0.5 * (np.abs(slides[start]) + np.abs(slides[end]))
    i, j = np.unravel_index(gain.argmax(), gain.shape)
    unlike = _LIKE_LENGTHS * abs(float(np.log(one.length_m / two.length_m)))
    return Match(one, two, float(slides[i]), float(slides[j]), float(gain[i, j]) - unlike)


def _likeness(one: Stretch, two: Stretch, at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Correlation, shape (places,), of the first strip with the second one resampled at the indices `at`."""
    low = np.clip(np.floor(at).astype(int), 0, len(two.strip) - 2)
    share = (at - low)[:, None]
    resampled = (1.0 - share) * two.strip[low] + share * two.strip[low + 1]
    a, b = one.strip - one.strip.mean(axis=0), resampled - resampled.mean(axis=0)
    sigma = _WINDOW_SIGMA_M / _STEP_M
    ab, aa, bb = (gaussian_filter1d((x * y).sum(axis=1), sigma, mode="constant") for x, y in ((a, b), (a, a), (b, b)))
    inside = (at >= 0) & (at <= len(two.pixels) - 1)
    return np.where(inside, ab / np.sqrt(np.maximum(aa * bb, 1e-12)), 0.0)
