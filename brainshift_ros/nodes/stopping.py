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


def ros_until_stopped() -> threading.Event:
    """Initialise rclpy and return an event that SIGINT and SIGTERM set."""
    stop = threading.Event()

    def set_flag(number: int, frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, set_flag)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    return stop


def withdraw(node: Node) -> None:
    """Take a node's endpoints out of the graph, so that nobody waits for them; the last thing before :func:`leave`."""
    for publisher in list(node.publishers):
        node.destroy_publisher(publisher)
    for subscription in list(node.subscriptions):
        node.destroy_subscription(subscription)
    for service in list(node.services):
        node.destroy_service(service)


def leave(status: int) -> NoReturn:
    """End the process without taking ROS down.

    When several processes end at the same moment, Fast DDS may wait for ever in the destruction of its participant, for a
    discovery callback that waits for the same lock, with Python's global lock held. Nothing is left to be saved by then.
    A thread in native code would also be torn down under the interpreter's feet.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
