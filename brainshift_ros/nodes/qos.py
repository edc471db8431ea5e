"""The graph's named QoS profiles as rclpy profiles; the only place that builds one."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from brainshift_ros.graph import Qos


def _profile(depth: int, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability
    )


PROFILES: dict[Qos, QoSProfile] = {
    Qos.LATCHED: _profile(1, DurabilityPolicy.TRANSIENT_LOCAL),
    Qos.RELIABLE: _profile(10, DurabilityPolicy.VOLATILE),
    Qos.DIAGNOSTICS: _profile(10, DurabilityPolicy.VOLATILE),
}
