"""The parts that every message shares: plain attributes, header, stamp, frame, and the checks on them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.graph import Topic

#: A message as nested attributes: str, int, float, bool, numpy arrays for sequences of numbers, lists for the rest.
Plain = dict[str, Any]

NS_PER_S = 1_000_000_000

#: Positions further than this from the frame's origin can only be millimetres taken for metres, in an operating room.
REACH_M = 10.0


def header(frame_id: str, stamp_ns: int) -> Plain:
    """Plain std_msgs/Header."""
    return {"stamp": plain_stamp(stamp_ns), "frame_id": frame_id}


def plain_stamp(stamp_ns: int) -> Plain:
    """Plain builtin_interfaces/Time of nanoseconds since the epoch."""
    return {"sec": stamp_ns // NS_PER_S, "nanosec": stamp_ns % NS_PER_S}


def stamp_ns(message: Any, topic: Topic) -> int:
    """Time of a stamped message in nanoseconds since the epoch."""
    stamp = message.header.stamp
    if stamp.sec < 0 or not 0 <= stamp.nanosec < NS_PER_S:
        problem = f"its stamp is {stamp.sec} s and {stamp.nanosec} ns"
        raise InputError(topic.name, problem, "send seconds since the epoch and nanoseconds below 1e9")
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def check_frame(message: Any, topic: Topic) -> str:
    """Return the frame of a stamped message, which must be the one that the graph declares for the topic."""
    return expect_frame(str(message.header.frame_id), str(topic.frame), topic)


def expect_frame(found: str, expected: str, topic: Topic) -> str:
    """Return `found` if it is `expected`."""
    if found != expected:
        raise InputError(topic.name, f"frame is '{found}', expected '{expected}'", f"send it in frame '{expected}'")
    return found


def check_finite(values: ArrayLike, what: str, topic: Topic) -> NDArray[np.float64]:
    """`values` as float64, if all of them are finite."""
    array = np.asarray(values, dtype=np.float64)
    bad = int(np.count_nonzero(~np.isfinite(array)))
    if bad:
        raise InputError(topic.name, f"{bad} of {array.size} numbers of its {what} are not finite", "send finite numbers only")
    return array


def check_reach(positions: NDArray[np.floating], what: str, topic: Topic) -> None:
    """Refuse positions that are too far away to be metres; NaN rows do not count."""
    farthest = float(np.max(np.abs(positions), initial=0.0, where=np.isfinite(positions)))
    if farthest > REACH_M:
        problem = f"its {what} reach {farthest:.3g} m from the origin"
        raise InputError(topic.name, problem, "send metres, not millimetres")


def vector(xyz: Any) -> list[float]:
    """Components of a geometry_msgs Point, Point32 or Vector3."""
    return [float(xyz.x), float(xyz.y), float(xyz.z)]
