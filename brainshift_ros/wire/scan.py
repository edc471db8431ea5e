"""Organised, textured scans: PointCloud2 with x y z and colour <-> :class:`OrganisedScan`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.graph import LRS_POINTS, LRS_REGISTERED, Topic
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.wire.cloud import plain_cloud, read_columns
from brainshift_ros.wire.colour import read_colour
from brainshift_ros.wire.plain import REACH_M, Plain, check_frame, check_reach, stamp_ns

_XYZ = dict.fromkeys("xyz", ("f4", "f8"))
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
#: No scan is smaller than this across; numbers read in the wrong byte order are mostly next to zero or immense.
_SMALLEST_EXTENT_M = 1e-3


def decode_scan(message: Any, topic: Topic = LRS_POINTS) -> OrganisedScan:
    """Scan in a PointCloud2: fields x y z (float32 or float64) and colour (:func:`read_colour`) in any order and padding.

    A point with any coordinate that is not finite was not seen: all three become NaN.

    Raises
    ------
    InputError
        Wrong frame, sizes that lie, no points or none seen, not organised, no colour, a byte order that is not the flagged
        one, or millimetres.
    """
    frame_id = check_frame(message, topic)
    stamp = stamp_ns(message, topic)
    columns = read_columns(message, _XYZ, topic)
    if int(message.height) < 2 or int(message.width) < 2:
        problem = f"is not organised (height {message.height}, width {message.width})"
        raise InputError(topic.name, problem, "send the scanner's grid: height and width of its texture image")
    coordinates = _coordinates(columns)
    if not coordinates.plausible:
        _refuse(coordinates, columns, bool(message.is_bigendian), topic)
    return OrganisedScan(coordinates.points, read_colour(message, topic), frame_id, stamp)


@dataclass(frozen=True)
class _Coordinates:
    """Points (H, W, 3), NaN in all three coordinates where one is not finite, and the smallest and largest of each."""

    points: NDArray[np.float32]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @property
    def extent(self) -> float:
        return float(np.linalg.norm(self.high - self.low))

    @property
    def plausible(self) -> bool:
        """Whether they could be metres in an operating room; false where none is finite."""
        return bool(max(-self.low.min(), self.high.max()) <= REACH_M and self.extent >= _SMALLEST_EXTENT_M)


def _coordinates(columns: Mapping[str, NDArray[Any]]) -> _Coordinates:
    axes, low, high = [], [], []
    seen = np.ones(columns["x"].shape, dtype=bool)
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold becomes infinite: not seen
        for name in "xyz":
            # Contiguous: reductions and tests are several times as fast as on a view of the message.
            axis = np.ascontiguousarray(columns[name], dtype=np.float32)
            finite = np.isfinite(axis)
            if not finite.all():
                axis = np.where(finite, axis, np.float32(np.nan))
                seen &= finite
            axes.append(axis)
            low.append(float(np.fmin.reduce(axis, axis=None)))
            high.append(float(np.fmax.reduce(axis, axis=None)))
    points = np.asarray(cv2.merge(axes), dtype=np.float32)
    points.reshape(-1, 3)[np.flatnonzero(~seen)] = np.nan
    return _Coordinates(points, np.array(low), np.array(high))


def _refuse(found: _Coordinates, columns: Mapping[str, NDArray[Any]], flagged_big: bool, topic: Topic) -> None:
    """Say what is wrong with numbers that cannot be a scan's."""
    swapped = {name: column.view(column.dtype.newbyteorder()) for name, column in columns.items()}
    if _coordinates(swapped).plausible:
        flag, sense = ("true", "little-endian") if flagged_big else ("false", "big-endian")
        problem = f"is_bigendian is {flag}, but its numbers make sense only as {sense}"
        raise InputError(topic.name, problem, "set is_bigendian to the byte order of the data")
    if not np.isfinite(found.points[..., 0]).any():
        raise InputError(topic.name, f"none of its {found.points[..., 0].size} points was seen (all are NaN)", "scan again")
    check_reach(found.points, "points", topic)
    problem = f"all its points lie within {found.extent:.3g} m"
    raise InputError(topic.name, problem, "send the scan's own points, in metres")


def encode_scan(scan: OrganisedScan) -> Plain:
    """Plain PointCloud2 of a scan, organised, x y z rgb, NaN where nothing was seen."""
    return plain_cloud(_pack(scan).reshape(scan.rgb.shape[:2]), scan.frame_id, scan.stamp_ns, is_dense=bool(scan.seen.all()))


def encode_registered(scan: OrganisedScan) -> Plain:
    """Plain PointCloud2 of the points that a scan saw, one row: nothing published is ever NaN."""
    assert scan.frame_id == LRS_REGISTERED.frame, f"a registered scan lies in {LRS_REGISTERED.frame}, not {scan.frame_id}"
    seen = np.flatnonzero(scan.seen)
    return plain_cloud(_pack(scan).take(seen)[None], scan.frame_id, scan.stamp_ns, is_dense=True)


def _pack(scan: OrganisedScan) -> NDArray[np.void]:
    """Points of a scan as one flat structured array."""
    cloud = np.empty((scan.rgb.shape[0] * scan.rgb.shape[1], 4), dtype="<f4")
    for axis in range(3):
        cloud[:, axis] = scan.points[..., axis].ravel()
    bgra = np.ascontiguousarray(cv2.cvtColor(scan.rgb, cv2.COLOR_RGB2BGRA)).view("<u4").ravel()
    cloud.view("<u4")[:, 3] = bgra & np.uint32(0x00FFFFFF)  # alpha of 255 would make it a NaN to whoever reads a float
    return cloud.view(_POINT)[:, 0]
