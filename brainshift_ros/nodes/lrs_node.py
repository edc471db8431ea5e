"""Node `lrs`: scans in tracker space -> registration, scans in the patient frame, homologous points."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.correspondence.session import LrsSession, LrsUpdate
from brainshift_ros.errors import InputError
from brainshift_ros.files import Signature, signature_of
from brainshift_ros.graph import HOMOLOGOUS_POINTS, LRS_INITIAL_POSE, LRS_POINTS, LRS_REGISTERED, REGISTRATION
from brainshift_ros.mesh.patient_file import read_patient
from brainshift_ros.nodes.base import BrainshiftNode
from brainshift_ros.nodes.health import Level
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.wire.pose import decode_pose, encode_transform
from brainshift_ros.wire.scan import decode_scan, encode_registered
from brainshift_ros.wire.vectors import encode_homologous, encode_withdrawal

PATIENT = "patient file"
SCAN = "scan"


class LrsNode(BrainshiftNode):
    """Runs one :class:`LrsSession`: the first scan registers, each later one gives homologous points.

    Scans that come before the initial pose are held, so that the order of arrival does not matter. Of the scans that wait,
    the first is never dropped; a later one gives way to a newer one. The session is touched in the worker thread only.
    """

    def __init__(self) -> None:
        super().__init__("lrs")
        self._path = self.parameter("patient_file", "", "path of the patient file (HDF5) that `brainshift patient` made")
        self._session: LrsSession | None = None
        self._tried: Signature | None = None
        self._pose_known = False
        self._held: list[OrganisedScan] = []
        self._submitted = 0
        self._case = 0
        self._load()
        self.take(LRS_POINTS, decode_scan, self._on_scan)
        self.take(LRS_INITIAL_POSE, decode_pose, self._on_pose)
        self.serve("reset", self._reset)

    def tick(self) -> None:
        """Try a patient file that could not be read again when it changes; one that is in use is kept."""
        if self._path and self._session is None and signature_of(self._path) != self._tried:
            self._load()

    def _load(self) -> None:
        self._tried = signature_of(self._path)
        self.report(PATIENT, Level.WARN, f"loading {self._path}")
        self.work(PATIENT, self._open, lambda _: self.report(PATIENT, Level.OK, f"{self._path} is loaded"))

    def _open(self) -> None:
        if not self._path:
            remedy = "start the node with -p patient_file:=PATH, or `brainshift run --patient PATH`"
            raise InputError("patient_file", "is not set", remedy)
        if self._session is None:
            self._session = LrsSession(read_patient(self._path).cortex)

    def _ready(self) -> LrsSession:
        if self._session is None:
            raise InputError("patient_file", "is not loaded", f"see the condition '{PATIENT}' of this node")
        return self._session

    def _on_pose(self, T_patient_tracker: NDArray[np.float64]) -> None:
        self._pose_known = True
        self._run("pose", lambda session: session.set_initial_pose(T_patient_tracker))
        for scan in self._held:
            self._submit(scan)
        self._held.clear()

    def _on_scan(self, scan: OrganisedScan) -> None:
        if self._pose_known:
            self._submit(scan)
            return
        self._held = [*self._held[:1], scan]
        self.report(SCAN, Level.WARN, f"{len(self._held)} scans wait for {LRS_INITIAL_POSE.name}")

    def _submit(self, scan: OrganisedScan) -> None:
        key = "later scan" if self._submitted else "first scan"
        self._submitted += 1
        self._run(key, lambda session: session.add_scan(scan))

    def _run(self, key: str, step: Callable[[LrsSession], LrsUpdate | None]) -> None:
        """Do a step of the session in the worker thread and publish what it brings, unless the case is over by then."""
        case = self._case
        self.work(
            SCAN,
            lambda: step(self._ready()) if case == self._case else None,
            lambda update: self._publish(update) if case == self._case else None,
            key=key,
        )

    def _publish(self, update: LrsUpdate | None) -> None:
        if update is None:
            return  # a pose, and no scan that waited for it
        self.health.report(update.diagnostics)
        self.health.report({f"time_{stage}_s": f"{seconds:.3f}" for stage, seconds in update.times_s.items()})
        if update.registration is None or update.registered is None:
            self.report(SCAN, Level.ERROR, f"{SCAN}: {'; '.join(update.warnings)}")
            return
        stamp_ns = update.registered.stamp_ns
        if update.homologous is None:
            self.give(REGISTRATION, encode_transform(update.registration.T_patient_tracker, stamp_ns))
        elif len(update.homologous.points) == 0:
            raise InputError(LRS_POINTS.name, "shows no vessel of the first scan again", "scan the same field again")
        else:
            self.give(HOMOLOGOUS_POINTS, encode_homologous(update.homologous, stamp_ns))
        self.give(LRS_REGISTERED, encode_registered(update.registered))
        if update.warnings:
            self.report(SCAN, Level.WARN, f"{SCAN}: {'; '.join(update.warnings)}")
        else:
            self.report(SCAN, Level.OK, str(update.diagnostics.get("state", "processed")))

    def _reset(self, _: Any, response: Any) -> Any:
        """Forget pose, scans and registration: the next case begins. A scan at work is finished, but not published.

        What was latched is taken back, so that nobody who joins now takes the last case for the next; an empty cloud tells
        `inverse` to do the same.
        """
        self._case += 1
        self._held.clear()
        self._pose_known = False
        self._submitted = 0
        self.withdraw(REGISTRATION)
        self.give(HOMOLOGOUS_POINTS, encode_withdrawal(self.now_ns()))
        self.work(SCAN, self._forget, lambda _: None, key="reset")
        self.report(SCAN, Level.OK, "waiting for an initial pose and a scan")
        response.success, response.message = True, "waiting for an initial pose and a scan"
        return response

    def _forget(self) -> None:
        if self._session is not None:
            self._session.reset()
