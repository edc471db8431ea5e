"""SIGINT and SIGTERM as a flag: what runs is finished in a valid ROS context, then the process ends.

rclpy's own handlers invalidate the context at once, so that a callback in the middle of publishing fails.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import FrameType
from typing import NoReturn

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from brainshift_ros.nodes.deadline import exit_after

#: How long ROS may take to go; it needs a few tenths of a second.
TEARDOWN_LIMIT_S = 1.5


def ros_until_stopped() -> threading.Event:
    """Initialise rclpy and return an event that SIGINT and SIGTERM set."""
    stop = threading.Event()

    def set_flag(number: int, frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, set_flag)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    return stop


def leave(status: int, node: Node | None = None) -> NoReturn:
    """End the process: take the node out of the graph, so that nobody waits for it, then exit with `status` in any case.

    When several processes end at the same moment, Fast DDS 3.2 may wait for ever in the destruction of its participant, for
    a discovery callback that waits for the same lock, with Python's global lock held. Nothing is left to be saved by then.
    Not destroying it at all would leave its 64 MB of shared memory behind.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    exit_after(TEARDOWN_LIMIT_S, status)
    if node is not None:
        node.destroy_node()
    rclpy.try_shutdown()
    # A worker thread in native code would be torn down under the interpreter's feet.
    os._exit(status)
