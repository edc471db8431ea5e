"""What a node reports of itself: named conditions, each with a level and an exact message."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum

from brainshift_ros.wire.plain import Plain, header


class Level(IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


class Health:
    """Conditions by name (a topic, a file, a stage); the worst one speaks for the node."""

    def __init__(self, node: str) -> None:
        self._node = node
        self._conditions: dict[str, tuple[Level, str]] = {}
        self._values: dict[str, str] = {}

    def set(self, condition: str, level: Level, message: str) -> bool:
        """Set a condition; True if that changes it."""
        changed = self._conditions.get(condition) != (level, message)
        self._conditions[condition] = (level, message)
        return changed

    def report(self, values: Mapping[str, object]) -> None:
        """Add figures, such as times and counts, to the report."""
        self._values.update({name: str(value) for name, value in values.items()})

    @property
    def worst(self) -> tuple[Level, str]:
        """Level and message of the worst condition; the latest set among equals is not preferred."""
        return max(self._conditions.values(), key=lambda condition: condition[0], default=(Level.OK, "running"))

    def status(self) -> Plain:
        """Plain DiagnosticStatus: the node's level and message, each condition, and the figures."""
        level, message = self.worst
        conditions = {name: f"{item[0].name}: {item[1]}" for name, item in self._conditions.items()}
        values = [{"key": key, "value": value} for key, value in {**conditions, **self._values}.items()]
        return {"level": bytes([level]), "name": self._node, "message": message, "hardware_id": "", "values": values}

    def array(self, stamp_ns: int) -> Plain:
        """Plain DiagnosticArray that holds the one status."""
        return {"header": header("", stamp_ns), "status": [self.status()]}
