"""The node graph, declared once: every topic's name, type, QoS profile, frame and units; every node; every service.

Nodes, runner, launch files, bag tools and docs read this module; none of them spells a topic name or a QoS of its own.
It holds no ROS import, so the numerical core, the bag writer and the runner may use it where no ROS is installed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from brainshift_ros.errors import InputError

PATIENT_FRAME = "patient"
TRACKER_FRAME = "tracker"


class Qos(Enum):
    """Named QoS profiles; ``nodes/qos.py`` turns each into an rclpy profile."""

    LATCHED = "latched"  # reliable, transient local, depth 1: late joiners get the newest
    RELIABLE = "reliable"  # reliable, volatile, depth 10: scans, events
    DIAGNOSTICS = "diagnostics"  # reliable, volatile, depth 10: as diagnostic_updater publishes


@dataclass(frozen=True)
class Topic:
    """One topic of the graph."""

    name: str
    type: str
    qos: Qos
    frame: str | None
    units: str


@dataclass(frozen=True)
class Service:
    """One service, ``~/name`` of its node."""

    node: str
    name: str
    type: str


ATLAS_INFO = Topic("atlas/info", "std_msgs/msg/String", Qos.LATCHED, None, "JSON, schema brainshift/atlas-info/1")
ATLAS_SURFACE = Topic("atlas/surface", "visualization_msgs/msg/Marker", Qos.LATCHED, PATIENT_FRAME, "m")
LRS_POINTS = Topic("lrs/points", "sensor_msgs/msg/PointCloud2", Qos.RELIABLE, TRACKER_FRAME, "x y z in m, rgb")
LRS_INITIAL_POSE = Topic("lrs/initial_pose", "geometry_msgs/msg/PoseStamped", Qos.LATCHED, PATIENT_FRAME, "m")
REGISTRATION = Topic("registration/patient_from_tracker", "geometry_msgs/msg/TransformStamped", Qos.LATCHED, PATIENT_FRAME, "m")
LRS_REGISTERED = Topic("lrs/registered", "sensor_msgs/msg/PointCloud2", Qos.RELIABLE, PATIENT_FRAME, "x y z in m, rgb")
HOMOLOGOUS_POINTS = Topic(
    "homologous_points",
    "sensor_msgs/msg/PointCloud2",
    Qos.LATCHED,
    PATIENT_FRAME,
    "x y z dx dy dz sigma, all m; empty: not measured",
)
DENSE_POINTS = Topic("dense_points", "sensor_msgs/msg/PointCloud2", Qos.LATCHED, PATIENT_FRAME, "x y z dx dy dz sigma, all m")
RETRACTOR_BLADE = Topic("retractor/blade", "geometry_msgs/msg/PolygonStamped", Qos.RELIABLE, PATIENT_FRAME, "m")
RETRACTOR_DISPLACEMENT = Topic("retractor/displacement", "geometry_msgs/msg/Vector3Stamped", Qos.RELIABLE, PATIENT_FRAME, "m")
ATLAS_RETRACTION = Topic(
    "atlas/retraction",
    "std_msgs/msg/Float32MultiArray",
    Qos.LATCHED,
    PATIENT_FRAME,
    "m; columns x nodes x xyz; the second dimension's label: `nodes of PATIENT_ID`",
)
RETRACTOR_STATUS = Topic(
    "retractor/status", "diagnostic_msgs/msg/DiagnosticStatus", Qos.LATCHED, None, "stage, progress 0..1, times in s"
)
DISPLACEMENT_FIELD = Topic(
    "displacement_field", "sensor_msgs/msg/PointCloud2", Qos.LATCHED, PATIENT_FRAME, "x y z dx dy dz std, all m"
)
DISPLACEMENT_MARKERS = Topic(
    "displacement_markers", "visualization_msgs/msg/MarkerArray", Qos.LATCHED, PATIENT_FRAME, "m; colours by mm"
)
SHIFT_ESTIMATE = Topic("shift_estimate", "std_msgs/msg/String", Qos.LATCHED, None, "JSON, schema brainshift/shift-estimate/2")
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", Qos.DIAGNOSTICS, None, "")

TOPICS: tuple[Topic, ...] = (
    ATLAS_INFO,
    ATLAS_SURFACE,
    LRS_POINTS,
    LRS_INITIAL_POSE,
    REGISTRATION,
    LRS_REGISTERED,
    HOMOLOGOUS_POINTS,
    DENSE_POINTS,
    RETRACTOR_BLADE,
    RETRACTOR_DISPLACEMENT,
    ATLAS_RETRACTION,
    RETRACTOR_STATUS,
    DISPLACEMENT_FIELD,
    DISPLACEMENT_MARKERS,
    SHIFT_ESTIMATE,
    DIAGNOSTICS,
)


@dataclass(frozen=True)
class Node:
    """One process of the graph: what it subscribes to and what it publishes (besides its heartbeat)."""

    name: str
    module: str
    takes: tuple[Topic, ...]
    gives: tuple[Topic, ...]


NODES: tuple[Node, ...] = (
    Node("atlas_loader", "brainshift_ros.nodes.atlas_loader", (), (ATLAS_INFO, ATLAS_SURFACE, DIAGNOSTICS)),
    Node(
        "lrs",
        "brainshift_ros.nodes.lrs",
        (LRS_POINTS, LRS_INITIAL_POSE),
        (REGISTRATION, LRS_REGISTERED, HOMOLOGOUS_POINTS, DENSE_POINTS, DIAGNOSTICS),
    ),
    Node(
        "retractor",
        "brainshift_ros.nodes.retractor",
        (RETRACTOR_BLADE, RETRACTOR_DISPLACEMENT),
        (ATLAS_RETRACTION, RETRACTOR_STATUS, DIAGNOSTICS),
    ),
    Node(
        "inverse",
        "brainshift_ros.nodes.inverse",
        (ATLAS_INFO, ATLAS_RETRACTION, HOMOLOGOUS_POINTS),
        (DISPLACEMENT_FIELD, DISPLACEMENT_MARKERS, SHIFT_ESTIMATE, DIAGNOSTICS),
    ),
)

SERVICES: tuple[Service, ...] = (
    Service("lrs", "reset", "std_srvs/srv/Trigger"),
    Service("lrs", "guide", "std_srvs/srv/Trigger"),
    Service("lrs", "dense", "std_srvs/srv/Trigger"),
    Service("retractor", "cancel", "std_srvs/srv/Trigger"),
    Service("inverse", "warp_image", "std_srvs/srv/Trigger"),
)

#: What a recorded case must hold to be replayed whole.
CASE_INPUTS: tuple[Topic, ...] = (LRS_INITIAL_POSE, LRS_POINTS, RETRACTOR_BLADE, RETRACTOR_DISPLACEMENT)


def topics_named(names: Sequence[str]) -> list[Topic]:
    """Topics of the graph by their names, with or without the leading slash.

    Raises
    ------
    InputError
        The graph has no such topic; the message lists those it has.
    """
    by_name = {topic.name.lstrip("/"): topic for topic in TOPICS}
    unknown = [name for name in names if name.lstrip("/") not in by_name]
    if unknown:
        raise InputError("topic", f"the graph has no {', '.join(unknown)}", f"choose from {', '.join(by_name)}")
    return [by_name[name.lstrip("/")] for name in names]
