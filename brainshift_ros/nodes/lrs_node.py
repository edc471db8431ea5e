"""Node `lrs`: scans in tracker space -> registration, scans in the patient frame, homologous points."""

from __future__ import annotations

import concurrent.futures
import itertools
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from rclpy.task import Future

from brainshift_ros.correspondence.dense import DenseField
from brainshift_ros.correspondence.guides_file import read_guides
from brainshift_ros.correspondence.tracking import TrackingOptions
from brainshift_ros.errors import InputError
from brainshift_ros.files import Signature, signature_of
from brainshift_ros.graph import DENSE_POINTS, LRS_INITIAL_POSE, LRS_POINTS
from brainshift_ros.mesh.patient_file import read_patient
from brainshift_ros.nodes.base import BrainshiftNode
from brainshift_ros.nodes.health import Level
from brainshift_ros.nodes.held_scans import ArrivedScan, HeldScans
from brainshift_ros.nodes.lrs_output import POINTS, POSE, SCAN, LrsOutput
from brainshift_ros.registration.fiducials import register_fiducials
from brainshift_ros.registration.fiducials_file import read_fiducials
from brainshift_ros.session.planned_area import planned_area
from brainshift_ros.session.session import LrsOptions, LrsSession, LrsUpdate
from brainshift_ros.units import mm_to_m
from brainshift_ros.wire.pose import decode_pose
from brainshift_ros.wire.scan import decode_scan
from brainshift_ros.wire.stamps import ScanStamps

#: Conditions in /diagnostics, beside those of :mod:`brainshift_ros.nodes.lrs_output` and those that bear a topic's name.
PATIENT, FIDUCIALS, STAMPS = "patient file", "fiducials file", "scan stamps"
WAITING = "waiting for an initial pose and a scan"

Value = TypeVar("Value")

#: What a step of the session brought, and the scan that the session had placed last by then.
Step = tuple[LrsUpdate | None, ArrivedScan | None]


