"""Retraction: the blade and its displacement as they come in, the atlas columns as they go out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.graph import ATLAS_RETRACTION, RETRACTOR_BLADE, RETRACTOR_DISPLACEMENT, Topic
from brainshift_ros.wire.plain import Plain, check_finite, check_frame, check_reach, header, vector
from brainshift_ros.wire.vectors import LARGEST_SHIFT_M

#: Label of the dimension of nodes, with the patient's id after it.
_NODES_OF = "nodes of "


def decode_blade(message: Any, topic: Topic = RETRACTOR_BLADE) -> NDArray[np.float64]:
    """Corners of a retractor blade, shape (n, 3), n >= 3, metres, patient frame, from a PolygonStamped.

    Raises
    ------
    InputError
        Wrong frame, fewer than three corners, a number that is not finite, millimetres, or corners on one line.
    """
    check_frame(message, topic)
    corners = check_finite([vector(corner) for corner in message.polygon.points], "corners", topic).reshape(-1, 3)
    if len(corners) < 3:
        raise InputError(topic.name, f"has {len(corners)} corners", "send three or more corners of the blade")
    check_reach(corners, "corners", topic)
    spread = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
    if spread[1] <= 1e-3 * spread[0] or spread[0] == 0.0:
        raise InputError(topic.name, "its corners lie on one line", "send corners that span the blade's plane")
    return corners


def encode_blade(corners: NDArray[np.float64], stamp_ns: int) -> Plain:
    """Plain PolygonStamped of a blade."""
    points = [dict(zip("xyz", map(float, corner), strict=True)) for corner in corners]
    return {"header": header(str(RETRACTOR_BLADE.frame), stamp_ns), "polygon": {"points": points}}


def decode_retraction_vector(message: Any, topic: Topic = RETRACTOR_DISPLACEMENT) -> NDArray[np.float64]:
    """How far and whereto the retractor pushes, shape (3,), metres, patient frame, from a Vector3Stamped.

    Raises
    ------
    InputError
        Wrong frame, a number that is not finite, zero, or a length that can only be millimetres.
    """
    check_frame(message, topic)
    push = check_finite(vector(message.vector), "vector", topic)
    length = float(np.linalg.norm(push))
    if length == 0.0:
        raise InputError(topic.name, "is zero", "send the retractor's displacement in metres")
    if length > LARGEST_SHIFT_M:
        raise InputError(topic.name, f"is {length:.3g} m long", f"send metres, {LARGEST_SHIFT_M} at most")
    return push


def encode_retraction_vector(push: NDArray[np.float64], stamp_ns: int) -> Plain:
    """Plain Vector3Stamped of a retractor's displacement."""
    xyz = dict(zip("xyz", map(float, push), strict=True))
    return {"header": header(str(RETRACTOR_DISPLACEMENT.frame), stamp_ns), "vector": xyz}


@dataclass(frozen=True)
class RetractionColumns:
    """Columns that were solved during surgery, for the atlas to be appended with.

    Attributes
    ----------
    columns
        Shape (k, N, 3), metres, patient frame; k = 0 takes an earlier retraction back.
    patient_id
        Of the patient model on whose mesh they were solved; empty if the sender does not say.
    """

    columns: NDArray[np.float32]
    patient_id: str = ""


def decode_columns(message: Any, topic: Topic = ATLAS_RETRACTION) -> RetractionColumns:
    """Retraction columns from a Float32MultiArray of columns x nodes x xyz.

    The label of the second dimension, ``nodes`` or ``nodes of PATIENT_ID``, says whose mesh they belong to.

    Raises
    ------
    InputError
        Dimensions other than columns x nodes x 3, sizes that lie, or a number that is not finite.
    """
    sizes = [int(dimension.size) for dimension in message.layout.dim]
    if len(sizes) != 3 or sizes[2] != 3:
        raise InputError(topic.name, f"its dimensions are {sizes}", "send columns x nodes x 3")
    data = np.frombuffer(message.data, dtype=np.float32)[int(message.layout.data_offset) :]
    if len(data) != sizes[0] * sizes[1] * sizes[2]:
        problem = f"its dimensions {sizes} ask for {sizes[0] * sizes[1] * sizes[2]} numbers, its data hold {len(data)}"
        raise InputError(topic.name, problem, "send data and dimensions that agree")
    check_finite(data, "columns", topic)
    label = str(message.layout.dim[1].label)
    patient_id = label.removeprefix(_NODES_OF) if label.startswith(_NODES_OF) else ""
    return RetractionColumns(data.reshape(sizes).copy(), patient_id)


def encode_columns(columns: NDArray[np.floating], patient_id: str = "") -> Plain:
    """Plain Float32MultiArray of retraction columns, shape (columns, nodes, 3), solved on the mesh of a patient."""
    if not np.isfinite(columns).all():
        raise ValueError(f"{ATLAS_RETRACTION.name}: a number to be published is not finite")
    strides = [int(np.prod(columns.shape[axis:])) for axis in range(3)]
    labels = ("columns", f"{_NODES_OF}{patient_id}" if patient_id else "nodes", "xyz")
    dimensions = [
        {"label": label, "size": size, "stride": stride}
        for label, size, stride in zip(labels, columns.shape, strides, strict=True)
    ]
    return {"layout": {"dim": dimensions, "data_offset": 0}, "data": np.ascontiguousarray(columns, dtype=np.float32).ravel()}
