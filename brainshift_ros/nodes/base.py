"""What the four nodes share: heartbeat, diagnostics, checked subscriptions, checked publishers, clean ends."""

from __future__ import annotations

import itertools
import sys
import time
import traceback
from collections.abc import Callable, Collection
from concurrent.futures import Future
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import deserialize_message

from brainshift_ros import graph
from brainshift_ros.errors import InputError
from brainshift_ros.graph import Topic
from brainshift_ros.nodes.health import Health, Level
from brainshift_ros.nodes.messages import message_class, to_message
from brainshift_ros.nodes.qos import PROFILES
from brainshift_ros.nodes.stopping import leave, ros_until_stopped
from brainshift_ros.nodes.worker import Worker
from brainshift_ros.wire.plain import Plain

HEARTBEAT_S = 0.4

Value = TypeVar("Value")


class BrainshiftNode(Node):
    """A node of the graph: it takes and gives only what :mod:`brainshift_ros.graph` declares for it.

    No message can end it: a subscription receives bytes, and whatever goes wrong while they are deserialised, checked
    or handled becomes a diagnostic under the topic's name. Heavy work runs in :attr:`worker`.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.declaration = next(node for node in graph.NODES if node.name == name)
        self.health = Health(name)
        self._publishers_by_topic = {topic.name: self._publisher(topic) for topic in self.declaration.gives}
        #: When the message that is being handled arrived, by ``time.perf_counter``: before it was deserialised.
        self.arrived_s = 0.0
        self._workers: list[Worker] = []
        self.worker = self.create_worker()
        self._concurrent = ReentrantCallbackGroup()
        # The timer also wakes the executor, which then sees that it shall stop.
        self.create_timer(HEARTBEAT_S, self._heartbeat)

    def parameter(
        self,
        name: str,
        default: Value,
        description: str,
        bounds: tuple[float, float] | None = None,
        choices: Collection[Value] | None = None,
    ) -> Value:
        """Declare a read-only parameter and return its value.

        Parameters
        ----------
        name, default, description
            As `ros2 param describe` shows them; the type is the default's. The unit is part of the name or description.
        bounds
            Smallest and largest value allowed.
        choices
            The values allowed.

        Raises
        ------
        InputError
            The value given is of another type, out of bounds, or none of the choices.
        """
        descriptor = ParameterDescriptor(description=description, read_only=True)
        if bounds is not None and isinstance(default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(bounds[0]), to_value=int(bounds[1]), step=1)]
        elif bounds is not None:
            descriptor.floating_point_range = [FloatingPointRange(from_value=float(bounds[0]), to_value=float(bounds[1]))]
        if choices is not None:
            descriptor.additional_constraints = f"one of {', '.join(map(str, choices))}"
        range_text = f"from {bounds[0]} to {bounds[1]}" if bounds else "of the default's type"
        allowed = descriptor.additional_constraints or range_text
        remedy = f"give a value {allowed}, such as {default!r}"
        try:
            value: Value = self.declare_parameter(name, default, descriptor).value
        except ParameterException as error:
            raise InputError(f"parameter {name}", str(error).rstrip("."), remedy) from error
        if choices is not None and value not in choices:
            raise InputError(f"parameter {name}", f"is {value!r}", remedy)
        return value

    def take(self, topic: Topic, decode: Callable[[Any], Value], handle: Callable[[Value], None]) -> None:
        """Subscribe: `decode` checks a message and turns it into a value of the core, `handle` acts on it.

        A message that `decode` or `handle` refuses is reported and changes nothing; the next good one clears the report.
        """
        assert topic in self.declaration.takes, f"graph.py does not declare that {self.get_name()} takes {topic.name}"
        kind = message_class(topic.type)
        good = itertools.count(1)

        def on_bytes(serialised: bytes) -> None:
            self.arrived_s = time.perf_counter()
            # Deserialising here, not in rclpy, keeps a malformed serialisation from ending the executor.
            try:
                message = deserialize_message(serialised, kind)
            except Exception as error:
                self.report(topic.name, Level.ERROR, f"{topic.name}: is not a readable {topic.type} ({error})")
                return
            if not self.guarded(topic.name, lambda: handle(decode(message))):
                self.report(topic.name, Level.OK, f"{next(good)} received")

        self.create_subscription(kind, topic.name, on_bytes, PROFILES[topic.qos], raw=True)

    def give(self, topic: Topic, plain: Plain) -> None:
        """Publish a message on a topic that the graph declares for this node."""
        self._publishers_by_topic[topic.name].publish(to_message(topic.type, plain))

    def withdraw(self, topic: Topic) -> None:
        """Take back what a latched topic carried last: who joins from now on gets nothing until the next message."""
        self.destroy_publisher(self._publishers_by_topic[topic.name])
        self._publishers_by_topic[topic.name] = self._publisher(topic)

    def serve(self, name: str, answer: Callable[[Any, Any], Any]) -> None:
        """Offer a service ``~/name`` that the graph declares for this node; `answer` may be a coroutine function."""
        declared = next(item for item in graph.SERVICES if (item.node, item.name) == (self.get_name(), name))
        self.create_service(message_class(declared.type), f"~/{name}", answer, callback_group=self._concurrent)

    def create_worker(self) -> Worker:
        """Start a background thread whose results arrive in the executor's thread."""
        finished = self.create_guard_condition(lambda: worker.deliver())
        worker = Worker(finished.trigger)
        self._workers.append(worker)
        return worker

    def work(
        self,
        condition: str,
        job: Callable[[], Value],
        then: Callable[[Value], None],
        key: str = "",
        *,
        wanted: Callable[[], bool] = lambda: True,
        otherwise: Callable[[str], None] = lambda fault: None,
    ) -> None:
        """Run `job` in the worker thread, then `then` with its result in the executor's thread.

        Parameters
        ----------
        condition
            Under which name to report what goes wrong in either.
        job, then
            `then` reports success itself.
        key
            A waiting job with the same key (by default: the condition) is replaced.
        wanted
            Asked in the executor's thread when the job is done: whatever came of it, a failure too, is dropped if not.
        otherwise
            Called with the fault that was reported, if `job` or `then` failed.
        """

        def done(future: Future[Value]) -> None:
            if wanted() and (fault := self.guarded(condition, lambda: then(future.result()))):
                self.guarded(condition, lambda: otherwise(fault))

        self.worker.submit(key or condition, job, done)

    def shut_down(self) -> None:
        """Let the background threads take no further job."""
        for worker in self._workers:
            worker.stop()

    def guarded(self, condition: str, action: Callable[[], object]) -> str | None:
        """Call `action`; turn any exception into a diagnostic and return that. None if all went well."""
        try:
            action()
        except InputError as error:
            fault = str(error)
        except Exception as error:
            fault = f"{condition}: {type(error).__name__}: {error} (a fault of this software)"
            self.get_logger().error(traceback.format_exc())
        else:
            return None
        self.report(condition, Level.ERROR, fault)
        return fault

    def report(self, condition: str, level: Level, message: str) -> None:
        """Set a condition; a change is logged and published at once."""
        if not self.health.set(condition, level, message):
            return
        if level is Level.ERROR:
            self.get_logger().error(message)
        elif level is Level.WARN:
            self.get_logger().warning(message)
        self.publish_health()

    def publish_health(self) -> None:
        """Publish the node's diagnostics now."""
        self.give(graph.DIAGNOSTICS, self.health.array(self.now_ns()))

    def now_ns(self) -> int:
        """Read the node's clock, nanoseconds since the epoch."""
        nanoseconds: int = self.get_clock().now().nanoseconds
        return nanoseconds

    def tick(self) -> None:
        """Do what the node does at each heartbeat, besides reporting."""

    def _heartbeat(self) -> None:
        self.guarded("heartbeat", self.tick)
        self.publish_health()

    def _publisher(self, topic: Topic) -> Any:
        return self.create_publisher(message_class(topic.type), topic.name, PROFILES[topic.qos])


def spin(factory: Callable[[], BrainshiftNode]) -> None:
    """Run a node until SIGINT or SIGTERM; the process ends with status 0 and without a traceback.

    A node that refuses its parameters ends at once, with one line and status 2.
    """
    stop = ros_until_stopped()
    try:
        node = factory()
    except InputError as error:
        print(f"brainshift: {error}", file=sys.stderr)
        leave(2)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stop.is_set():
        executor.spin_once()  # the heartbeat ends it after 0.4 s at the latest
    node.shut_down()
    executor.shutdown()
    leave(0, node)
