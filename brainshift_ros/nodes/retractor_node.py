"""Node `retractor`: checks blade and displacement, and says plainly that this version has no retraction model."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.graph import RETRACTOR_BLADE, RETRACTOR_DISPLACEMENT, RETRACTOR_STATUS
from brainshift_ros.nodes.base import BrainshiftNode
from brainshift_ros.nodes.health import Level
from brainshift_ros.units import m_to_mm
from brainshift_ros.wire.retraction import decode_blade, decode_retraction_vector

UNAVAILABLE = "retraction is not available in this version; the atlas gets no retraction columns"


class RetractorNode(BrainshiftNode):
    """Takes a digitised blade and a displacement, answers with a status."""

    def __init__(self) -> None:
        super().__init__("retractor")
        self._corners: NDArray[np.float64] | None = None
        self._push: NDArray[np.float64] | None = None
        self.take(RETRACTOR_BLADE, decode_blade, self._on_blade)
        self.take(RETRACTOR_DISPLACEMENT, decode_retraction_vector, self._on_displacement)
        self.serve("cancel", self._cancel)
        self._tell(Level.OK, "idle", "waiting for a blade and its displacement")

    def _on_blade(self, corners: NDArray[np.float64]) -> None:
        self._corners = corners
        self._answer()

    def _on_displacement(self, push: NDArray[np.float64]) -> None:
        self._push = push
        self._answer()

    def _answer(self) -> None:
        if self._corners is None or self._push is None:
            missing = "blade" if self._corners is None else "displacement"
            self._tell(Level.OK, "idle", f"waiting for the {missing}")
            return
        self._tell(
            Level.WARN,
            "refused",
            UNAVAILABLE,
            corners=str(len(self._corners)),
            displacement_mm=f"{m_to_mm(np.linalg.norm(self._push)):.1f}",
        )
        self._corners = self._push = None

    def _cancel(self, _: Any, response: Any) -> Any:
        self._corners = self._push = None
        self._tell(Level.OK, "idle", "cancelled; waiting for a blade and its displacement")
        response.success, response.message = True, "nothing was running"
        return response

    def _tell(self, level: Level, stage: str, message: str, **values: str) -> None:
        pairs = {"stage": stage, "progress": "0.0", **values}
        self.give(
            RETRACTOR_STATUS,
            {
                "level": bytes([level]),
                "name": "retractor",
                "message": message,
                "hardware_id": "",
                "values": [{"key": key, "value": value} for key, value in pairs.items()],
            },
        )
        self.report("retraction", level, message)
