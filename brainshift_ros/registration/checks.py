"""What a scan must satisfy before anything is computed from it."""

from __future__ import annotations

import numpy as np

from brainshift_ros.errors import InputError
from brainshift_ros.registration.scan import OrganisedScan

_LEAST_POINTS = 2000
_LARGEST_EXTENT_M = 1.0
_SMALLEST_EXTENT_M = 0.02
_LEAST_CONTRAST = 3.0
_SAMPLED_POINTS = 10_000


def check_scan(scan: OrganisedScan, source: str = "scan") -> None:
    """Refuse a scan that no registration or correspondence can use.

    Raises
    ------
    InputError
        For arrays that do not fit together, too few points, a wrong unit (millimetres for metres), or no colour.
    """
    if scan.points.ndim != 3 or scan.points.shape[2] != 3 or min(scan.points.shape[:2]) < 16:
        raise InputError(source, f"points have shape {scan.points.shape}", "send an organised cloud of at least 16 x 16 pixels")
    if scan.rgb.shape != scan.points.shape:
        raise InputError(
            source, f"colour has shape {scan.rgb.shape}, points {scan.points.shape}", "send one colour for each point"
        )
    seen = scan.seen
    count = int(seen.sum())
    if count < _LEAST_POINTS:
        raise InputError(
            source, f"only {count} of {seen.size} points were seen", f"send at least {_LEAST_POINTS} finite points"
        )
    # Extent and contrast are those of a sample: to sort all points of every scan would take longer than to move them.
    sampled = np.flatnonzero(seen)[:: max(1, count // _SAMPLED_POINTS)]
    points, colour = scan.points.reshape(-1, 3)[sampled], scan.rgb.reshape(-1, 3)[sampled]
    low, high = np.quantile(points, [0.02, 0.98], axis=0)
    extent = float(np.linalg.norm(high - low))
    if extent > _LARGEST_EXTENT_M:
        raise InputError(source, f"it extends over {extent:.3g} m", "send metres; these look like millimetres")
    if extent < _SMALLEST_EXTENT_M:
        raise InputError(source, f"it extends over {extent:.3g} m", "send metres, and a scan of the whole craniotomy")
    contrast = float(colour.astype(np.float32).std(axis=0).max())
    if contrast < _LEAST_CONTRAST:
        raise InputError(source, f"its colour hardly varies (standard deviation {contrast:.1f} of 255)", "send a textured scan")
