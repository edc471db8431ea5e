"""What node `lrs` gives: each step of its session as messages and conditions."""

from __future__ import annotations

import time
from collections.abc import Mapping

from brainshift_ros.correspondence.dense import DenseField
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.graph import DENSE_POINTS, HOMOLOGOUS_POINTS, LRS_POINTS, LRS_REGISTERED, REGISTRATION
from brainshift_ros.nodes.base import BrainshiftNode
from brainshift_ros.nodes.health import Level
from brainshift_ros.nodes.held_scans import ArrivedScan
from brainshift_ros.registration.result import RegistrationResult
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.session.session import LrsUpdate
from brainshift_ros.wire.pose import encode_transform
from brainshift_ros.wire.scan import encode_registered
from brainshift_ros.wire.vectors import encode_homologous, encode_withdrawal

#: Conditions in /diagnostics, beside those that bear a topic's name.
SCAN, POSE, POINTS = "scan", "pose", "homologous points"


class LrsOutput:
    """Publishes for a node.

    Parameters
    ----------
    node
        Declared to give the topics of `lrs`.
    """

    def __init__(self, node: BrainshiftNode) -> None:
        self._node = node
        self.begin_case()

    def begin_case(self) -> None:
        """Count anew."""
        self._registration: RegistrationResult | None = None
        self._dense_given = False
        self._counts = dict.fromkeys(("scans_received", "scans_registered", "scans_compared", "scans_displaced"), 0)
        self._node.health.forget_figures()
        self._node.health.report(self._counts)

    @property
    def registered(self) -> bool:
        """Whether a registration was published in this case."""
        return self._registration is not None

    def withdraw(self) -> None:
        """Take back what was latched: nobody who joins now shall take the last case for the next.

        An empty cloud of homologous points tells `inverse` to do the same.
        """
        self._node.withdraw(REGISTRATION)
        self._node.give(HOMOLOGOUS_POINTS, encode_withdrawal(self._node.now_ns()))
        self._withdraw_dense()
        for condition in (POSE, POINTS):
            self._node.report(condition, Level.OK, "none in this case")

    def count(self, name: str) -> None:
        """Count a scan in the diagnostics."""
        self._counts[name] += 1
        self._node.health.report(self._counts)

    def publish(self, update: LrsUpdate, arrived: ArrivedScan | None) -> bool:
        """Publish what a step of the session brought; True if a scan was newly placed in the patient frame.

        Parameters
        ----------
        update
            The step's outcome.
        arrived
            The scan that the session placed last, which the update's scan and points belong to.
        """
        self._node.health.report(update.diagnostics)
        self._report_times(update.times_s)
        if update.registration is not None and not update.registration.accepted:
            self._node.report(SCAN, Level.ERROR, f"{SCAN}: {'; '.join(update.warnings)}")
            return False
        if update.registered is not None and arrived is not None:
            self._cloud(update, update.registered, arrived)
        if update.homologous is not None and arrived is not None:
            self._points(update, update.homologous, arrived)
        return update.registered is not None

    def dense(self, field: DenseField, stamp_ns: int) -> None:
        """Publish a dense field, its standard deviations raised so that its points may be weighed as independent ones."""
        self._node.give(DENSE_POINTS, encode_homologous(field.as_independent_points(), stamp_ns, DENSE_POINTS))
        self._dense_given = True

    def _cloud(self, update: LrsUpdate, registered: OrganisedScan, arrived: ArrivedScan) -> None:
        assert update.registration is not None
        if update.registration is not self._registration:
            self._node.give(REGISTRATION, encode_transform(update.registration.T_patient_tracker, registered.stamp_ns))
            self._registration = update.registration
        begun_s = time.perf_counter()
        self._node.give(LRS_REGISTERED, encode_registered(registered))
        now_s = time.perf_counter()
        self._report_times({"encode": now_s - begun_s, "message_to_registered": now_s - arrived.arrived_s})
        self.count("scans_registered")
        self._report(SCAN, update.registration.warnings, "in the patient frame")

    def _points(self, update: LrsUpdate, measured: HomologousPoints, arrived: ArrivedScan) -> None:
        if len(measured.points) == 0:
            remedy = "scan the same field again, or mark pairs in a guides file and call ~/guide"
            raise InputError(LRS_POINTS.name, "shows no vessel of the first scan again", remedy)
        if self._dense_given:
            self._withdraw_dense()  # it belongs to points that no longer count
        self._node.give(HOMOLOGOUS_POINTS, encode_homologous(measured, arrived.scan.stamp_ns))
        self._report_times({"message_to_points": time.perf_counter() - arrived.arrived_s})
        self.count("scans_compared")
        self._report(POINTS, update.warnings, f"{len(measured.points)} published")

    def _withdraw_dense(self) -> None:
        self._node.withdraw(DENSE_POINTS)
        self._dense_given = False

    def _report(self, condition: str, warnings: tuple[str, ...], otherwise: str) -> None:
        text = f"{condition}: {'; '.join(warnings)}" if warnings else otherwise
        self._node.report(condition, Level.WARN if warnings else Level.OK, text)

    def _report_times(self, times_s: Mapping[str, float]) -> None:
        self._node.health.report({f"time_{stage}_s": f"{seconds:.3f}" for stage, seconds in times_s.items()})
