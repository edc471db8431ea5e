"""The case of node `inverse`: which inputs are the newest, what is published of them, and what is out of date.

There is no ROS here: the node lends its publishers, its worker and its clock as a :class:`Host`, and so do tests.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from brainshift_ros.graph import DISPLACEMENT_FIELD, DISPLACEMENT_MARKERS, SHIFT_ESTIMATE, Topic
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.inverse.shift_estimate import SCHEMA, ShiftEstimate
from brainshift_ros.nodes.health import Health, Level
from brainshift_ros.nodes.opened_atlas import OpenedAtlas, open_announced
from brainshift_ros.solvers.threads import one_blas_thread
from brainshift_ros.wire.markers import displacement_markers, no_markers
from brainshift_ros.wire.plain import NS_PER_S, Plain
from brainshift_ros.wire.retraction import RetractionColumns
from brainshift_ros.wire.texts import AtlasInfo, PublishedField, ShiftEstimateText, TextStamp, encode_text
from brainshift_ros.wire.vectors import StampedPoints, encode_field

ATLAS = "atlas"
ESTIMATE = "estimate"
RETRACTION = "retraction"

Value = TypeVar("Value")


class Host(Protocol):
    """What the case needs of its node; :class:`~brainshift_ros.nodes.base.BrainshiftNode` says what each does."""

    health: Health
    #: When the message that is being handled arrived, by ``time.perf_counter``.
    arrived_s: float

    def give(self, topic: Topic, plain: Plain) -> None:
        """Publish."""

    def withdraw(self, topic: Topic) -> None:
        """Take back what a latched topic carried."""

    def report(self, condition: str, level: Level, message: str) -> None:
        """Set a condition of the node's health."""

    def work(
        self,
        condition: str,
        job: Callable[[], Value],
        then: Callable[[Value], None],
        *,
        wanted: Callable[[], bool],
        otherwise: Callable[[str], None],
    ) -> None:
        """Run a job in the background; a waiting one of the same condition is replaced."""

    def now_ns(self) -> int:
        """Read the clock."""


@dataclass(frozen=True)
class Announced:
    """An atlas that was announced, and when."""

    info: AtlasInfo
    received_ns: int


@dataclass(frozen=True)
class Retraction:
    """Columns that were solved during surgery, and when they came."""

    columns: RetractionColumns
    received_ns: int


@dataclass(frozen=True)
class Request:
    """The inputs of one estimate; it is published only while its request is still the newest.

    Attributes
    ----------
    announced, atlas, measured, retraction
        The newest of each.
    arrived_s
        When the message that completed them arrived, by ``time.perf_counter``.
    """

    announced: Announced
    atlas: OpenedAtlas
    measured: StampedPoints
    retraction: Retraction | None
    arrived_s: float


@dataclass(frozen=True)
class Published:
    """What the latched displacement field holds, and what it was made from."""

    request: Request
    estimate: ShiftEstimate


def solve(request: Request, options: InverseOptions) -> ShiftEstimate:
    """Estimate the shift of a request.

    Raises
    ------
    InputError
        The atlas's file has changed, or the inputs cannot be used.
    """
    atlas = request.atlas
    atlas.check_unchanged()
    columns = None if request.retraction is None else request.retraction.columns.columns
    points = request.measured.points
    with one_blas_thread():  # the matrices are small, and lrs and a display compute beside this
        return estimate_shift(atlas.file, points, retraction=columns, options=options, locator=atlas.locator, span=atlas.span)


