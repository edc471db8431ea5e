"""sensor_msgs/PointCloud2 as named columns of numbers, whatever the order, offsets and padding of its fields."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.graph import Topic
from brainshift_ros.wire.plain import Plain, header

#: PointField.datatype -> numpy kind and size, as sensor_msgs/msg/PointField numbers them.
DATATYPES: dict[int, str] = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
FLOAT32, UINT8 = 7, 2


def field_names(message: Any) -> list[str]:
    """Names of a cloud's fields, in order."""
    return [str(field.name) for field in message.fields]


def check_layout(message: Any, topic: Topic) -> NDArray[np.uint8]:
    """Return the bytes of a cloud whose sizes agree with one another and that holds at least one point.

    Raises
    ------
    InputError
        Zero points, a row shorter than its points, or data that are longer or shorter than the rows.
    """
    height, width = int(message.height), int(message.width)
    point_step, row_step = int(message.point_step), int(message.row_step)
    data = np.frombuffer(message.data, dtype=np.uint8)
    if height == 0 or width == 0:
        raise InputError(topic.name, f"holds no points (height {height}, width {width})", "send a cloud with points")
    if point_step == 0 or row_step < width * point_step:
        problem = f"row_step is {row_step}, but {width} points of {point_step} bytes do not fit in it"
        raise InputError(topic.name, problem, "set row_step to width x point_step or more")
    if len(data) != row_step * height:
        problem = f"its data hold {len(data)} bytes, but row_step x height is {row_step} x {height} = {row_step * height}"
        raise InputError(topic.name, problem, "send data and sizes that agree")
    return data


def read_columns(message: Any, kinds: Mapping[str, Sequence[str]], topic: Topic) -> dict[str, NDArray[Any]]:
    """Columns of a cloud, as views of its bytes.

    Parameters
    ----------
    message
        A PointCloud2, or anything with its attributes.
    kinds
        Field name -> the numpy kinds it may have, such as ``("f4", "f8")``.
    topic
        Where the cloud came from.

    Returns
    -------
    dict
        Name -> array of shape (height, width) in the byte order of the message.

    Raises
    ------
    InputError
        A size lies, or a field is missing, doubled, of another type, an array, outside the point, or upon another.
    """
    data = check_layout(message, topic)
    order = ">" if message.is_bigendian else "<"
    columns: dict[str, NDArray[Any]] = {}
    extents: list[tuple[int, int, str]] = []
    for name, allowed in kinds.items():
        found = [field for field in message.fields if field.name == name]
        if len(found) != 1:
            problem = f"has {len(found) or 'no'} field{'s' if len(found) > 1 else ''} '{name}' among {field_names(message)}"
            raise InputError(topic.name, problem, f"send one of each: {', '.join(kinds)}")
        field = found[0]
        kind = DATATYPES.get(int(field.datatype), "unknown")
        if kind not in allowed or int(field.count) != 1:
            problem = f"field '{name}' has datatype {field.datatype} ({kind}) and count {field.count}"
            raise InputError(topic.name, problem, f"send it as one {' or '.join(allowed)} a point")
        start, end = int(field.offset), int(field.offset) + int(kind[1])
        if end > int(message.point_step):
            problem = f"field '{name}' ends at byte {end} of a point of {message.point_step}"
            raise InputError(topic.name, problem, "send offsets that lie within point_step")
        for other_start, other_end, other in extents:
            if start < other_end and other_start < end:
                raise InputError(topic.name, f"fields '{other}' and '{name}' overlap", "send offsets that keep fields apart")
        extents.append((start, end, name))
        columns[name] = strided_view(message, data, start, order + kind)
    return columns


def strided_view(message: Any, data: NDArray[np.uint8], offset: int, dtype: DTypeLike) -> NDArray[Any]:
    """Bytes from `offset` on in each point of a checked cloud, as an array of shape (height, width)."""
    return np.ndarray(
        shape=(int(message.height), int(message.width)),
        dtype=np.dtype(dtype),
        buffer=data,
        offset=offset,
        strides=(int(message.row_step), int(message.point_step)),
    )


def plain_cloud(points: NDArray[np.void], frame_id: str, stamp_ns: int, *, is_dense: bool) -> Plain:
    """Plain PointCloud2 of a structured array of little-endian float32 fields, shape (height, width).

    Parameters
    ----------
    points
        Structured array without padding; a field of kind ``u4`` travels as the float32 with the same bits, which is
        how PCL and RViz pack `rgb`.
    frame_id, stamp_ns
        The header.
    is_dense
        Whether every point is finite.
    """
    names = points.dtype.names or ()
    height, width = points.shape
    step = points.dtype.itemsize
    return {
        "header": header(frame_id, stamp_ns),
        "height": height,
        "width": width,
        "fields": [
            {"name": name, "offset": int(points.dtype.fields[name][1]), "datatype": FLOAT32, "count": 1}  # type: ignore[index]
            for name in names
        ],
        "is_bigendian": False,
        "point_step": step,
        "row_step": step * width,
        "data": np.ascontiguousarray(points).view(np.uint8).reshape(-1),
        "is_dense": is_dense,
    }
