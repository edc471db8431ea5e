"""atlas_loader and inverse as processes: order of arrival, late joiners, restarts, and input that is wrong."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from ros_cases import box_truth, measured_points, write_box_atlas
from ros_support import Probe

from brainshift_ros import graph
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
    parameters = {"atlas_loader": {"atlas_file": str(atlas_file)}, "inverse": {"output_dir": str(folder)}}
    running = Graph(parameters, domain_id=11, sink=lambda name, line: lines.append(line))
    try:
        running.start("atlas_loader")
        running.start("inverse")
        with Probe(11) as probe:
            probe.atlas_file, probe.running, probe.lines = atlas_file, running, lines
            yield probe
        assert running.ended() == {}, "no message may end a node"
    finally:
        ended = running.stop()
    assert set(ended.values()) == {0}, f"SIGTERM ends a node with status 0: {ended}"
    assert not [line for line in lines if "Traceback" in line], "\n".join(lines)


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
    assert estimate["schema"] == "brainshift/shift-estimate/1"
    assert estimate["valid"] is True
    assert estimate["reasons"] == []
    assert estimate["ids"]["atlas"] == info_of(case).atlas_id
    assert estimate["ids"]["points"] == estimate["points_sha256"]
    assert estimate["ages_s"]["atlas"] > 0.0
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


def test_points_of_another_place_are_refused_and_the_earlier_field_stays(case):
    points = measured_points()
    far = type(points)(points.points + 0.5, points.displacements, points.sigma)
    count = len(case.received[graph.DISPLACEMENT_FIELD])
    send_points(case, 2500, far)
    case.says("inverse", ERROR, "")
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
        assert json.loads(late.newest(graph.SHIFT_ESTIMATE).data)["valid"] is False
        assert decode_field(late.newest(graph.DISPLACEMENT_FIELD)).stamp_ns == 2501, "the refused field is not shown"
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


def test_warping_without_an_image_says_what_to_do(case):
    response, _ = case.call("inverse", "warp_image")
    assert response.success is False
    assert "brainshift run --image" in response.message


def test_a_killed_node_recovers_from_what_is_latched(case):
    """Points stay latched by their publisher, the atlas by atlas_loader: the new inverse finds both, and answers."""
    case.running.processes["inverse"].popen.kill()
    case.running.processes["inverse"].wait()
    case.received[graph.DISPLACEMENT_FIELD].clear()
    case.running.start("inverse")
    np.testing.assert_allclose(field_of(case, 2800).displacements, box_truth(), atol=2e-5)
    response, _ = case.call("inverse", "warp_image", again_s=2.0)
    assert "brainshift run --image" in response.message


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
def test_a_bad_atlas_file_is_reported_and_never_used(case, tmp_path, damage, fault):
    kept = shutil.copy(case.atlas_file, tmp_path / "kept.h5")
    case.says("inverse", OK, "")
    damage(case.atlas_file)
    case.says("atlas_loader", ERROR, fault)
    stamp = 2900 + len(fault)
    count = len(case.received[graph.DISPLACEMENT_FIELD])
    send_points(case, stamp)
    case.says("inverse", ERROR, "has changed since it was announced")
    assert len(case.received[graph.DISPLACEMENT_FIELD]) == count
    shutil.copy(kept, case.atlas_file)
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
