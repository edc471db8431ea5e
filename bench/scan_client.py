"""A scanner's side of the graph, which measures how long the node `lrs` takes to answer."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from brainshift_ros import graph
from brainshift_ros.graph import Topic
from brainshift_ros.nodes.messages import message_class, to_message
from brainshift_ros.nodes.qos import PROFILES
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.runner import ros_environment
from brainshift_ros.wire.pose import encode_pose
from brainshift_ros.wire.scan import encode_scan

LIMIT_S = 60.0


class ScanClient:
    """Sends scans and waits for what comes of them.

    Parameters
    ----------
    domain_id
        ROS domain of the node.
    """

    def __init__(self, domain_id: int) -> None:
        # Fast DDS reads its profile when the first participant of this process is made.
        os.environ["FASTDDS_DEFAULT_PROFILES_FILE"] = ros_environment()["FASTDDS_DEFAULT_PROFILES_FILE"]
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=domain_id)
        self._node = rclpy.create_node("scan_client", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._publishers = {topic.name: self._publisher(topic) for topic in (graph.LRS_POINTS, graph.LRS_INITIAL_POSE)}
        self._arrivals: dict[str, list[float]] = {}
        self._figures: dict[str, str] = {}
        for topic in (graph.LRS_REGISTERED, graph.HOMOLOGOUS_POINTS):
            self._note_arrivals(topic)
        self._node.create_subscription(
            message_class(graph.DIAGNOSTICS.type), graph.DIAGNOSTICS.name, self._hear, PROFILES[graph.DIAGNOSTICS.qos]
        )
        self._reset = self._node.create_client(message_class("std_srvs/srv/Trigger"), "lrs/reset")

    def __enter__(self) -> ScanClient:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def wait_until_ready(self) -> None:
        """Wait until the node has loaded its patient and is matched with every publisher and service here."""
        self._until(lambda: "is loaded" in self._figures.get("patient file", ""), "the patient")
        self._until(lambda: all(p.get_subscription_count() for p in self._publishers.values()), "subscribers")
        self._until(self._reset.service_is_ready, "the service")

    def begin_case(self, T_patient_tracker: NDArray[np.float64]) -> None:
        """Reset the node and give it the pose to start from."""
        answer = self._reset.call_async(self._reset.srv_type.Request())
        self._until(answer.done, "the reset")
        # Diagnostics of the case before may still be on their way; the next heartbeat tells of this one.
        self._until(lambda: self._figures.get("scans_received") == "0", "the new case")
        message = to_message(graph.LRS_INITIAL_POSE.type, encode_pose(T_patient_tracker, 1))
        self._publishers[graph.LRS_INITIAL_POSE.name].publish(message)
        self._until(lambda: self._figures.get("pose", "").endswith("known"), "the pose")

    def seconds_to(self, topic: Topic, scan: OrganisedScan) -> float:
        """Seconds from handing a scan to the publisher until `topic` is received."""
        message = to_message(graph.LRS_POINTS.type, encode_scan(scan))
        arrivals = self._arrivals[topic.name]
        before = len(arrivals)
        sent_s = time.perf_counter()
        self._publishers[graph.LRS_POINTS.name].publish(message)
        self._until(lambda: len(arrivals) > before, topic.name)
        return arrivals[-1] - sent_s

    def figure(self, name: str) -> float:
        """Read a figure of the node's diagnostics, once it is there."""
        self._until(lambda: name in self._figures, f"the figure {name}")
        return float(self._figures[name])

    def wait_for_figure(self, name: str, value: int) -> None:
        """Wait until the node's diagnostics count so many."""
        self._until(lambda: self._figures.get(name) == str(value), f"{name} = {value}")

    def _publisher(self, topic: Topic) -> Any:
        return self._node.create_publisher(message_class(topic.type), topic.name, PROFILES[topic.qos])

    def _note_arrivals(self, topic: Topic) -> None:
        arrivals = self._arrivals[topic.name] = []
        self._node.create_subscription(
            message_class(topic.type),
            topic.name,
            lambda _: arrivals.append(time.perf_counter()),
            PROFILES[topic.qos],
            raw=True,
        )

    def _hear(self, message: Any) -> None:
        for status in message.status:
            if status.name == "lrs":
                self._figures = {item.key: item.value for item in status.values}

    def _until(self, condition: Callable[[], object], what: str) -> None:
        deadline = time.monotonic() + LIMIT_S
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {LIMIT_S:g} s for {what}; lrs says {self._figures}")
            self._executor.spin_once(timeout_sec=0.02)
