"""The case of node `inverse` without ROS: whatever comes in whatever order, the newest inputs that belong together count."""

from __future__ import annotations

import json
from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import lru_cache

import jsonschema
import numpy as np
from field_cases import MemoryAtlas
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from ros_cases import box_columns, box_mesh, measured_points

from brainshift_ros.atlas.entry import AtlasEntry
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.graph import DISPLACEMENT_FIELD, DISPLACEMENT_MARKERS, SHIFT_ESTIMATE
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.inverse.shift_estimate import json_schema
from brainshift_ros.nodes.health import Health, Level
from brainshift_ros.nodes.inverse_case import InverseCase
from brainshift_ros.wire.plain import NS_PER_S
from brainshift_ros.wire.retraction import RetractionColumns
from brainshift_ros.wire.texts import AtlasInfo
from brainshift_ros.wire.vectors import StampedPoints

PATIENTS = ("aa" * 32, "bb" * 32)
MARKS = {"good": 0, "invalid": 1, "impossible": 2}
UNREADABLE = "/unreadable.h5"
MOSTLY = st.sampled_from([True, True, False])


class FakeHost:
    """A node's latched topics, background thread and diagnostics; the test says when a job runs and is delivered."""

    def __init__(self):
        self.health = Health("inverse")
        self.arrived_s = 0.0
        self.latched = {}
        self.clock_ns = 0
        self.waiting = OrderedDict()
        self.finished = []

    def give(self, topic, plain):
        self.latched[topic] = plain

    def withdraw(self, topic):
        self.latched.pop(topic, None)

    def report(self, condition, level, message):
        self.health.set(condition, level, message)

    def now_ns(self):
        self.clock_ns += NS_PER_S
        return self.clock_ns

    def work(self, condition, job, then, *, wanted, otherwise):
        self.waiting.pop(condition, None)
        self.waiting[condition] = (condition, job, then, wanted, otherwise)

    def run(self):
        """Run the job that waits longest; what came of it waits for delivery."""
        if self.waiting:
            _, (condition, job, then, wanted, otherwise) = self.waiting.popitem(last=False)
            try:
                outcome = job()
            except InputError as error:
                outcome = error
            self.finished.append((condition, outcome, then, wanted, otherwise))
        return bool(self.finished or self.waiting)

    def deliver(self):
        while self.finished:
            condition, outcome, then, wanted, otherwise = self.finished.pop(0)
            if not wanted():
                continue
            try:
                if isinstance(outcome, InputError):
                    raise outcome
                then(outcome)
            except InputError as error:
                self.report(condition, Level.ERROR, str(error))
                otherwise(str(error))


@dataclass
class FakeAtlas:
    """An open atlas whose file can change."""

    info: AtlasInfo
    changed: bool = False

    def check_unchanged(self):
        if self.changed:
            raise InputError(self.info.path, "has changed since it was announced", "wait")


@lru_cache
def real_estimate():
    """A valid estimate, of which each answer is a variant."""
    mesh = box_mesh(3)
    entries = tuple(AtlasEntry("gravity", (0.0, -1.0, 0.0), 0.5, 0, False) for _ in range(6))
    points = measured_points()
    near = np.argsort(np.linalg.norm(points.points[:, None] - mesh.nodes[None], axis=2).min(axis=1))[:9]
    few = HomologousPoints(points.points[near], points.displacements[near], points.sigma[near] + 5e-3)
    estimate = estimate_shift(MemoryAtlas(mesh, box_columns(mesh), entries, ()), few)
    assert estimate.valid
    return estimate


def answer(request, _options):
    """Stand in for the inverse model: the estimate tells what it was made from; points tell what becomes of them."""
    request.atlas.check_unchanged()
    kind = int(request.measured.points.sigma[0])
    if kind == MARKS["impossible"]:
        raise InputError("homologous points", "none of 1 points lies on the brain", "check the frame")
    reasons = ("the residual is too large",) if kind == MARKS["invalid"] else ()
    columns = request.retraction.columns if request.retraction else None
    return replace(
        real_estimate(),
        reasons=reasons,
        warnings=(),
        atlas_id=request.atlas.info.atlas_id,
        patient_id=request.atlas.info.patient_id,
        points_sha256=str(request.measured.stamp_ns),
        retraction_sha256=str(float(columns.columns[0, 0, 0])) if columns else None,
    )


