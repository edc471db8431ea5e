"""Clouds of displacement vectors with a standard deviation: homologous points and displacement fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.graph import DISPLACEMENT_FIELD, HOMOLOGOUS_POINTS, Topic
from brainshift_ros.wire.cloud import field_names, plain_cloud, read_columns
from brainshift_ros.wire.plain import Plain, check_finite, check_frame, check_reach, stamp_ns

#: A brain surface sinks by at most about 5 cm (thesis, table 9 and chapter II); beyond this, units or signs are wrong.
LARGEST_SHIFT_M = 0.1

_VECTOR = ("x", "y", "z", "dx", "dy", "dz")


@dataclass(frozen=True)
class StampedPoints:
    """Homologous points and the time of the later scan."""

    points: HomologousPoints
    stamp_ns: int


@dataclass(frozen=True)
class FieldSamples:
    """A displacement field as it travels: points (n, 3), displacements (n, 3), std (n,), metres, patient frame."""

    points: NDArray[np.float64]
    displacements: NDArray[np.float64]
    std: NDArray[np.float64]
    stamp_ns: int


def decode_homologous(message: Any, topic: Topic = HOMOLOGOUS_POINTS) -> StampedPoints:
    """Homologous points in a PointCloud2 with fields x y z dx dy dz sigma.

    Raises
    ------
    InputError
        Wrong frame, sizes that lie, no points, a missing field, a number that is not finite, a sigma that is not
        positive, or lengths that can only be millimetres.
    """
    table = _decode(message, (*_VECTOR, "sigma"), topic)
    sigma = table[:, 6]
    if np.any(sigma <= 0.0):
        problem = f"{np.count_nonzero(sigma <= 0.0)} of {len(sigma)} sigmas are not positive"
        raise InputError(topic.name, problem, "send each point's standard deviation in metres")
    points = HomologousPoints(points=table[:, :3], displacements=table[:, 3:6], sigma=sigma)
    return StampedPoints(points, stamp_ns(message, topic))


def encode_homologous(measured: HomologousPoints, stamp_ns: int, topic: Topic = HOMOLOGOUS_POINTS) -> Plain:
    """Plain PointCloud2 of homologous points, or of a dense field, which has the same columns."""
    table = np.column_stack([measured.points, measured.displacements, measured.sigma])
    return _encode(table, (*_VECTOR, "sigma"), topic, stamp_ns)


def encode_withdrawal(stamp_ns: int) -> Plain:
    """Plain PointCloud2 without points: the measurement of the case before no longer counts."""
    nothing = np.zeros((0, 3))
    return encode_homologous(HomologousPoints(nothing, nothing, np.zeros(0)), stamp_ns)


def decode_measurement(message: Any, topic: Topic = HOMOLOGOUS_POINTS) -> StampedPoints | None:
    """Homologous points, or None where a well-formed empty cloud takes the earlier ones back (a new case has begun).

    Raises
    ------
    InputError
        As :func:`decode_homologous`.
    """
    withdrawn = int(message.width) == 0 and len(message.data) == 0 and field_names(message) == [*_VECTOR, "sigma"]
    if not withdrawn:
        return decode_homologous(message, topic)
    check_frame(message, topic)
    stamp_ns(message, topic)
    return None


def decode_field(message: Any, topic: Topic = DISPLACEMENT_FIELD) -> FieldSamples:
    """Displacement field in a PointCloud2 with fields x y z dx dy dz std.

    Raises
    ------
    InputError
        As :func:`decode_homologous`, but `std` may be zero.
    """
    table = _decode(message, (*_VECTOR, "std"), topic)
    if np.any(table[:, 6] < 0.0):
        raise InputError(topic.name, "has a negative std", "send standard deviations in metres")
    return FieldSamples(table[:, :3], table[:, 3:6], table[:, 6], stamp_ns(message, topic))


def encode_field(field: DisplacementField, stamp_ns: int) -> Plain:
    """Plain PointCloud2 of a displacement field at the nodes of its mesh."""
    table = np.column_stack([field.mesh.nodes, field.displacement, field.std])
    return _encode(table, (*_VECTOR, "std"), DISPLACEMENT_FIELD, stamp_ns)


def _decode(message: Any, names: tuple[str, ...], topic: Topic) -> NDArray[np.float64]:
    check_frame(message, topic)
    columns = read_columns(message, dict.fromkeys(names, ("f4", "f8")), topic)
    table = check_finite(np.column_stack([columns[name].ravel() for name in names]), "points", topic)
    check_reach(table[:, :3], "points", topic)
    longest = float(np.linalg.norm(table[:, 3:6], axis=1).max())
    if longest > LARGEST_SHIFT_M:
        problem = f"its longest displacement is {longest:.3g} m"
        raise InputError(topic.name, problem, f"send metres; a brain does not shift by more than {LARGEST_SHIFT_M} m")
    return table


def _encode(table: NDArray[np.float64], names: tuple[str, ...], topic: Topic, stamp_ns: int) -> Plain:
    if not np.isfinite(table).all():
        raise ValueError(f"{topic.name}: a number to be published is not finite")
    packed = np.ascontiguousarray(table, dtype="<f4").view(np.dtype([(name, "<f4") for name in names]))
    return plain_cloud(packed.reshape(1, -1), str(topic.frame), stamp_ns, is_dense=True)
