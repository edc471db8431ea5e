"""Colour of a point cloud, in each of the packings that scanners and libraries use."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.errors import InputError
from brainshift_ros.graph import Topic
from brainshift_ros.wire.cloud import check_layout, field_names, read_columns, strided_view

#: Packed field -> its channels from the most significant of the lower three bytes down (PCL: 0xAARRGGBB).
PACKED: dict[str, str] = {"rgb": "rgb", "rgba": "rgb", "bgr": "bgr", "bgra": "bgr"}
_BRIGHTEST = 255.0


def read_colour(message: Any, topic: Topic) -> NDArray[np.uint8]:
    """Colour of each point, shape (height, width, 3), red, green, blue.

    Packed fields ``rgb``, ``rgba``, ``bgr``, ``bgra`` hold 0xAARRGGBB (or 0xAABBGGRR) in the bits of a float32, uint32 or
    int32. Separate fields ``r``, ``g``, ``b``, in any order, are uint8, or float32 from 0 to 1 or from 0 to 255: if none is
    above 1, one is full brightness.

    Raises
    ------
    InputError
        No colour, a field of another type, or separate floats outside 0 to 255.
    """
    names = field_names(message)
    for packed, channels in PACKED.items():
        if packed in names:
            return _packed(message, packed, channels, topic)
    if {"r", "g", "b"} <= set(names):
        return _separate(message, topic)
    raise InputError(topic.name, f"has no colour: its fields are {names}", "send a textured cloud with a field 'rgb'")


def _packed(message: Any, name: str, channels: str, topic: Topic) -> NDArray[np.uint8]:
    read_columns(message, {name: ("f4", "u4", "i4")}, topic)
    data = check_layout(message, topic)
    offset = next(int(field.offset) for field in message.fields if field.name == name)
    colour = np.empty((int(message.height), int(message.width), 3), dtype=np.uint8)
    for channel, letter in enumerate("rgb"):
        place = channels.index(letter)  # 0: the most significant of the three
        byte = 1 + place if message.is_bigendian else 2 - place
        colour[..., channel] = strided_view(message, data, offset + byte, np.uint8)
    return colour


def _separate(message: Any, topic: Topic) -> NDArray[np.uint8]:
    columns = read_columns(message, dict.fromkeys("rgb", ("u1", "f4")), topic)
    if all(column.dtype == np.uint8 for column in columns.values()):
        return np.stack([columns[letter] for letter in "rgb"], axis=-1)
    colour = np.stack([columns[letter] for letter in "rgb"], axis=-1).astype(np.float32)
    colour[~np.isfinite(colour)] = 0.0  # where nothing was seen
    low, high = float(colour.min()), float(colour.max())
    if low < 0.0 or high > _BRIGHTEST:
        problem = f"its colour fields r, g, b run from {low:.4g} to {high:.4g}"
        raise InputError(topic.name, problem, "send uint8, or float32 from 0 to 1 or from 0 to 255")
    if high <= 1.0:
        colour *= _BRIGHTEST
    return np.rint(colour).astype(np.uint8)