def seconds(stamp):
    return stamp["sec"]


class AnyOrder(RuleBasedStateMachine):
    """Inputs in any order, with the background thread at any speed, beside what must hold."""

    def __init__(self):
        super().__init__()
        self.host = FakeHost()
        self.opened = []
        self.case = InverseCase(self.host, InverseOptions(), 5, open_atlas=self.open, solve_request=answer)
        self.count = 0
        self.announced = self.points = self.retraction = None

    def open(self, info):
        if info.path == UNREADABLE:
            raise InputError(info.path, "no such file", "wait")
        self.opened.append(FakeAtlas(info))
        return self.opened[-1]

    def next(self):
        self.count += 1
        return self.count

    @initialize()
    def begin(self):
        self.announce(PATIENTS[0], settle=True)

    @rule(patient=st.sampled_from([*PATIENTS[:1] * 4, PATIENTS[1]]), readable=MOSTLY, settle=MOSTLY)
    def announce(self, patient, readable=True, settle=False):
        path = "/atlas.h5" if readable else UNREADABLE
        content = {"schema": "brainshift/atlas-info/1", "path": path, "atlas_id": f"atlas {self.next()}", "patient_id": patient}
        if self.announced is not None and self.announced.patient_id != patient:
            self.points = None
            if self.retraction is not None and self.retraction.patient_id != patient:
                self.retraction = None
        self.announced = AtlasInfo.model_validate(content)
        self.case.announce(self.announced)
        self.go_on(settle)

    @rule(kind=st.sampled_from(["good", *MARKS]), settle=MOSTLY)
    def measure(self, kind, settle=False):
        at = np.full((1, 3), 0.01)
        one = HomologousPoints(at, at, np.full(1, float(MARKS[kind])))
        self.points = StampedPoints(one, self.next() * NS_PER_S)
        self.kind = kind
        self.case.measure(self.points)
        self.go_on(settle)

    @precondition(lambda self: self.points is not None and self.count % 4 == 0)
    @rule()
    def take_points_back(self):
        self.points = None
        self.case.measure(None)

    @rule(patient=st.sampled_from(["", *PATIENTS]), columns=st.sampled_from([1, 1, 0]), settle=MOSTLY)
    def retract(self, patient, columns=1, settle=False):
        self.retraction = RetractionColumns(np.full((columns, 4, 3), self.next(), np.float32), patient)
        self.case.retract(self.retraction)
        if columns == 0:
            self.retraction = None
        self.go_on(settle)

    @precondition(lambda self: self.opened and not self.opened[-1].changed and self.count % 4 == 1)
    @rule()
    def the_file_changes(self):
        for atlas in self.opened:
            atlas.changed = True

    @precondition(lambda self: self.host.waiting)
    @rule()
    def a_job_runs(self):
        self.host.run()

    @precondition(lambda self: self.host.finished)
    @rule()
    def results_are_delivered(self):
        before = self.host.latched.get(DISPLACEMENT_FIELD)
        self.host.deliver()
        if self.host.latched.get(DISPLACEMENT_FIELD) is not before:
            self.check_newest()

    def go_on(self, settle):
        if settle:
            self.all_settles()

    def all_settles(self):
        """Let the background thread finish; what is published then answers the newest inputs."""
        while self.host.run():
            self.results_are_delivered()
        text = self.text()
        if self.points is None:
            assert self.host.health.worst[1] != "a displacement field is published"
        elif self.announced is not None:
            assert seconds(text["stamp"]) == self.points.stamp_ns // NS_PER_S, "the newest points are answered"
            assert text["ids"]["atlas"] == self.announced.atlas_id
            changed = bool(self.opened) and self.opened[-1].changed
            if self.announced.path == "/atlas.h5" and self.kind == "good" and not changed:
                self.check_newest()
                assert self.host.health.worst[0] is not Level.ERROR, "an earlier fault does not stay"

    def text(self):
        latched = self.host.latched.get(SHIFT_ESTIMATE)
        return None if latched is None else json.loads(latched["data"])

    def check_newest(self):
        """The field on the wire is of the newest atlas, points and retraction, and `shift_estimate` says so."""
        text = self.text()
        assert text["valid"] is True
        assert text["ids"]["atlas"] == self.announced.atlas_id
        assert text["ids"]["points"] == str(self.points.stamp_ns)
        fits = self.retraction is not None and self.retraction.patient_id in ("", self.announced.patient_id)
        assert text["ids"]["retraction"] == (str(float(self.retraction.columns[0, 0, 0])) if fits else "")
        assert text["displacement_field"]["current"] is True
        assert self.host.latched[DISPLACEMENT_FIELD]["header"]["stamp"] == text["stamp"]

    @invariant()
    def nothing_foreign_is_latched(self):
        text, field = self.text(), self.host.latched.get(DISPLACEMENT_FIELD)
        if self.points is None:
            assert text is None
            assert field is None
            markers = self.host.latched.get(DISPLACEMENT_MARKERS, {"markers": []})["markers"]
            assert {marker["action"] for marker in markers} <= {3}, "displays are cleared"
        if text is not None:
            assert text["ids"]["patient"] == self.announced.patient_id
            assert text["valid"] == (text["reasons"] == [])

    @invariant()
    def the_estimate_names_the_field_that_is_latched(self):
        text, field = self.text(), self.host.latched.get(DISPLACEMENT_FIELD)
        if text is None:
            assert field is None
            return
        named = text["displacement_field"]
        assert (named is None) == (field is None)
        if named is not None:
            assert named["stamp"] == field["header"]["stamp"]
            assert named["current"] == text["valid"]
            markers = self.host.latched[DISPLACEMENT_MARKERS]["markers"]
            assert any(marker["ns"] == "notice" for marker in markers) == (not named["current"]), "grey when out of date"


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(max_examples=35, stateful_step_count=30, deadline=None)


