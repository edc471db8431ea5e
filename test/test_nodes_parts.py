"""The parts that nodes are made of, without starting one: messages, worker, health, QoS."""

from __future__ import annotations

import random
import threading
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from ros_cases import box_mesh, measured_points

from brainshift_ros import graph
from brainshift_ros.bags import TYPES, to_recordable
from brainshift_ros.errors import InputError
from brainshift_ros.nodes.health import Health, Level
from brainshift_ros.nodes.held_scans import ArrivedScan, HeldScans
from brainshift_ros.nodes.messages import message_class, to_message
from brainshift_ros.nodes.qos import PROFILES
from brainshift_ros.nodes.worker import Worker
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.wire.markers import displacement_markers, surface_marker
from brainshift_ros.wire.pose import decode_pose, encode_pose, encode_transform
from brainshift_ros.wire.retraction import (
    decode_blade,
    decode_columns,
    decode_retraction_vector,
    encode_blade,
    encode_columns,
    encode_retraction_vector,
)
from brainshift_ros.wire.scan import decode_scan, encode_scan
from brainshift_ros.wire.vectors import decode_homologous, encode_homologous


def every_plain():
    mesh = box_mesh(3)
    rng = np.random.default_rng(0)
    points = rng.normal(0.0, 0.1, (4, 5, 3)).astype(np.float32)
    health = Health("lrs")
    health.set("scan", Level.WARN, "dim")
    health.report({"rms_mm": 0.4})
    return {
        graph.LRS_POINTS: encode_scan(OrganisedScan(points, rng.integers(0, 256, (4, 5, 3), dtype=np.uint8), "tracker", 5)),
        graph.LRS_INITIAL_POSE: encode_pose(np.eye(4), 1_500_000_000),
        graph.REGISTRATION: encode_transform(np.eye(4), 7),
        graph.HOMOLOGOUS_POINTS: encode_homologous(measured_points(), 8),
        graph.RETRACTOR_BLADE: encode_blade(np.eye(3), 9),
        graph.RETRACTOR_DISPLACEMENT: encode_retraction_vector(np.array([0.0, 0.01, 0.0]), 9),
        graph.ATLAS_RETRACTION: encode_columns(rng.normal(size=(2, 3, 3)).astype(np.float32)),
        graph.ATLAS_SURFACE: surface_marker(mesh.nodes, mesh.facets["skull"], 10),
        graph.DISPLACEMENT_MARKERS: displacement_markers(mesh.nodes, mesh.facets["skull"], mesh.nodes * 0.01, 9, 11),
        graph.DIAGNOSTICS: health.array(12),
        graph.RETRACTOR_STATUS: health.status(),
        graph.ATLAS_INFO: {"data": '{"schema": "é"}'},
    }


@pytest.mark.parametrize("topic", every_plain(), ids=lambda topic: topic.name)
def test_rclpy_and_rosbags_make_the_same_message_of_plain_attributes(topic):
    plain = every_plain()[topic]
    travelled = TYPES.deserialize_cdr(serialize_message(to_message(topic.type, plain)), topic.type)
    # Compared as rosbags serialises them: rclpy leaves chance bytes where CDR pads.
    sent, recorded = (bytes(TYPES.serialize_cdr(item, topic.type)) for item in (travelled, to_recordable(topic.type, plain)))
    assert sent == recorded
    assert len(sent) > 4


DECODERS = {
    graph.LRS_POINTS: decode_scan,
    graph.LRS_INITIAL_POSE: decode_pose,
    graph.HOMOLOGOUS_POINTS: decode_homologous,
    graph.RETRACTOR_BLADE: decode_blade,
    graph.RETRACTOR_DISPLACEMENT: decode_retraction_vector,
    graph.ATLAS_RETRACTION: decode_columns,
}


@pytest.mark.parametrize("topic", DECODERS, ids=lambda topic: topic.name)
def test_damaged_bytes_either_fail_to_deserialise_or_are_checked(topic):
    """What a node does with each message; the process must survive, whatever the bytes are."""
    plain = every_plain()[topic]
    whole = bytes(TYPES.serialize_cdr(to_recordable(topic.type, plain), topic.type))
    rng = random.Random(topic.name)
    outcomes = Counter()
    for _ in range(300):
        damaged = bytearray(whole)
        for _ in range(rng.randint(1, 4)):
            damaged[rng.randrange(min(len(damaged), 200))] = rng.choice([0, 255, rng.randrange(256)])
        try:
            message = deserialize_message(bytes(damaged[: rng.randint(4, 2 * len(damaged))]), message_class(topic.type))
        except Exception:
            outcomes["unreadable"] += 1
            continue
        try:
            DECODERS[topic](message)
            outcomes["good"] += 1
        except InputError:
            outcomes["refused"] += 1
    assert min(outcomes[name] for name in ("unreadable", "good", "refused")) > 0, outcomes


