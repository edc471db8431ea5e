"""atlas_loader and inverse as processes: order of arrival, late joiners, restarts, wrong input, the warping process."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from ros_cases import box_truth, measured_points, write_box_atlas
from ros_support import Probe

from brainshift_ros import graph
from brainshift_ros.image.io import write_volume
from brainshift_ros.image.volume import Volume
from brainshift_ros.inverse.shift_estimate import json_schema
from brainshift_ros.nodes.messages import message_class
from brainshift_ros.runner import Graph
from brainshift_ros.wire.retraction import encode_columns
from brainshift_ros.wire.texts import AtlasInfo, encode_text
from brainshift_ros.wire.vectors import decode_field, encode_homologous, encode_withdrawal

pytestmark = pytest.mark.integration

OK, WARN, ERROR = 0, 1, 2


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """Both nodes, run through all tests of this module: each test must find them alive and leave them so."""
    folder = tmp_path_factory.mktemp("inverse")
    atlas_file = folder / "atlas.h5"
    write_box_atlas(atlas_file)
    lines = []
    image_file, output = folder / "t1.nii.gz", folder / "warped"
    write_volume(image_file, Volume(np.full((20, 20, 20), 100, np.int16), np.diag([0.007, 0.007, 0.007, 1.0])))
    parameters = {
        "atlas_loader": {"atlas_file": str(atlas_file)},
        "inverse": {"output_dir": str(output), "image_file": str(image_file)},
    }
    running = Graph(parameters, domain_id=11, sink=lambda name, line: lines.append(line))
    try:
        running.start("atlas_loader")
        running.start("inverse")
        with Probe(11) as probe:
            probe.atlas_file, probe.running, probe.lines, probe.output = atlas_file, running, lines, output
            yield probe
            # The nodes are told to stop while an image is being warped.
            send_points(probe, 9000)
            field_of(probe, 9000)
            call_warp(probe)
            pids = probe.until(lambda: warping_processes(output), "the process that warps")
        assert running.ended() == {}, "no message may end a node"
    finally:
        ended = running.stop()
    assert set(ended.values()) == {0}, f"SIGTERM ends a node with status 0: {ended}"
    assert within(10.0, lambda: not any(map(runs, pids))), "the process that warps ends with the node"
    assert within(10.0, lambda: not list(output.glob(".warp-*"))), "and its folder goes"
    assert not [line for line in lines if "Traceback" in line], "\n".join(lines)


def call_warp(probe):
    """Call ~/warp_image without waiting for the answer."""
    client = probe.node.create_client(message_class("std_srvs/srv/Trigger"), "inverse/warp_image")
    probe.until(client.service_is_ready, "the service")
    return client.call_async(client.srv_type.Request())


def warping_processes(output):
    """Ids of the processes that work in a folder of `~/warp_image`: the watcher first, then the one that warps."""
    found = []
    for entry in sorted(Path("/proc").glob("[0-9]*"), key=lambda path: int(path.name)):
        try:
            if Path(os.readlink(entry / "cwd")).name.startswith(".warp-") and str(output) in os.readlink(entry / "cwd"):
                found.append(int(entry.name))
        except OSError:
            continue  # it has ended, or is another user's
    return found if len(found) > 1 else []


def runs(pid):
    stat = Path(f"/proc/{pid}/stat")
    return stat.is_file() and stat.read_text().rsplit(")", 1)[1].split()[0] != "Z"


def within(seconds, true):
    end = time.monotonic() + seconds
    while not true() and time.monotonic() < end:
        time.sleep(0.05)
    return true()


def info_of(probe):
    return AtlasInfo.model_validate_json(probe.newest(graph.ATLAS_INFO).data)


def send_points(probe, stamp_ns, points=None):
    probe.send(graph.HOMOLOGOUS_POINTS, encode_homologous(points or measured_points(), stamp_ns))


def field_of(probe, stamp_ns):
    """The field for the measurement of a given time."""
    probe.listen(graph.DISPLACEMENT_FIELD)

    def found():
        return [m for m in probe.received[graph.DISPLACEMENT_FIELD] if decode_field(m).stamp_ns == stamp_ns]

    return decode_field(probe.until(found, f"the field of {stamp_ns}")[-1])


def test_the_atlas_is_announced_with_its_surface(case):
    info = info_of(case)
    assert info.path == str(case.atlas_file)
    assert info.patient_id == "b0" * 32
    marker = case.newest(graph.ATLAS_SURFACE)
    assert marker.header.frame_id == "patient"
    corners = np.array([[p.x, p.y, p.z] for p in marker.points])
    np.testing.assert_allclose(np.abs(corners).max(axis=0), 0.07)
    case.says("atlas_loader", OK, "is announced")


def test_points_after_the_atlas_give_the_field(case):
    case.says("inverse", OK, "waiting for homologous points")
    send_points(case, 1001)
    field = field_of(case, 1001)
    np.testing.assert_allclose(field.displacements, box_truth(), atol=2e-5)
    assert np.isfinite(field.std).all()


def test_the_estimate_says_what_it_was_made_from(case):
    estimate = json.loads(case.newest(graph.SHIFT_ESTIMATE).data)
    assert estimate["schema"] == "brainshift/shift-estimate/2"
    assert estimate["valid"] is True
    assert estimate["reasons"] == []
    assert estimate["ids"]["atlas"] == info_of(case).atlas_id
    assert estimate["ids"]["points"] == estimate["points_sha256"]
    assert estimate["ages_s"]["atlas"] > 0.0
    assert estimate["times_s"]["message_to_field"] >= estimate["times_s"]["total"]
    assert estimate["stamp"] == {"sec": 0, "nanosec": 1001}
    published = {"stamp": estimate["stamp"], "points": estimate["ids"]["points"], "atlas": info_of(case).atlas_id}
    assert estimate["displacement_field"] == published | {"current": True}
    jsonschema.validate(estimate, json_schema())
    weights = {item["column"]: item["weight"] for item in estimate["weights"] if item["weight"] > 1e-3}
    assert weights == pytest.approx({0: 0.5, 2: 0.3, 5: 0.1}, abs=0.02)


def test_markers_show_the_field_in_mm(case):
    markers = case.newest(graph.DISPLACEMENT_MARKERS).markers
    arrows = [marker for marker in markers if marker.ns == "displacement"]
    length = [np.linalg.norm([e.x - s.x, e.y - s.y, e.z - s.z]) for s, e in (arrow.points for arrow in arrows)]
    scale = [marker.text for marker in markers if marker.ns == "scale"]
    assert len(arrows) > 50
    assert scale[-1] == f"{1000 * max(length):.1f} mm"


def test_a_late_joiner_gets_everything_that_is_latched(case):
    topics = (graph.ATLAS_INFO, graph.ATLAS_SURFACE, graph.DISPLACEMENT_FIELD, graph.DISPLACEMENT_MARKERS, graph.SHIFT_ESTIMATE)
    with Probe(11) as late:
        late.listen(*topics)
        for topic in topics:
            late.newest(topic)
        assert decode_field(late.newest(graph.DISPLACEMENT_FIELD)).stamp_ns == 1001


def broken_points(**changes):
    points = measured_points()
    values = {name: getattr(points, name).copy() for name in ("points", "displacements", "sigma")}
    plain = encode_homologous(points, 0)
    table = np.frombuffer(plain["data"], dtype="<f4").reshape(len(values["points"]), 7).copy()
    if "table" in changes:
        row, column, value = changes.pop("table")
        table[row, column] = value
        plain["data"] = np.frombuffer(table.tobytes(), dtype=np.uint8)
    return plain | changes


WRONG = {
    "frame is 'tracker', expected 'patient'": {"header": {"frame_id": "tracker"}},
    "1 of 343 numbers of its points are not finite": {"table": (3, 0, np.nan)},
    "holds no points": {"width": 0, "row_step": 0},
    "row_step x height": {"data": np.zeros(10, dtype=np.uint8)},
    "sigmas are not positive": {"table": (3, 6, 0.0)},
    "send metres, not millimetres": {"table": (3, 0, 80.0)},
    "no field 'sigma'": {"fields": [{"name": "x", "offset": 0, "datatype": 7, "count": 1}]},
}


@pytest.mark.parametrize("fault", WRONG)
def test_wrong_points_are_named_and_good_ones_work_again(case, fault):
    stamp = 2000 + list(WRONG).index(fault)
    case.send(graph.HOMOLOGOUS_POINTS, broken_points(**WRONG[fault]))
    message = case.says("inverse", ERROR, fault if "no field" not in fault else "field 'y'")
    assert message.startswith("homologous_points: ")
    send_points(case, stamp)
    field_of(case, stamp)
    case.says("inverse", OK, "")


def estimate_of(probe, stamp_ns):
    """What `shift_estimate` says of the measurement of a given time."""
    probe.listen(graph.SHIFT_ESTIMATE)

    def found():
        texts = [json.loads(message.data) for message in probe.received[graph.SHIFT_ESTIMATE]]
        return [text for text in texts if text["stamp"] == {"sec": 0, "nanosec": stamp_ns}]

    return probe.until(found, f"the estimate of {stamp_ns}")[-1]


def test_points_of_another_place_are_refused_and_the_earlier_field_stays(case):
    points = measured_points()
    far = type(points)(points.points + 0.5, points.displacements, points.sigma)
    count = len(case.received[graph.DISPLACEMENT_FIELD])
    send_points(case, 2500, far)
    message = case.says("inverse", ERROR, "")
    estimate = estimate_of(case, 2500)
    assert (estimate["valid"], estimate["reasons"]) == (False, [message])
    assert estimate["displacement_field"]["current"] is False
    jsonschema.validate(estimate, json_schema())
    assert len(case.received[graph.DISPLACEMENT_FIELD]) == count
    send_points(case, 2501)
    field_of(case, 2501)


def test_points_that_the_atlas_cannot_explain_are_not_valid(case):
    points = measured_points()
    upward = type(points)(points.points, np.tile([0.0, 0.012, 0.0], (len(points.points), 1)), points.sigma)
    send_points(case, 2600, upward)
    message = case.says("inverse", ERROR, "estimate: refused: ")
    estimate = json.loads(case.newest(graph.SHIFT_ESTIMATE).data)
    assert estimate["valid"] is False
    assert estimate["reasons"][0] in message
    with Probe(11) as late:
        estimate = json.loads(late.newest(graph.SHIFT_ESTIMATE).data)
        assert estimate["valid"] is False
        assert decode_field(late.newest(graph.DISPLACEMENT_FIELD)).stamp_ns == 2501, "the refused field is not shown"
        # A late joiner can tell that the field which it gets is of an earlier measurement.
        assert estimate["displacement_field"]["stamp"] == {"sec": 0, "nanosec": 2501}
        assert estimate["displacement_field"]["current"] is False
        markers = late.newest(graph.DISPLACEMENT_MARKERS).markers
        assert [marker.text for marker in markers if marker.ns == "notice"] == ["not of the newest measurement"]
    send_points(case, 2601)
    field_of(case, 2601)


@pytest.mark.parametrize("garbage", [b"\0\1\0\0", b"\0\1\0\0" + b"\xff" * 64, bytes(range(256)) * 8])
def test_bytes_that_are_no_message_are_reported(case, garbage):
    case.publisher(graph.HOMOLOGOUS_POINTS).publish(garbage)
    case.says("inverse", ERROR, "homologous_points: ")
    stamp = 2700 + len(garbage) % 97
    send_points(case, stamp)
    field_of(case, stamp)


def test_retraction_columns_of_another_mesh_are_refused(case):
    case.send(graph.ATLAS_RETRACTION, encode_columns(np.zeros((1, 5, 3), dtype=np.float32)))
    assert "mesh needs (k, 343, 3)" in case.says("inverse", ERROR, "retraction: has shape (1, 5, 3)")
    case.send(graph.ATLAS_RETRACTION, encode_columns(np.zeros((0, 343, 3), dtype=np.float32)))
    send_points(case, 2800)
    field_of(case, 2800)
    case.says("inverse", OK, "")


def test_a_retraction_is_used_unless_it_is_of_another_patient_and_can_be_taken_back(case):
    push = 0.006 * np.ones((1, 343, 1), dtype=np.float32) * np.array([0.0, 0.0, -1.0], dtype=np.float32)
    points = measured_points()
    pushed = type(points)(points.points, points.displacements + 0.5 * push[0, 0], points.sigma)
    case.send(graph.ATLAS_RETRACTION, encode_columns(push, info_of(case).patient_id))
    send_points(case, 2810, pushed)
    np.testing.assert_allclose(field_of(case, 2810).displacements, box_truth() + 0.5 * push[0], atol=2e-4)
    assert "retraction" in estimate_of(case, 2810)["ages_s"]
    case.send(graph.ATLAS_RETRACTION, encode_columns(push, "dd" * 32))
    case.says("inverse", WARN, "the retraction is left out: it was solved for patient dddddddddddd")
    case.send(graph.ATLAS_RETRACTION, encode_columns(np.zeros((0, 343, 3), dtype=np.float32)))
    send_points(case, 2811)
    np.testing.assert_allclose(field_of(case, 2811).displacements, box_truth(), atol=2e-5)
    assert estimate_of(case, 2811)["ids"]["retraction"] == ""
    case.says("inverse", OK, "")


def answer(probe, request):
    return probe.until(lambda: request.done() and request.result(), "the answer of warp_image")


def test_two_calls_at_once_get_one_image_and_are_told_of_newer_points(case):
    send_points(case, 2820)
    field_of(case, 2820)
    calls = [call_warp(case), call_warp(case)]
    case.until(lambda: warping_processes(case.output), "the process that warps")
    send_points(case, 2821)
    field_of(case, 2821)
    assert not any(call.done() for call in calls), "points are used while an image is warped"
    answers = [answer(case, call) for call in calls]
    warped = str(case.output / "warped.nii.gz")
    for item in answers:
        assert item.success, item.message
        assert item.message.startswith(f"{warped}; ")
        assert item.message.endswith("; newer inputs have come since")
    assert {path.name for path in case.output.iterdir()} == {"field.h5", "warped.nii.gz", "displacement.nii.gz", "warped.json"}


def test_a_killed_warp_is_reported_and_leaves_nothing(case):
    before = {path.name: path.stat().st_mtime_ns for path in case.output.iterdir()}
    call = call_warp(case)
    os.kill(case.until(lambda: warping_processes(case.output), "the process that warps")[-1], signal.SIGKILL)
    response = answer(case, call)
    assert (response.success, response.message) == (False, "warp_image: its process was ended by signal 9; call again")
    assert {path.name: path.stat().st_mtime_ns for path in case.output.iterdir()} == before


def test_a_warp_is_given_up_when_its_points_are_taken_back(case):
    before = {path.name: path.stat().st_mtime_ns for path in case.output.iterdir()}
    call = call_warp(case)
    pids = case.until(lambda: warping_processes(case.output), "the process that warps")
    case.send(graph.HOMOLOGOUS_POINTS, encode_withdrawal(2840))
    response = answer(case, call)
    assert (response.success, "the case is over" in response.message) == (False, True), response.message
    assert within(10.0, lambda: not any(map(runs, pids)))
    assert {path.name: path.stat().st_mtime_ns for path in case.output.iterdir()} == before
    send_points(case, 2800)
    field_of(case, 2800)


def test_a_killed_node_recovers_from_what_is_latched(case):
    """Points stay latched by their publisher, the atlas by atlas_loader: the new inverse finds both, and answers."""
    case.running.processes["inverse"].popen.kill()
    case.running.processes["inverse"].wait()
    case.received[graph.DISPLACEMENT_FIELD].clear()
    case.running.start("inverse")
    np.testing.assert_allclose(field_of(case, 2800).displacements, box_truth(), atol=2e-5)
    case.send(graph.HOMOLOGOUS_POINTS, encode_withdrawal(2845))
    case.says("inverse", OK, "waiting for homologous points")
    response, _ = case.call("inverse", "warp_image", again_s=2.0)
    assert response.message == "there is no valid displacement field to warp by"
    send_points(case, 2846)
    field_of(case, 2846)


RESULTS = (graph.DISPLACEMENT_FIELD, graph.SHIFT_ESTIMATE)


def assert_late_joiners_get_no_result(case):
    with Probe(11) as late:
        late.listen(*RESULTS)
        markers = late.newest(graph.DISPLACEMENT_MARKERS).markers
        late.has_settled("inverse", "atlas_loader")
        assert [late.received[topic] for topic in RESULTS] == [[], []]
    assert [marker.action for marker in markers] == [3], "DELETEALL: displays are cleared"
    response, _ = case.call("inverse", "warp_image")
    assert response.message == "there is no valid displacement field to warp by"


def test_an_empty_cloud_takes_points_and_results_back(case):
    case.send(graph.HOMOLOGOUS_POINTS, encode_withdrawal(2850))
    case.says("inverse", OK, "waiting for homologous points")
    assert_late_joiners_get_no_result(case)
    send_points(case, 2851)
    np.testing.assert_allclose(field_of(case, 2851).displacements, box_truth(), atol=2e-5)


def test_points_of_one_patient_are_not_used_with_the_atlas_of_another(case):
    info, count = info_of(case), len(case.received[graph.DISPLACEMENT_FIELD])
    write_box_atlas(case.atlas_file, patient_id="c1" * 32)
    case.until(lambda: info_of(case).patient_id == "c1" * 32, "the other patient's atlas")
    case.says("inverse", OK, "waiting for homologous points")
    assert_late_joiners_get_no_result(case)
    assert len(case.received[graph.DISPLACEMENT_FIELD]) == count
    send_points(case, 2860)
    field_of(case, 2860)
    case.until(lambda: json.loads(case.newest(graph.SHIFT_ESTIMATE).data)["ids"]["patient"] == "c1" * 32, "the new estimate")
    write_box_atlas(case.atlas_file, patient_id=info.patient_id)
    case.until(lambda: info_of(case).atlas_id == info.atlas_id, "the first patient's atlas")
    send_points(case, 2861)
    field_of(case, 2861)


def test_a_new_atlas_file_is_announced_and_used(case):
    earlier = info_of(case).atlas_id
    write_box_atlas(case.atlas_file, scale=0.9)
    case.until(lambda: info_of(case).atlas_id != earlier, "the new atlas")
    newer = info_of(case).atlas_id
    case.until(
        lambda: json.loads(case.newest(graph.SHIFT_ESTIMATE).data)["ids"]["atlas"] == newer, "an estimate from the new atlas"
    )


def foreign(path):
    path.write_text("a letter")


def truncated(path):
    whole = path.read_bytes()
    path.unlink()
    path.write_bytes(whole[: len(whole) // 2])


@pytest.mark.parametrize(("damage", "fault"), [(foreign, "is not a readable HDF5 file"), (truncated, "cut off")])
def test_a_bad_atlas_file_is_reported_and_never_used(case, damage, fault):
    kept = shutil.copy(case.atlas_file, case.atlas_file.with_name("kept.h5"))
    case.says("inverse", OK, "")
    damage(case.atlas_file)
    case.says("atlas_loader", ERROR, fault)
    stamp = 2900 + len(fault)
    count = len(case.received[graph.DISPLACEMENT_FIELD])
    send_points(case, stamp)
    case.says("inverse", ERROR, "has changed since it was announced")
    assert len(case.received[graph.DISPLACEMENT_FIELD]) == count
    # In one step: of a file that grows while it is copied, atlas_loader announces two states, and the second may come between
    # what the next tests send.
    os.replace(kept, case.atlas_file)
    case.says("atlas_loader", OK, "is announced")
    field_of(case, stamp)


def announce_again(case, info):
    """Send the good announcement; the next test reads the newest that was heard, so wait until that is this one."""
    good = encode_text(info)
    case.send(graph.ATLAS_INFO, good)
    case.says("inverse", OK, "")
    case.until(lambda: case.newest(graph.ATLAS_INFO).data == good["data"], "the good announcement")


def test_an_announcement_that_does_not_fit_its_file_is_refused(case):
    info = info_of(case)
    wrong = info.model_copy(update={"atlas_id": "ff" * 32})
    case.send(graph.ATLAS_INFO, encode_text(wrong))
    case.says("inverse", ERROR, "but ffffffffffff was announced")
    announce_again(case, info)


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"path": "/nowhere/atlas.h5"}, "/nowhere/atlas.h5: no such file"),
        ({"schema_name": "brainshift/atlas-info/2"}, "atlas/info: schema: "),
        ({"patient_id": ""}, "atlas/info: patient_id: "),
    ],
)
def test_a_wrong_announcement_is_named_and_the_next_good_one_is_used(case, changes, fault):
    info = info_of(case)
    case.send(graph.ATLAS_INFO, encode_text(info.model_copy(update=changes)))
    case.says("inverse", ERROR, fault)
    announce_again(case, info)


def test_points_before_the_atlas_give_the_same_field(case, tmp_path):
    """The other order, in a domain of its own: same inputs, same field to the last bit."""
    send_points(case, 3000)
    expected = field_of(case, 3000)
    running = Graph({"atlas_loader": {"atlas_file": str(case.atlas_file)}}, domain_id=12, sink=lambda *_: None)
    try:
        running.start("inverse")
        with Probe(12) as probe:
            send_points(probe, 3000)
            probe.says("inverse", OK, "waiting for an atlas")
            running.start("atlas_loader")
            found = field_of(probe, 3000)
    finally:
        running.stop()
    for name in ("points", "displacements", "std"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_everything_published_was_finite(case):
    """Runs last: all that these nodes said in this module."""
    assert len(case.received[graph.DISPLACEMENT_FIELD]) > 3
    for message in case.received[graph.DISPLACEMENT_FIELD]:
        decode_field(message)
    for text in case.received[graph.SHIFT_ESTIMATE]:
        json.loads(text.data, parse_constant=lambda name: pytest.fail(f"{name} in {graph.SHIFT_ESTIMATE.name}"))
    assert message_class(graph.SHIFT_ESTIMATE.type).__name__ == "String"
