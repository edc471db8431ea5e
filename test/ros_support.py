"""A ROS participant for tests: it listens, sends, calls services, and waits by polling, never by a fixed sleep."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from brainshift_ros import graph
from brainshift_ros.nodes.messages import message_class, to_message
from brainshift_ros.nodes.qos import PROFILES
from brainshift_ros.runner import ros_environment

# Before the first participant of this process: Fast DDS reads its profile once.
os.environ.update({name: ros_environment()[name] for name in ("FASTDDS_DEFAULT_PROFILES_FILE", "AMENT_PREFIX_PATH")})
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
# Nodes of tests keep out of the user's ~/.ros.
os.environ["ROS_LOG_DIR"] = str(Path(tempfile.gettempdir()) / "brainshift_ros_test_logs")

#: Generous: on a loaded machine a node needs several seconds to import what it computes with.
LIMIT_S = 60.0


class Probe:
    """Listens and speaks on one ROS domain."""

    def __init__(self, domain_id):
        self.context = Context()
        rclpy.init(args=[], context=self.context, domain_id=domain_id)
        self.node = rclpy.create_node("probe", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.received = {}
        self._publishers = {}
        self._clients = {}
        self.listen(graph.DIAGNOSTICS)

    def close(self):
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def listen(self, *topics):
        """Keep what arrives in `received[topic]`."""
        for topic in topics:
            if topic not in self.received:
                self.received[topic] = []
                self.node.create_subscription(
                    message_class(topic.type), topic.name, self.received[topic].append, PROFILES[topic.qos]
                )

    def until(self, condition, what, limit_s=LIMIT_S):
        """Spin until `condition()` is true; return its value."""
        deadline = time.monotonic() + limit_s
        while not (value := condition()):
            assert time.monotonic() < deadline, f"waited {limit_s} s for {what}; diagnostics: {self.said()}"
            self.executor.spin_once(timeout_sec=0.05)
        return value

    def after(self, topic, mark, limit_s=LIMIT_S):
        """The newest message on a topic once more than `mark` of them have come."""
        self.until(lambda: len(self.received[topic]) > mark, f"message {mark + 1} on {topic.name}", limit_s)
        return self.received[topic][-1]

    def newest(self, topic, limit_s=LIMIT_S):
        """The newest message on a topic, waiting for one if none has come."""
        self.listen(topic)
        self.until(lambda: self.received[topic], f"a message on {topic.name}", limit_s)
        return self.received[topic][-1]

    def publisher(self, topic):
        """Publisher on a topic whose node listens already."""
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(message_class(topic.type), topic.name, PROFILES[topic.qos])
        publisher = self._publishers[topic]
        self.until(lambda: publisher.get_subscription_count() > 0, f"a subscriber of {topic.name}")
        return publisher

    def send(self, topic, plain):
        """Publish a plain message."""
        self.publisher(topic).publish(to_message(topic.type, plain))

    def call(self, node, service, limit_s=LIMIT_S, again_s=LIMIT_S):
        """Call a Trigger service of a node; return the response and the seconds it took.

        A node that may have been killed must be asked again when no answer comes within `again_s`: to DDS a killed server is
        there until its lease ends, and the request that is sent to it reaches nobody.
        """
        key = (node, service)
        if key not in self._clients:
            declared = next(item for item in graph.SERVICES if (item.node, item.name) == key)
            self._clients[key] = self.node.create_client(message_class(declared.type), f"{node}/{service}")
        client = self._clients[key]
        self.until(client.service_is_ready, f"service {node}/{service}")
        begin = time.monotonic()
        requests = []

        def answered():
            if time.monotonic() - begin >= again_s * len(requests):
                requests.append(client.call_async(client.srv_type.Request()))
            return [request for request in requests if request.done()]

        answer = self.until(answered, f"an answer of {node}/{service}", limit_s)[0]
        return answer.result(), time.monotonic() - begin

    def has_settled(self, *nodes):
        """Wait until everything latched by these nodes has had time to arrive: three heartbeats of each."""
        begun = len(self.received[graph.DIAGNOSTICS])

        def heard():
            said = [s.name for message in self.received[graph.DIAGNOSTICS][begun:] for s in message.status]
            return all(said.count(node) >= 3 for node in nodes)

        self.until(heard, f"three heartbeats of {', '.join(nodes)}")

    def said(self):
        """Newest (level, message) of each node."""
        found = {}
        for array in self.received[graph.DIAGNOSTICS]:
            for status in array.status:
                found[status.name] = (int.from_bytes(status.level, "little"), status.message)
        return found

    def conditions(self, node):
        """Newest key values of a node's diagnostics."""
        for array in reversed(self.received[graph.DIAGNOSTICS]):
            for status in array.status:
                if status.name == node:
                    return {item.key: item.value for item in status.values}
        return {}

    def says(self, node, level, text, limit_s=LIMIT_S):
        """Wait until a node reports a level and a text in its message."""

        def found():
            status = self.said().get(node)
            return status is not None and status[0] == level and text in status[1]

        self.until(found, f"{node} to report level {level}: {text!r}", limit_s)
        return self.said()[node][1]
