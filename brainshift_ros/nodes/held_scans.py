"""Scans that have come before it is known where their registration starts."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

from brainshift_ros.registration.scan import OrganisedScan


@dataclass(frozen=True)
class ArrivedScan:
    """A scan, and when its message arrived and was decoded, by ``time.perf_counter``."""

    scan: OrganisedScan
    arrived_s: float
    decoded_s: float


@dataclass
class HeldScans:
    """The first scan of those that wait, and the newest: of later scans only the newest is worth its memory.

    Parameters
    ----------
    clock
        Seconds, from whenever.
    """

    clock: Callable[[], float] = time.monotonic
    _scans: list[ArrivedScan] = field(default_factory=list)
    _since_s: float = 0.0

    def __len__(self) -> int:
        return len(self._scans)

    def add(self, arrived: ArrivedScan) -> bool:
        """Hold a scan; True if that displaces one."""
        if not self._scans:
            self._since_s = self.clock()
        displaces = len(self._scans) == 2
        self._scans = [*self._scans[:1], arrived]
        return displaces

    def waited_s(self) -> float:
        """How long the first of them has waited; 0 where none waits."""
        return self.clock() - self._since_s if self._scans else 0.0

    def take_first(self) -> ArrivedScan:
        """Hand out the first scan; a scan that stays begins to wait now."""
        self._since_s = self.clock()
        return self._scans.pop(0)

    def take_all(self) -> list[ArrivedScan]:
        """Hand out all scans, first come first."""
        scans, self._scans = self._scans, []
        return scans
