"""Plain attributes -> rclpy messages, with the fast path for large sequences of numbers."""

from __future__ import annotations

import array
import re
from importlib import import_module
from typing import Any

import numpy as np

from brainshift_ros.wire.plain import Plain


def message_class(type_name: str) -> Any:
    """Class of a type such as ``sensor_msgs/msg/PointCloud2`` or ``std_srvs/srv/Trigger``."""
    package, kind, name = type_name.split("/")
    return getattr(import_module(f"{package}.{kind}"), name)


def to_message(type_name: str, plain: Plain) -> Any:
    """Message of a type with the given attributes; what `plain` leaves out keeps the type's default."""
    return _filled(message_class(type_name)(), plain)


def _filled(message: Any, plain: Plain) -> Any:
    types = message.get_fields_and_field_types()
    for name, value in plain.items():
        current = getattr(message, name)
        if isinstance(value, dict):
            _filled(current, value)
        elif isinstance(value, np.ndarray):
            # A list or a numpy array would be checked element by element: 0.2 to 0.5 s for a scan instead of 0.5 ms.
            numbers = array.array(current.typecode)
            numbers.frombytes(np.ascontiguousarray(value).view(np.uint8).data)
            setattr(message, name, numbers)
        elif of_messages := _SEQUENCE_OF_MESSAGES.fullmatch(types[name]):
            item = "{}/msg/{}".format(*of_messages.groups())
            setattr(message, name, [to_message(item, part) for part in value])
        else:
            setattr(message, name, value)
    return message


#: As a message class describes it: ``sequence<sensor_msgs/PointField>``.
_SEQUENCE_OF_MESSAGES = re.compile(r"sequence<(\w+)/(\w+)>")