@pytest.mark.parametrize("topic", graph.TOPICS, ids=lambda topic: topic.name)
def test_each_topic_has_a_message_class_and_a_profile(topic):
    assert message_class(topic.type).__name__ == topic.type.split("/")[-1]
    profile = PROFILES[topic.qos]
    assert profile.reliability is ReliabilityPolicy.RELIABLE
    assert (profile.durability is DurabilityPolicy.TRANSIENT_LOCAL) == (topic.qos is graph.Qos.LATCHED)
    assert profile.depth == (1 if topic.qos is graph.Qos.LATCHED else 10)


def test_the_worst_condition_speaks_for_the_node():
    health = Health("inverse")
    assert health.worst == (Level.OK, "running")
    health.set("atlas", Level.OK, "open")
    health.set("points", Level.ERROR, "points: wrong frame")
    health.set("estimate", Level.WARN, "few points")
    status = health.status()
    assert (status["level"], status["message"]) == (b"\x02", "points: wrong frame")
    assert {"key": "estimate", "value": "WARN: few points"} in status["values"]
    assert health.set("points", Level.OK, "1 received") is True
    assert health.set("points", Level.OK, "1 received") is False
    assert health.worst == (Level.WARN, "few points")
    health.set("atlas", Level.WARN, "another one is announced")
    assert health.worst == (Level.WARN, "another one is announced"), "of several the latest"
    health.set("estimate", Level.WARN, "few points")
    assert health.worst == (Level.WARN, "another one is announced"), "what stays as it was is not news"
    for name in ("atlas", "estimate"):
        health.set(name, Level.OK, f"{name} is well")
    assert health.worst == (Level.OK, "atlas is well")
    health.report({"time_solve_s": 1.0})
    health.forget_figures()
    assert {item["key"] for item in health.status()["values"]} == {"atlas", "points", "estimate"}


def test_of_the_scans_that_wait_the_first_and_the_newest_stay():
    now = [100.0]
    held = HeldScans(clock=lambda: now[0])
    nothing = OrganisedScan(np.zeros((2, 2, 3), np.float32), np.zeros((2, 2, 3), np.uint8), "tracker", 1)
    scans = [ArrivedScan(replace(nothing, stamp_ns=number), 0.0, 0.0) for number in range(4)]
    assert (held.waited_s(), [held.add(scan) for scan in scans]) == (0.0, [False, False, True, True])
    now[0] = 103.0
    assert (len(held), held.waited_s()) == (2, 3.0)
    assert held.take_first() is scans[0]
    assert held.waited_s() == 0.0, "the one that stays begins to wait"
    assert held.take_all() == [scans[3]]
    assert len(held) == 0


class Executor:
    """Delivers a worker's results in the test's thread."""

    def __init__(self):
        self.woken = threading.Semaphore(0)
        self.worker = Worker(self.woken.release)

    def run(self, jobs):
        for _ in range(jobs):
            assert self.woken.acquire(timeout=10)
        self.worker.deliver()


def test_the_newest_waiting_job_of_a_key_wins_and_others_keep_their_order():
    executor, gate, started, results = Executor(), threading.Event(), threading.Event(), []

    def first():
        started.set()
        gate.wait(10)
        return "first"

    def done(future):
        results.append((future.result(), threading.current_thread() is threading.main_thread()))

    executor.worker.submit("later", first, done)
    assert started.wait(10)
    executor.worker.submit("later", lambda: "older", done)
    executor.worker.submit("pose", lambda: "pose", done)
    executor.worker.submit("later", lambda: "newest", done)
    gate.set()
    executor.run(3)
    assert results == [("first", True), ("pose", True), ("newest", True)]
    executor.worker.stop()


def test_an_exception_in_a_job_is_handed_over_and_the_worker_goes_on():
    executor, results = Executor(), []
    executor.worker.submit("bad", lambda: 1 / 0, lambda future: results.append(future.exception()))
    executor.worker.submit("good", lambda: 2, lambda future: results.append(future.result()))
    executor.run(2)
    assert isinstance(results[0], ZeroDivisionError)
    assert results[1] == 2
    executor.worker.stop()


def test_a_stopped_worker_starts_no_waiting_job():
    executor, gate, started, ran = Executor(), threading.Event(), threading.Event(), []

    def first():
        started.set()
        gate.wait(10)

    executor.worker.submit("first", first, lambda future: None)
    executor.worker.submit("second", lambda: ran.append("second"), lambda future: None)
    assert started.wait(10)
    executor.worker.stop()
    gate.set()
    executor.worker.submit("third", lambda: ran.append("third"), lambda future: None)
    assert not executor.woken.acquire(timeout=0.3)
    assert ran == []
