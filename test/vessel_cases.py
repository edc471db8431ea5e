"""Flat scans with vessels drawn where the tests say."""

from __future__ import annotations

import cv2
import numpy as np

from brainshift_ros.registration.scan import OrganisedScan

CORTEX, BLOOD = np.array([190, 130, 110.0]), np.array([110, 25, 25.0])
PIXEL_M = 0.2e-3

WAVE = [(x, 60 + 15 * np.sin(x / 30)) for x in range(20, 300, 2)]
FORK = [[(40, 170), (160, 150)], [(160, 150), (290, 110)], [(160, 150), (210, 220)]]


def flat_scan(lines, width_px, *, shade=None, glints=(), shape=(240, 320)):
    """A flat scan with vessels along `lines` of (column, row) points."""
    fine = 8  # drawn coarse, OpenCV's smooth lines come out two pixels too wide
    cover = np.zeros((fine * shape[0], fine * shape[1]), np.uint8)
    for line in lines:
        at = np.round((np.array(line) + 0.5) * fine - 0.5).astype(np.int32)
        cv2.polylines(cover, [at], False, 255, width_px * fine)
    cover = cv2.resize(cover, shape[::-1], interpolation=cv2.INTER_AREA)
    alpha = cv2.GaussianBlur(cover, (0, 0), 0.7).astype(float)[..., None] / 255
    image = CORTEX * (1 - alpha) + BLOOD * alpha
    if shade is not None:
        image = image * shade[..., None]
    image = image + np.random.default_rng(0).normal(0, 2.0, image.shape)
    for column, row, radius in glints:
        cv2.circle(image, (column, row), radius, (250, 248, 245), -1)
    v, u = np.indices(shape)
    points = np.stack([u * PIXEL_M, v * PIXEL_M, np.full(shape, 0.3)], axis=-1).astype(np.float32)
    return OrganisedScan(points, np.clip(image, 0, 255).astype(np.uint8), "tracker", 0)


def sample(line, step=1.0):
    """Points (column, row) every `step` pixels along a line."""
    line = np.asarray(line, dtype=float)
    along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    at = np.arange(0, along[-1], step)
    return np.stack([np.interp(at, along, line[:, c]) for c in range(2)], axis=-1)