class InverseCase:
    """Estimates as soon as both an atlas and points are there, in whatever order they arrive; the newest inputs win.

    Nothing of one patient reaches the next: an empty cloud of points, or an atlas of another patient, takes back the points
    and all that was published from them. Within a case the last valid field stays, since an older update still guides better
    than none; but every `shift_estimate` says which field that is and whether it is current, and its arrows turn grey when
    it is not.

    Parameters
    ----------
    host
        The node.
    options
        Settings of the inverse model.
    arrows
        Most arrows in `displacement_markers`.
    open_atlas, solve_request
        Called in the worker thread.
    """

    def __init__(
        self,
        host: Host,
        options: InverseOptions,
        arrows: int,
        *,
        open_atlas: Callable[[AtlasInfo], OpenedAtlas] = open_announced,
        solve_request: Callable[[Request, InverseOptions], ShiftEstimate] = solve,
    ) -> None:
        self._host, self._options, self._arrows = host, options, arrows
        self._open, self._solve = open_atlas, solve_request
        self._announced: Announced | None = None
        self._atlas: OpenedAtlas | None = None
        self._atlas_fault: str | None = None  # why the announced atlas could not be opened
        self._measured: StampedPoints | None = None
        self._retraction: Retraction | None = None
        self._request: Request | None = None
        #: The displacement field that is latched; None if there is none.
        self.published: Published | None = None
        #: Counts the cases: it changes when points and results are taken back.
        self.number = 0
        self._estimates = 0
        self._drawn_as_current = False
        host.report(ESTIMATE, Level.OK, "waiting for an atlas and homologous points")

    @property
    def current(self) -> bool:
        """Whether the published field was made from the newest inputs."""
        return self.published is not None and self.published.request is self._request

    # Inputs.

    def announce(self, info: AtlasInfo) -> None:
        """Take an announcement of `atlas/info`."""
        earlier, announced = self._announced, Announced(info, self._host.now_ns())
        self._announced = announced
        if earlier is not None and earlier.info.patient_id != info.patient_id:
            self._forget_case()  # the points were measured on the earlier patient
            if self._retraction is not None and self._retraction.columns.patient_id != info.patient_id:
                self._retraction = None  # columns that do not say whose they are were the earlier patient's
        self._atlas = self._atlas_fault = self._request = None
        self._host.work(
            ATLAS,
            lambda: self._open(info),
            self._use,
            wanted=lambda: announced is self._announced,
            otherwise=self._do_without,
        )

    def measure(self, measured: StampedPoints | None) -> None:
        """Take homologous points; None takes the earlier ones back."""
        if measured is None:
            self._forget_case()
        self._measured = measured
        self._estimate()

    def retract(self, columns: RetractionColumns) -> None:
        """Take the columns of a retraction; none takes an earlier one back."""
        self._retraction = Retraction(columns, self._host.now_ns()) if len(columns.columns) else None
        self._estimate()

    # From inputs to an estimate.

    def _use(self, atlas: OpenedAtlas) -> None:
        self._atlas = atlas
        self._host.report(ATLAS, Level.OK, f"atlas {atlas.info.atlas_id[:12]} is open")
        self._estimate()

    def _do_without(self, fault: str) -> None:
        self._atlas_fault = fault
        self._refuse(fault)

    def _estimate(self) -> None:
        if self._atlas_fault is not None:
            self._refuse(self._atlas_fault)
        if self._atlas is None or self._measured is None or self._announced is None:
            missing = "an atlas" if self._atlas is None else "homologous points"
            self._host.report(ESTIMATE, Level.OK, f"waiting for {missing}")
            return
        request = Request(self._announced, self._atlas, self._measured, self._fitting_retraction(), self._host.arrived_s)
        self._request = request
        self._host.work(
            ESTIMATE,
            lambda: self._solve(request, self._options),
            lambda estimate: self._publish(request, estimate),
            wanted=lambda: request is self._request,
            otherwise=self._refuse,
        )

    def _fitting_retraction(self) -> Retraction | None:
        """Return the newest retraction, unless it was solved for another patient."""
        found, atlas = self._retraction, self._atlas
        assert atlas is not None
        if found is not None and found.columns.patient_id not in ("", atlas.info.patient_id):
            whose = f"patient {found.columns.patient_id[:12]}, the atlas is of {atlas.info.patient_id[:12]}"
            self._host.report(RETRACTION, Level.WARN, f"the retraction is left out: it was solved for {whose}")
            return None
        self._host.report(RETRACTION, Level.OK, f"{0 if found is None else len(found.columns.columns)} columns are in use")
        return found

    # From an estimate to what is published.

    def _publish(self, request: Request, estimate: ShiftEstimate) -> None:
        request.atlas.check_unchanged()
        if not estimate.valid:
            # A field that failed its gates must not reach a display.
            self._say(request, estimate.to_json(), times_s=estimate.times_s)
            self._outdate()
            self._host.report(ESTIMATE, Level.ERROR, f"{ESTIMATE}: refused: {'; '.join(estimate.reasons)}")
            return
        self._host.give(DISPLACEMENT_FIELD, encode_field(estimate.field, request.measured.stamp_ns))
        message_to_field = time.perf_counter() - request.arrived_s
        self.published = Published(request, estimate)
        self._say(request, estimate.to_json(), times_s={**estimate.times_s, "message_to_field": message_to_field})
        self._draw()
        if estimate.warnings:
            self._host.report(ESTIMATE, Level.WARN, f"{ESTIMATE}: {'; '.join(estimate.warnings)}")
        else:
            self._host.report(ESTIMATE, Level.OK, "a displacement field is published")

    def _refuse(self, fault: str) -> None:
        """Say in `shift_estimate`, too, that the newest inputs gave nothing."""
        announced, measured = self._announced, self._measured
        if announced is None or measured is None:
            return
        content = {
            "schema": SCHEMA,
            "valid": False,
            "reasons": [fault],
            "atlas_id": announced.info.atlas_id,
            "patient_id": announced.info.patient_id,
        }
        self._tell(content, announced, measured)
        self._outdate()

    def _say(self, request: Request, content: dict[str, Any], times_s: dict[str, float]) -> None:
        self._tell({**content, "times_s": times_s}, request.announced, request.measured, request.retraction)
        self._estimates += 1
        times = {f"time_{stage}_s": f"{seconds:.4f}" for stage, seconds in times_s.items()}
        self._host.health.report({"estimates": self._estimates, **times})

    def _tell(
        self, content: dict[str, Any], announced: Announced, measured: StampedPoints, retraction: Retraction | None = None
    ) -> None:
        """Publish a `shift_estimate`, valid or not, with its inputs and the field that is published beside it."""
        now_ns = self._host.now_ns()
        received_ns = {"atlas": announced.received_ns, "points": measured.stamp_ns}
        if retraction is not None:
            received_ns["retraction"] = retraction.received_ns
        text = {
            **content,
            "ids": {
                "atlas": content["atlas_id"],
                "patient": content["patient_id"],
                "points": content.get("points_sha256") or "",
                "retraction": content.get("retraction_sha256") or "",
            },
            "stamp": TextStamp.of(measured.stamp_ns),
            "ages_s": {name: (now_ns - then_ns) / NS_PER_S for name, then_ns in received_ns.items()},
            "displacement_field": self._latched(),
        }
        self._host.give(SHIFT_ESTIMATE, encode_text(ShiftEstimateText.model_validate(text)))

    def _latched(self) -> PublishedField | None:
        if self.published is None:
            return None
        request, estimate = self.published.request, self.published.estimate
        return PublishedField(
            stamp=TextStamp.of(request.measured.stamp_ns),
            points=estimate.points_sha256,
            atlas=estimate.atlas_id,
            current=self.current,
        )

    def _outdate(self) -> None:
        """Show that the field on display is not of the newest inputs."""
        if self._drawn_as_current:
            self._draw()

    def _draw(self) -> None:
        assert self.published is not None
        field, stamp_ns = self.published.estimate.field, self.published.request.measured.stamp_ns
        skull = field.mesh.facets["skull"]
        arrows = displacement_markers(field.mesh.nodes, skull, field.displacement, self._arrows, stamp_ns, current=self.current)
        self._host.give(DISPLACEMENT_MARKERS, arrows)
        self._drawn_as_current = self.current

    def _forget_case(self) -> None:
        self.number += 1
        self._measured = self._request = self.published = None
        self._drawn_as_current = False
        self._host.withdraw(DISPLACEMENT_FIELD)
        self._host.withdraw(SHIFT_ESTIMATE)
        # A display keeps what it has got, so its arrows must be deleted, not only withheld from late joiners.
        self._host.give(DISPLACEMENT_MARKERS, no_markers(self._host.now_ns()))
