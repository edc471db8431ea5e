"""SIGINT and SIGTERM as a flag: what runs is finished in a valid ROS context, then the process ends with status 0.

rclpy's own handlers invalidate the context at once, so that a callback in the middle of publishing fails.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

import rclpy
from rclpy.signals import SignalHandlerOptions


@contextmanager
def ros_until_stopped() -> Iterator[threading.Event]:
    """Initialise rclpy and yield an event that SIGINT and SIGTERM set; shut rclpy down at the end."""
    stop = threading.Event()

    def set_flag(number: int, frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, set_flag)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        yield stop
    finally:
        rclpy.try_shutdown()
