"""What a node reports of itself: named conditions, each with a level and an exact message."""

from __future__ import annotations

import itertools
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
        self._changes: dict[str, int] = {}
        self._count = itertools.count()

    def set(self, condition: str, level: Level, message: str) -> bool:
        """Set a condition; True if that changes it."""
        changed = self._conditions.get(condition) != (level, message)
        self._conditions[condition] = (level, message)
        if changed:
            self._changes[condition] = next(self._count)
        return changed

    def report(self, values: Mapping[str, object]) -> None:
        """Add figures, such as times and counts, to the report."""
        self._values.update({name: str(value) for name, value in values.items()})

    def forget_figures(self) -> None:
        """Report no figure of before."""
        self._values.clear()

    @property
    def worst(self) -> tuple[Level, str]:
        """Level and message of the worst condition: of several faults the latest; where all is well, the first one set."""
        if not self._conditions:
            return (Level.OK, "running")
        level = max(level for level, _ in self._conditions.values())
        equals = [name for name, condition in self._conditions.items() if condition[0] is level]
        return self._conditions[equals[0] if level is Level.OK else max(equals, key=self._changes.__getitem__)]

    def status(self) -> Plain:
        """Plain DiagnosticStatus: the node's level and message, each condition, and the figures."""
        level, message = self.worst
        conditions = {name: f"{item[0].name}: {item[1]}" for name, item in self._conditions.items()}
        values = [{"key": key, "value": value} for key, value in {**conditions, **self._values}.items()]
        return {"level": bytes([level]), "name": self._node, "message": message, "hardware_id": "", "values": values}

    def array(self, stamp_ns: int) -> Plain:
        """Plain DiagnosticArray that holds the one status."""
        return {"header": header("", stamp_ns), "status": [self.status()]}
