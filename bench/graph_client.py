"""A participant beside the graph, which measures how long a node takes to answer."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from brainshift_ros import graph
from brainshift_ros.graph import Topic
from brainshift_ros.nodes.messages import message_class, to_message
from brainshift_ros.nodes.qos import PROFILES
from brainshift_ros.runner import ros_environment
from brainshift_ros.wire.plain import Plain

LIMIT_S = 60.0


class GraphClient:
    """Publishes, notes when answers arrive, and reads the diagnostics of one node.

    Parameters
    ----------
    node
        Name of the node that answers.
    domain_id
        Its ROS domain.
    gives, takes
        Topics that this client publishes, and that it waits for.
    """

    def __init__(self, node: str, domain_id: int, gives: Sequence[Topic], takes: Sequence[Topic]) -> None:
        # Fast DDS reads its profile when the first participant of this process is made.
        os.environ["FASTDDS_DEFAULT_PROFILES_FILE"] = ros_environment()["FASTDDS_DEFAULT_PROFILES_FILE"]
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        self._node_name = node
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=domain_id)
        self.node = rclpy.create_node("bench_client", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._publishers = {topic.name: self._publisher(topic) for topic in gives}
        self._arrivals: dict[str, list[float]] = {}
        self.figures: dict[str, str] = {}
        for topic in takes:
            self._note_arrivals(topic)
        self.node.create_subscription(
            message_class(graph.DIAGNOSTICS.type), graph.DIAGNOSTICS.name, self._hear, PROFILES[graph.DIAGNOSTICS.qos]
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)

    def wait_for_subscribers(self) -> None:
        """Wait until every publisher here is matched."""
        self.until(lambda: all(p.get_subscription_count() for p in self._publishers.values()), "subscribers")

    def send(self, topic: Topic, plain: Plain) -> None:
        """Publish."""
        self._publishers[topic.name].publish(to_message(topic.type, plain))

    def seconds_to(self, awaited: Sequence[Topic], topic: Topic, plain: Plain) -> list[float]:
        """Seconds from handing a message to its publisher until each of `awaited` has been received next."""
        message = to_message(topic.type, plain)
        arrivals = [self._arrivals[each.name] for each in awaited]
        before = [len(each) for each in arrivals]
        sent_s = time.perf_counter()
        self._publishers[topic.name].publish(message)
        self.until(
            lambda: all(len(each) > count for each, count in zip(arrivals, before, strict=True)),
            ", ".join(each.name for each in awaited),
        )
        return [each[count] - sent_s for each, count in zip(arrivals, before, strict=True)]

    def figure(self, name: str) -> float:
        """Read a figure of the node's diagnostics, once it is there."""
        self.until(lambda: name in self.figures, f"the figure {name}")
        return float(self.figures[name])

    def wait_for_figure(self, name: str, value: int) -> None:
        """Wait until the node's diagnostics count so many."""
        self.until(lambda: self.figures.get(name) == str(value), f"{name} = {value}")

    def until(self, condition: Callable[[], object], what: str) -> None:
        """Spin until `condition()` is true.

        Raises
        ------
        TimeoutError
            It did not become so within a minute.
        """
        deadline = time.monotonic() + LIMIT_S
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {LIMIT_S:g} s for {what}; {self._node_name} says {self.figures}")
            self._executor.spin_once(timeout_sec=0.02)

    def _publisher(self, topic: Topic) -> Any:
        return self.node.create_publisher(message_class(topic.type), topic.name, PROFILES[topic.qos])

    def _note_arrivals(self, topic: Topic) -> None:
        arrivals = self._arrivals[topic.name] = []
        self.node.create_subscription(
            message_class(topic.type),
            topic.name,
            lambda _: arrivals.append(time.perf_counter()),
            PROFILES[topic.qos],
            raw=True,
        )

    def _hear(self, message: Any) -> None:
        for status in message.status:
            if status.name == self._node_name:
                self.figures = {item.key: item.value for item in status.values}