def test_a_fault_of_inputs_that_were_taken_back_is_not_reported():
    """The job fails while its points are withdrawn: the node waits for points and does not stay at an error."""
    machine = AnyOrder()
    machine.announce(PATIENTS[0], settle=True)
    machine.measure("impossible")
    machine.host.run()
    machine.take_points_back()
    machine.host.deliver()
    assert machine.host.health.worst[0] is Level.OK
    assert machine.host.health.status()["values"][0] == {"key": "estimate", "value": "OK: waiting for homologous points"}


def test_an_atlas_that_opens_after_another_was_announced_is_not_used():
    machine = AnyOrder()
    machine.measure("good")
    machine.announce(PATIENTS[0])
    machine.host.run()
    machine.announce(PATIENTS[0], readable=False)
    machine.all_settles()
    jsonschema.validate(machine.text(), json_schema())
    assert machine.text()["ids"]["atlas"] == machine.announced.atlas_id
    assert machine.text()["reasons"] == [f"{UNREADABLE}: no such file; wait"]
    assert DISPLACEMENT_FIELD not in machine.host.latched


def test_the_estimate_tells_ages_and_times():
    machine = AnyOrder()
    machine.announce(PATIENTS[0])
    machine.retract(PATIENTS[0])
    machine.measure("good", settle=True)
    text = machine.text()
    jsonschema.validate(text, json_schema())
    assert set(text["ages_s"]) == {"atlas", "points", "retraction"}
    assert {"rows", "solve", "field", "total", "message_to_field"} <= set(text["times_s"])
    assert {"time_message_to_field_s", "time_solve_s"} <= {item["key"] for item in machine.host.health.status()["values"]}
