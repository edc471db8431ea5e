"""Record the graph's topics: `python -m brainshift_ros.nodes.record OUT`; a tool, not one of the graph's nodes."""

from __future__ import annotations

import sys
import threading
import time
from pathlib import Path

import click
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from brainshift_ros import graph
from brainshift_ros.bags import BagWriter
from brainshift_ros.graph import Topic
from brainshift_ros.nodes.messages import message_class
from brainshift_ros.nodes.qos import PROFILES
from brainshift_ros.nodes.stopping import leave, ros_until_stopped
from brainshift_ros.nodes.tool import run_tool

POLL_S = 0.1


class Recorder(Node):
    """Writes what arrives, byte for byte, at the time of its arrival."""

    def __init__(self, bag: BagWriter, topics: list[Topic]) -> None:
        super().__init__("record")
        self.bag, self.topics = bag, topics
        for topic in topics:
            self._subscribe(topic)

    def _subscribe(self, topic: Topic) -> None:
        def on_bytes(cdr: bytes) -> None:
            self.bag.add_raw(topic, self.get_clock().now().nanoseconds, cdr)

        self.create_subscription(message_class(topic.type), topic.name, on_bytes, PROFILES[topic.qos], raw=True)


@click.command()
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--topic", "names", multiple=True, help="record only this topic (repeatable); default: the whole graph")
@click.option("--until", "goals", multiple=True, metavar="TOPIC[:N]", help="stop after N messages (1) on it (repeatable: all)")
@click.option("--timeout", type=click.FloatRange(0.0, min_open=True), help="stop after so many seconds")
@click.option("--replace", is_flag=True, help="replace an existing bag")
def command(out: Path, names: tuple[str, ...], goals: tuple[str, ...], timeout: float | None, replace: bool) -> None:
    """Record topics into a bag: a folder, or one file if OUT ends in .mcap.

    It ends on Ctrl-C or SIGTERM, when --until is met, or with exit status 3 when --timeout passes before that; the bag
    is complete in each case, and appears under its name only then.
    """
    wanted = {topic.name: count for topic, count in map(_goal, goals)}
    topics = graph.topics_named(names) or list(graph.TOPICS)
    topics += [topic for topic in graph.topics_named(list(wanted)) if topic not in topics]
    stop = ros_until_stopped()
    with BagWriter(out, replace=replace) as bag:
        node = Recorder(bag, topics)
        met = _record(node, wanted, timeout, stop)
    print(f"recorded {sum(bag.counts.values())} messages into {out}", flush=True)
    if not met:
        lacking = ", ".join(f"{name} ({bag.counts.get(name, 0)} of {count})" for name, count in wanted.items())
        print(f"stopped after {timeout} s without {lacking}", file=sys.stderr)
    leave(0 if met else 3, node)


def _record(node: Recorder, wanted: dict[str, int], timeout: float | None, stop: threading.Event) -> bool:
    """Record until told to stop; False if the time was up before the goals were met."""
    deadline = None if timeout is None else time.monotonic() + timeout
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    print(f"recording {len(node.topics)} topics", flush=True)
    while not stop.is_set():
        if wanted and all(node.bag.counts.get(name, 0) >= count for name, count in wanted.items()):
            return True
        if deadline is not None and time.monotonic() > deadline:
            return not wanted
        executor.spin_once(timeout_sec=POLL_S)
    return True


def _goal(text: str) -> tuple[Topic, int]:
    name, _, count = text.partition(":")
    if count and not (count.isdigit() and int(count) > 0):
        raise click.BadParameter(f"{text}: give TOPIC or TOPIC:N with N of 1 or more", param_hint="--until")
    return graph.topics_named([name])[0], int(count or 1)


def main() -> None:
    """Run the tool; bad input ends with one line and exit status 2."""
    run_tool(command, "record")


if __name__ == "__main__":
    main()
