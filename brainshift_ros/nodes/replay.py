"""Publish a bag: `python -m brainshift_ros.nodes.replay BAG`; a tool, not one of the graph's nodes."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import rclpy
from rclpy.duration import Duration
from rclpy.node import Node

from brainshift_ros import graph
from brainshift_ros.bags import Recorded, read_bag
from brainshift_ros.errors import InputError
from brainshift_ros.nodes.messages import message_class
from brainshift_ros.nodes.qos import PROFILES
from brainshift_ros.nodes.stopping import leave, ros_until_stopped
from brainshift_ros.nodes.tool import run_tool
from brainshift_ros.wire.plain import NS_PER_S

#: How long subscribers may take to acknowledge the last message.
ACKNOWLEDGE_LIMIT_S = 10.0
POLL_S = 0.02


def publish_bag(
    node: Node, recorded: Sequence[Recorded], *, rate: float, subscribers: int, wait_s: float, stop: threading.Event
) -> None:
    """Publish recorded messages, byte for byte, at `rate` times the speed of their recording.

    Publishing starts when each topic has `subscribers` subscribers or `wait_s` has passed, and ends when all of them have
    acknowledged.
    """
    topics = {message.topic.name: message.topic for message in recorded}
    publishers = {
        name: node.create_publisher(message_class(topic.type), name, PROFILES[topic.qos]) for name, topic in topics.items()
    }
    unmatched = _unmatched_after_limit(publishers, subscribers, wait_s, stop)
    if unmatched:
        few = f"fewer than {subscribers} subscribers of {', '.join(unmatched)} after {wait_s:g} s, publishing all the same"
        print(f"{few}; is the graph running in this ROS_DOMAIN_ID?", file=sys.stderr)
    begin, first = time.monotonic(), recorded[0].stamp_ns
    for message in recorded:
        due = begin + (message.stamp_ns - first) / NS_PER_S / rate
        if stop.wait(max(0.0, due - time.monotonic())):
            return
        publishers[message.topic.name].publish(message.cdr)
    for publisher in publishers.values():
        publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE_LIMIT_S))
    print(f"published {len(recorded)} messages", flush=True)


def _unmatched_after_limit(publishers: dict[str, Any], subscribers: int, wait_s: float, stop: threading.Event) -> list[str]:
    deadline = time.monotonic() + wait_s
    while True:
        waiting = [name for name, publisher in publishers.items() if publisher.get_subscription_count() < subscribers]
        if not waiting or time.monotonic() > deadline or stop.wait(POLL_S):
            return waiting


@click.command()
@click.argument("bag", type=click.Path(path_type=Path))
@click.option("--rate", type=click.FloatRange(0.0, min_open=True), default=1.0, show_default=True, help="speed factor")
@click.option("--topic", "names", multiple=True, help="publish this topic instead of the case's inputs (repeatable)")
@click.option("--subscribers", type=click.IntRange(0), default=1, show_default=True, help="wait for so many on each topic")
@click.option(
    "--wait",
    "wait_s",
    type=click.FloatRange(0.0),
    default=60.0,
    show_default=True,
    help="for so many seconds at most: nodes may still be starting",
)
@click.option("--stay", is_flag=True, help="keep latched topics alive until interrupted")
def command(bag: Path, rate: float, names: tuple[str, ...], subscribers: int, wait_s: float, stay: bool) -> None:
    """Publish the recorded inputs of a case: scans, pose, blade."""
    topics = graph.topics_named(names) or graph.CASE_INPUTS
    recorded = read_bag(bag, topics)
    if not recorded:
        wanted = ", ".join(topic.name for topic in topics)
        raise InputError(bag, f"holds no message on {wanted}", "record a case, or choose a topic by --topic")
    stop = ros_until_stopped()
    node = rclpy.create_node("replay")
    publish_bag(node, recorded, rate=rate, subscribers=subscribers, wait_s=wait_s, stop=stop)
    if stay:
        stop.wait()
    leave(0, node)


def main() -> None:
    """Run the tool; bad input ends with one line and exit status 2."""
    run_tool(command, "replay")


if __name__ == "__main__":
    main()
