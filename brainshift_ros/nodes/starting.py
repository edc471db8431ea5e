"""How a node's executable begins: signals first, then the imports, which take seconds, then the node.

This module and the executables import nothing heavy, so that Ctrl-C in the first seconds ends a node as quietly as later.
"""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module
from types import FrameType


def run_node(module: str, class_name: str) -> None:
    """Import a node's class and run it until SIGINT or SIGTERM; the exit status is 0 whenever they come.

    A package that is missing or cannot be loaded ends the process with one line and status 2.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    try:
        node_class = getattr(import_module(module), class_name)
        spin = import_module("brainshift_ros.nodes.base").spin
    except ImportError as error:
        remedy = "install the packages of requirements/ in this environment, or source a ROS 2 installation first"
        print(f"brainshift: {module}: cannot be imported: {error}; {remedy}", file=sys.stderr)
        sys.exit(2)
    spin(node_class)


def _leave(number: int, frame: FrameType | None) -> None:
    # Not by an exception: a library that is being imported could catch it. Nothing is open yet.
    os._exit(0)