class LrsNode(BrainshiftNode):
    """Runs one :class:`LrsSession`: the first scan registers, each later one gives homologous points.

    A first scan that comes before any start of its registration (pose or fiducials) is held for a while, so that the order
    of arrival does not matter; then the cortex is searched without one. Every scan is published in the patient frame as soon
    as it can be. To compare it with the first takes longer: of the scans that wait for that, only the newest is compared.
    The session is touched in the worker thread only.
    """

    def __init__(self) -> None:
        super().__init__("lrs")
        self._declare()
        self._session: LrsSession | None = None
        self._newest: ArrivedScan | None = None  # what the session placed last; worker thread only
        self._tried: dict[str, Signature | None] = {}
        self._jobs = itertools.count()
        self._case = 0
        self._output = LrsOutput(self)
        self._begin_case()
        self._load_patient()
        self.take(LRS_POINTS, self._decode, self._on_scan)
        self.take(LRS_INITIAL_POSE, decode_pose, self._on_pose)
        self.serve("reset", self._reset)
        self.serve("guide", self._guide)
        self.serve("dense", self._dense)

    def _declare(self) -> None:
        self._patient_file = self.parameter(
            "patient_file", "", "path of the patient file (HDF5) that `brainshift patient` made"
        )
        self._scene_file = self.parameter(
            "scene_file", "", "path of the scene (YAML) whose craniotomy narrows the search; empty: search the whole cortex"
        )
        self._fiducials_file = self.parameter(
            "fiducials_file", "", "path of the paired fiducials (YAML, mm) that start the registration; empty: none"
        )
        self._guides_file = self.parameter(
            "guides_file", "", "path of the marks (YAML, pixels) that ~/guide reads when it is called; empty: none"
        )
        waits = "s that a first scan waits for a pose before the cortex is searched for it; below 0: it waits for ever"
        self._search_after_s = self.parameter("search_after_s", 3.0, waits, (-1.0, 3600.0))
        error = "mm, RMS error of the scanner's tracked position; a part of every point's sigma"
        self._tracker_mm = self.parameter("tracker_mm", TrackingOptions.tracker_mm, error, (0.0, 5.0))
        self._dense_spacing_mm = self.parameter(
            "dense_spacing_mm", 2.0, "mm between the points that ~/dense publishes", (1.0, 20.0)
        )

    def _begin_case(self) -> None:
        self._start_known = self._searching = False
        self._held = HeldScans()
        self._stamps = ScanStamps()
        self._output.begin_case()

    def tick(self) -> None:
        """Try files that could not be read again when they change; search for a scan that has waited long enough."""
        if self._session is None:
            if self._has_changed(self._patient_file) or self._has_changed(self._scene_file):
                self._load_patient()
        elif not self._start_known and self._has_changed(self._fiducials_file):
            self._load_fiducials()
        waited = 0.0 <= self._search_after_s <= self._held.waited_s()
        if self._held and waited and not (self._start_known or self._searching or self._output.registered):
            self._searching = True
            self._do_without_fiducials()
            self.report(SCAN, Level.WARN, f"no {LRS_INITIAL_POSE.name} has come: searching the cortex for the scan")
            self._place(self._held.take_first(), search=True)

    # Files.

    def _has_changed(self, path: str) -> bool:
        return bool(path) and signature_of(path) != self._tried.get(path)

    def _load_patient(self) -> None:
        for path in (self._patient_file, self._scene_file):
            self._tried[path] = signature_of(path)
        self.report(PATIENT, Level.WARN, f"loading {self._patient_file}")

        def then(_: None) -> None:
            self.report(PATIENT, Level.OK, f"{self._patient_file} is loaded")
            self._load_fiducials()

        self.work(PATIENT, self._open, then)

    def _open(self) -> None:
        if not self._patient_file:
            remedy = "start the node with -p patient_file:=PATH, or `brainshift run --patient PATH`"
            raise InputError("patient_file", "is not set", remedy)
        if self._session is None:
            near = planned_area(self._scene_file) if self._scene_file else None
            options = LrsOptions(tracking=TrackingOptions(tracker_mm=self._tracker_mm))
            self._session = LrsSession(read_patient(self._patient_file).cortex, options, near=near)

    def _load_fiducials(self) -> None:
        path = self._fiducials_file
        if not path or self._session is None:
            return
        self._tried[path] = signature_of(path)
        if self._tried[path] is None:
            self.report(FIDUCIALS, Level.WARN, f"{path}: no such file yet; a pose or a search will do as well")
            return

        def step(session: LrsSession) -> LrsUpdate:
            given = read_fiducials(path)
            return session.set_fiducials(register_fiducials(given.tracker, given.patient, given.fle_m))

        def then(found: Step) -> None:
            self._on_start(found)
            update, _ = found
            assert update is not None
            figures = update.diagnostics
            errors = f"FRE {figures['fre_mm']:.2f} mm, predicted TRE {figures['fiducials_predicted_tre_mm']:.2f} mm"
            self.report(FIDUCIALS, Level.OK, f"{path}: {errors}")
            self._release()

        self._run(FIDUCIALS, step, then)

    def _do_without_fiducials(self) -> None:
        """Report a missing file no longer once something else starts the registration; one that is wrong stays a fault."""
        path = self._fiducials_file
        if path and self._tried.get(path) is None:
            self.report(FIDUCIALS, Level.OK, f"{path}: no such file, and none is needed")

    # What arrives.

    def _decode(self, message: Any) -> ArrivedScan:
        return ArrivedScan(decode_scan(message), self.arrived_s, time.perf_counter())

    def _on_scan(self, arrived: ArrivedScan) -> None:
        admitted = self._stamps.admit(arrived.scan, self.now_ns())
        self.report(STAMPS, Level.WARN if admitted.warnings else Level.OK, "; ".join(admitted.warnings) or "in order")
        if admitted.duplicate:
            return
        self._output.count("scans_received")
        if self._start_known or self._output.registered:
            self._place(arrived)
            return
        if self._held.add(arrived):
            self._output.count("scans_displaced")
        self.report(SCAN, Level.WARN, f"{len(self._held)} scans wait for {LRS_INITIAL_POSE.name}")

    def _on_pose(self, T_patient_tracker: NDArray[np.float64]) -> None:
        self._do_without_fiducials()
        self._run(POSE, lambda session: session.set_initial_pose(T_patient_tracker), self._on_start)
        self._release()

    def _on_start(self, found: Step) -> None:
        """Take what a pose or fiducials brought: nothing yet, a scan that was refused before, or a disagreement."""
        update, arrived = found
        warnings = () if update is None or update.registered is not None else update.warnings
        refused = update is not None and update.registration is not None and not update.registration.accepted
        if not refused:
            self.report(POSE, Level.WARN if warnings else Level.OK, "; ".join(warnings) or "known")
        if update is not None and self._output.publish(update, arrived):
            self._compare()

    def _release(self) -> None:
        """Hand on the scans that were held until the registration has a start."""
        self._start_known = True
        self._place_held()

    def _place_held(self) -> None:
        for arrived in self._held.take_all():
            self._place(arrived)

    # Steps of the session.

    def _place(self, arrived: ArrivedScan, *, search: bool = False) -> None:
        """Register a scan, or move it by the registration; no scan that waits for this gives way to another."""

        def step(session: LrsSession) -> LrsUpdate:
            begun_s = time.perf_counter()
            self._newest = arrived
            update = session.place(arrived.scan)
            if search:
                update = session.search() or update
            times = {"decode": arrived.decoded_s - arrived.arrived_s, "wait": begun_s - arrived.decoded_s}
            return replace(update, times_s={**times, **update.times_s})

        def then(found: Step) -> None:
            update, placed = found
            assert update is not None
            if self._output.publish(update, placed):
                self._compare()
                self._place_held()

        def ended() -> None:
            self._searching &= not search

        self._run(SCAN, step, then, ended=ended)

    def _compare(self) -> None:
        """Prepare the first scan, or find its points in the newest later one."""

        def then(found: Step) -> None:
            update, compared = found
            if update is not None:
                self._output.publish(update, compared)

        self._run(POINTS, lambda session: session.compare(), then, key="compare")

    def _run(
        self,
        condition: str,
        step: Callable[[LrsSession], LrsUpdate | None],
        then: Callable[[Step], None],
        *,
        key: str = "",
        ended: Callable[[], None] = lambda: None,
    ) -> None:
        """Do a step of the session in the worker thread and `then` in this one, unless the case is over by then.

        `ended` is called first, whatever came of it. A waiting step gives way to a newer one only where both have a key.
        """
        case = self._case

        def job() -> Step:
            return (step(self._ready()), self._newest) if case == self._case else (None, None)

        def done(future: concurrent.futures.Future[Step]) -> None:
            if case == self._case:
                ended()
                self.guarded(condition, lambda: then(future.result()))

        self.worker.submit(key or f"step {next(self._jobs)}", job, done)

    def _ready(self) -> LrsSession:
        if self._session is None:
            raise InputError("patient_file", "is not loaded", f"see the condition '{PATIENT}' of this node")
        return self._session

    # Services.

    def _reset(self, _: Any, response: Any) -> Any:
        """Forget pose, scans and registration: the next case begins. A scan at work is finished, but not published."""
        self._case += 1
        self._begin_case()
        self._output.withdraw()
        self.work(SCAN, self._forget, lambda _: None, key="reset")
        self._load_fiducials()
        self.report(STAMPS, Level.OK, "none in this case")
        self.report(SCAN, Level.OK, WAITING)
        response.success, response.message = True, WAITING
        return response

    def _forget(self) -> None:
        self._newest = None
        if self._session is not None:
            self._session.reset()

    async def _guide(self, _: Any, response: Any) -> Any:
        """Read the guides file and compare the newest later scan again, guided by it."""

        def step(session: LrsSession) -> LrsUpdate:
            if not self._guides_file:
                raise InputError("guides_file", "is not set", "start the node with -p guides_file:=PATH")
            return session.set_guides(read_guides(self._guides_file))

        def then(update: LrsUpdate, compared: ArrivedScan | None) -> str:
            self._output.publish(update, compared)
            return f"{update.diagnostics['homologous_points']:.0f} homologous points"

        return await self._answer(response, step, then)

    async def _dense(self, _: Any, response: Any) -> Any:
        """Interpolate the homologous points over the craniotomy and publish the field."""

        def then(field: DenseField, compared: ArrivedScan | None) -> str:
            assert compared is not None
            self._output.dense(field, compared.scan.stamp_ns)
            return "; ".join((f"{len(field.points)} points on {DENSE_POINTS.name}", *field.warnings))

        spacing_m = float(mm_to_m(self._dense_spacing_mm))
        return await self._answer(response, lambda session: session.dense(spacing_m), then)

    async def _answer(
        self,
        response: Any,
        step: Callable[[LrsSession], Value],
        then: Callable[[Value, ArrivedScan | None], str],
    ) -> Any:
        """Answer a service by a step of the session, in the worker thread; the executor serves everything else meanwhile."""
        case = self._case
        finished: Future[concurrent.futures.Future[tuple[Value, ArrivedScan | None]]] = Future(executor=self.executor)
        self.worker.submit(f"step {next(self._jobs)}", lambda: (step(self._ready()), self._newest), finished.set_result)
        result = await finished
        assert result is not None
        try:
            found = result.result()
            if case != self._case:
                raise InputError("lrs", "the case was reset meanwhile", "call again when this case has points")
            response.success, response.message = True, then(*found)
        except Exception as error:  # whatever happened, the caller waits for an answer
            response.success, response.message = False, str(error)
            if not isinstance(error, InputError):
                self.get_logger().error(traceback.format_exc())
        return response
