"""The order of a case's scans by their stamps: what came twice, too early or from another day is told apart.

Nothing is computed from a stamp, so a clock that is merely wrong, or none at all, is reported and the scan used in its order of
arrival. What would mix up that order, on which the meaning of "first" and "later" rests, is refused.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import numpy as np

from brainshift_ros.errors import InputError
from brainshift_ros.graph import LRS_POINTS, Topic
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.wire.plain import NS_PER_S

#: A scan that claims to be from later than this after the node's clock: the two clocks do not agree.
FUTURE_LIMIT_S = 3600.0
#: No surgery lasts this long: scans farther apart belong to different cases.
CASE_LIMIT_S = 86_400.0


@dataclass(frozen=True)
class Arrival:
    """What is to be done with a scan.

    Attributes
    ----------
    duplicate
        It has come before in this case, and other scans since: pass it over.
    warnings
        What a person should know.
    """

    duplicate: bool
    warnings: tuple[str, ...] = ()


@dataclass
class ScanStamps:
    """Stamps and checksums of the scans of one case, in order of arrival.

    Parameters
    ----------
    topic
        Where the scans come from, for messages.
    """

    topic: Topic = LRS_POINTS
    _checksums: dict[int, int] = field(default_factory=dict)

    def reset(self) -> None:
        """Begin the next case: its scans may be older than those of this one, as in a replayed bag."""
        self._checksums.clear()

    def admit(self, scan: OrganisedScan, now_ns: int | None = None) -> Arrival:
        """Take a scan into the case.

        Parameters
        ----------
        scan
            The scan.
        now_ns
            The node's clock, nanoseconds since the epoch; None or 0 where there is none.

        Raises
        ------
        InputError
            Its stamp lies before that of an earlier scan or more than a day after it. The case goes on as if it had not come.
        """
        stamp = scan.stamp_ns
        if stamp == 0:
            return Arrival(False, ("its stamp is zero: scans are taken in their order of arrival",))
        checksum = 0
        for array in (scan.points, scan.rgb):
            checksum = zlib.crc32(np.ascontiguousarray(array).data, checksum)
        known, newest = self._checksums.get(stamp), max(self._checksums, default=0)
        if known == checksum and stamp < newest:
            return Arrival(True, ("the same scan came before in this case and is passed over; call ~/reset to begin again",))
        if known == checksum:
            return Arrival(False, ("the same scan came twice in a row; compared with itself nothing moves",))
        if stamp == newest:
            self._checksums[stamp] = checksum
            return Arrival(False, ("its stamp is that of the scan before: scans are taken in their order of arrival",))
        if self._checksums:
            since_s = (stamp - newest) / NS_PER_S
            if since_s < 0.0:
                problem = f"its stamp lies {-since_s:.3f} s before that of an earlier scan of this case"
                raise InputError(self.topic.name, problem, "send scans in their order, or call ~/reset to begin the next case")
            if since_s > CASE_LIMIT_S:
                problem = f"its stamp lies {since_s / 3600.0:.0f} h after the scan before"
                raise InputError(self.topic.name, problem, "call ~/reset to begin the next case")
        self._checksums[stamp] = checksum
        ahead_s = (stamp - now_ns) / NS_PER_S if now_ns else 0.0
        if ahead_s > FUTURE_LIMIT_S:
            return Arrival(False, (f"its stamp lies {ahead_s / 3600.0:.1f} h in the future of this node's clock",))
        return Arrival(False)
