"""Organised, textured scans: PointCloud2 with x y z and colour <-> :class:`OrganisedScan`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.graph import LRS_POINTS, LRS_REGISTERED, Topic
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.wire.cloud import field_names, plain_cloud, read_columns
from brainshift_ros.wire.plain import Plain, check_frame, check_reach, stamp_ns

_XYZ = dict.fromkeys("xyz", ("f4", "f8"))
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])


def decode_scan(message: Any, topic: Topic = LRS_POINTS) -> OrganisedScan:
    """Scan in a PointCloud2.

    Colour may come as ``rgb`` or ``rgba`` (0x00RRGGBB in the bits of a float32 or uint32, as PCL packs it) or as three
    uint8 fields ``r g b``. A point with any coordinate that is not finite was not seen: all three become NaN.

    Raises
    ------
    InputError
        Wrong frame, sizes that lie, no points or none seen, not organised, no colour, or millimetres.
    """
    frame_id = check_frame(message, topic)
    columns = read_columns(message, _XYZ, topic)
    if int(message.height) < 2 or int(message.width) < 2:
        problem = f"is not organised (height {message.height}, width {message.width})"
        raise InputError(topic.name, problem, "send the scanner's grid: height and width of its texture image")
    points = np.stack([columns[axis] for axis in "xyz"], axis=-1).astype(np.float32)
    points[~np.isfinite(points).all(axis=-1)] = np.nan
    if not np.isfinite(points[..., 0]).any():
        raise InputError(topic.name, f"none of its {points[..., 0].size} points was seen (all are NaN)", "scan again")
    check_reach(points, "points", topic)
    return OrganisedScan(points=points, rgb=_colour(message, topic), frame_id=frame_id, stamp_ns=stamp_ns(message, topic))


def _colour(message: Any, topic: Topic) -> NDArray[np.uint8]:
    """Colour of each point, shape (H, W, 3)."""
    names = field_names(message)
    for packed in ("rgb", "rgba"):
        if packed in names:
            column = read_columns(message, {packed: ("f4", "u4")}, topic)[packed]
            bits = column.view(column.dtype.byteorder + "u4") if column.dtype.kind == "f" else column
            return np.stack([bits >> 16 & 0xFF, bits >> 8 & 0xFF, bits & 0xFF], axis=-1).astype(np.uint8)
    if {"r", "g", "b"} <= set(names):
        separate = read_columns(message, dict.fromkeys("rgb", ("u1",)), topic)
        return np.stack([separate[name] for name in "rgb"], axis=-1)
    raise InputError(topic.name, f"has no colour: its fields are {names}", "send a textured cloud with a field 'rgb'")


def encode_scan(scan: OrganisedScan) -> Plain:
    """Plain PointCloud2 of a scan, organised, x y z rgb, NaN where nothing was seen."""
    return plain_cloud(_pack(scan), scan.frame_id, scan.stamp_ns, is_dense=bool(scan.seen.all()))


def encode_registered(scan: OrganisedScan) -> Plain:
    """Plain PointCloud2 of the points that a scan saw, one row: nothing published is ever NaN."""
    assert scan.frame_id == LRS_REGISTERED.frame, f"a registered scan lies in {LRS_REGISTERED.frame}, not {scan.frame_id}"
    return plain_cloud(_pack(scan)[scan.seen][None], scan.frame_id, scan.stamp_ns, is_dense=True)


def _pack(scan: OrganisedScan) -> NDArray[np.void]:
    cloud = np.empty(scan.points.shape[:2], dtype=_POINT)
    for axis, name in enumerate("xyz"):
        cloud[name] = scan.points[..., axis]
    red, green, blue = (scan.rgb[..., channel].astype(np.uint32) for channel in range(3))
    cloud["rgb"] = red << 16 | green << 8 | blue
    return cloud
