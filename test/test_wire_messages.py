"""Poses, vector clouds, blades, columns, texts and markers: what is sent is read back, and each fault is named."""

from __future__ import annotations

import contextlib
import json
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib import colormaps
from scipy.spatial.transform import Rotation

from brainshift_ros import graph
from brainshift_ros.bags import TYPES, to_recordable
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.wire.markers import displacement_markers, spread_out, surface_marker
from brainshift_ros.wire.pose import decode_pose, decode_transform, encode_pose, encode_transform
from brainshift_ros.wire.retraction import (
    decode_blade,
    decode_columns,
    decode_retraction_vector,
    encode_blade,
    encode_columns,
    encode_retraction_vector,
)
from brainshift_ros.wire.texts import AtlasInfo, ShiftEstimateText, TextStamp, decode_text, encode_text
from brainshift_ros.wire.vectors import (
    decode_field,
    decode_homologous,
    decode_measurement,
    encode_field,
    encode_homologous,
    encode_withdrawal,
)

COORDINATE = st.floats(-0.3, 0.3)


def travelled(topic, plain):
    """The message after a trip through CDR."""
    return TYPES.deserialize_cdr(TYPES.serialize_cdr(to_recordable(topic.type, plain), topic.type), topic.type)


@settings(max_examples=40, deadline=None)
@given(st.tuples(COORDINATE, COORDINATE, COORDINATE), st.integers(0, 2**32 - 1))
def test_poses_and_transforms_travel(position, seed):
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = position
    np.testing.assert_allclose(decode_pose(travelled(graph.LRS_INITIAL_POSE, encode_pose(T, 7))), T, atol=1e-12)
    np.testing.assert_allclose(decode_transform(travelled(graph.REGISTRATION, encode_transform(T, 7))), T, atol=1e-12)


def test_the_pose_is_where_the_tracker_is_in_the_patient():
    """A tracker turned by 90 degrees about z: its x axis is the patient's y axis, as REP-103 quaternions say."""
    plain = {
        "header": {"frame_id": "patient"},
        "pose": {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, "orientation": {"z": np.sqrt(0.5), "w": np.sqrt(0.5)}},
    }
    T_patient_tracker = decode_pose(travelled(graph.LRS_INITIAL_POSE, plain))
    np.testing.assert_allclose(T_patient_tracker @ [1.0, 0.0, 0.0, 1.0], [1.0, 3.0, 3.0, 1.0], atol=1e-12)


def pose(frame="patient", position=(0.0, 0.0, 0.0), quaternion=(0.0, 0.0, 0.0, 1.0)):
    return {
        "header": {"frame_id": frame},
        "pose": {
            "position": dict(zip("xyz", position, strict=True)),
            "orientation": dict(zip("xyzw", quaternion, strict=True)),
        },
    }


@pytest.mark.parametrize(
    ("plain", "fault"),
    [
        (pose(frame="tracker"), "frame is 'tracker', expected 'patient'"),
        (pose(position=(np.nan, 0.0, 0.0)), "1 of 3 numbers of its position are not finite"),
        (pose(quaternion=(np.inf, 0.0, 0.0, 1.0)), "1 of 4 numbers of its orientation are not finite"),
        (pose(quaternion=(0.0, 0.0, 0.0, 0.0)), "its quaternion is zero"),
        (pose(quaternion=(0.0, 0.0, 0.0, 2.0)), "its quaternion has length 2"),
        (pose(position=(30.0, 100.0, 90.0)), "send metres, not millimetres"),
    ],
)
def test_faults_of_a_pose(plain, fault):
    with pytest.raises(InputError, match=r"lrs/initial_pose: .*") as caught:
        decode_pose(travelled(graph.LRS_INITIAL_POSE, plain))
    assert fault in str(caught.value)


def test_a_transform_from_another_frame_is_refused():
    plain = encode_transform(np.eye(4), 0) | {"child_frame_id": "camera"}
    with pytest.raises(InputError, match="frame is 'camera', expected 'tracker'"):
        decode_transform(travelled(graph.REGISTRATION, plain))


def measured(n=5, seed=0):
    rng = np.random.default_rng(seed)
    return HomologousPoints(rng.uniform(-0.1, 0.1, (n, 3)), rng.normal(0.0, 0.005, (n, 3)), rng.uniform(1e-4, 1e-3, n))


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_homologous_points_travel(n, seed):
    points = measured(n, seed)
    received = decode_homologous(travelled(graph.HOMOLOGOUS_POINTS, encode_homologous(points, 99)))
    assert received.stamp_ns == 99
    for name in ("points", "displacements", "sigma"):
        np.testing.assert_allclose(getattr(received.points, name), getattr(points, name), rtol=1e-6)


@pytest.mark.parametrize(
    ("column", "value", "fault"),
    [
        ("sigma", 0.0, "1 of 5 sigmas are not positive"),
        ("sigma", np.nan, "not finite"),
        ("displacements", 8.0, "its longest displacement is"),
        ("points", 80.0, "send metres, not millimetres"),
    ],
)
def test_faults_of_homologous_points(column, value, fault):
    points = measured()
    plain = encode_homologous(points, 0)
    table = np.frombuffer(plain["data"], dtype="<f4").reshape(5, 7).copy()
    table[2, {"points": 0, "displacements": 3, "sigma": 6}[column]] = value
    plain["data"] = np.frombuffer(table.tobytes(), dtype=np.uint8)
    with pytest.raises(InputError, match=r"^homologous_points: ") as caught:
        decode_homologous(travelled(graph.HOMOLOGOUS_POINTS, plain))
    assert fault in str(caught.value)


def tetrahedron():
    nodes = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]])
    facets = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)
    return TetMesh(nodes, np.array([[0, 1, 2, 3]], dtype=np.int32), np.array([1], dtype=np.uint8), {"skull": facets})


def test_a_well_formed_empty_cloud_takes_a_measurement_back_and_any_other_empty_cloud_is_wrong():
    nothing = encode_withdrawal(7)
    assert decode_measurement(travelled(graph.HOMOLOGOUS_POINTS, nothing)) is None
    for change in ({"fields": nothing["fields"][:3]}, {"fields": []}, {"data": np.zeros(28, dtype=np.uint8)}):
        with pytest.raises(InputError, match="holds no points"):
            decode_measurement(travelled(graph.HOMOLOGOUS_POINTS, nothing | change))
    with pytest.raises(InputError, match="frame is 'tracker'"):
        decode_measurement(travelled(graph.HOMOLOGOUS_POINTS, nothing | {"header": {"frame_id": "tracker"}}))
    with pytest.raises(InputError, match="holds no points"):
        decode_homologous(travelled(graph.HOMOLOGOUS_POINTS, nothing))


def test_a_field_travels_and_one_that_is_not_finite_is_never_encoded():
    mesh = tetrahedron()
    field = DisplacementField(mesh, np.full((4, 3), 0.002), np.array([0.0, 1e-3, 1e-3, 2e-3]), {})
    received = decode_field(travelled(graph.DISPLACEMENT_FIELD, encode_field(field, 5)))
    np.testing.assert_allclose(received.points, mesh.nodes, rtol=1e-6)
    np.testing.assert_allclose(received.displacements, field.displacement, rtol=1e-6)
    np.testing.assert_allclose(received.std, field.std, rtol=1e-6)
    with pytest.raises(ValueError, match="not finite"):
        encode_field(DisplacementField(mesh, np.full((4, 3), np.nan), field.std, {}), 5)


def test_blade_and_displacement_travel():
    corners = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.02, 0.03, 0.0], [0.0, 0.03, 0.0]])
    np.testing.assert_allclose(decode_blade(travelled(graph.RETRACTOR_BLADE, encode_blade(corners, 1))), corners, atol=1e-8)
    push = np.array([0.0, 0.012, -0.003])
    message = travelled(graph.RETRACTOR_DISPLACEMENT, encode_retraction_vector(push, 1))
    np.testing.assert_allclose(decode_retraction_vector(message), push)


@pytest.mark.parametrize(
    ("corners", "fault"),
    [
        ([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]], "has 2 corners"),
        ([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [0.03, 0.0, 0.0]], "its corners lie on one line"),
        ([[0.01, 0.0, 0.0]] * 4, "its corners lie on one line"),
        ([[np.nan, 0.0, 0.0], [0.01, 0.0, 0.0], [0.0, 0.03, 0.0]], "not finite"),
        ([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [0.0, 20.0, 0.0]], "send metres, not millimetres"),
    ],
)
def test_faults_of_a_blade(corners, fault):
    with pytest.raises(InputError, match=r"^retractor/blade: ") as caught:
        decode_blade(travelled(graph.RETRACTOR_BLADE, encode_blade(np.array(corners), 0)))
    assert fault in str(caught.value)


@pytest.mark.parametrize(("push", "fault"), [([0, 0, 0], "is zero"), ([12.0, 0, 0], "12 m long"), ([np.nan, 0, 0], "finite")])
def test_faults_of_a_retractor_displacement(push, fault):
    with pytest.raises(InputError, match=r"^retractor/displacement: ") as caught:
        decode_retraction_vector(travelled(graph.RETRACTOR_DISPLACEMENT, encode_retraction_vector(np.array(push), 0)))
    assert fault in str(caught.value)


def test_columns_travel_with_their_layout():
    columns = np.random.default_rng(0).normal(0.0, 0.01, (2, 5, 3)).astype(np.float32)
    plain = encode_columns(columns)
    assert [dimension["stride"] for dimension in plain["layout"]["dim"]] == [30, 15, 3]
    found = decode_columns(travelled(graph.ATLAS_RETRACTION, plain))
    np.testing.assert_array_equal(found.columns, columns)
    assert found.patient_id == ""
    none = encode_columns(np.zeros((0, 5, 3), dtype=np.float32), patient_id="b0" * 32)
    assert [dimension["label"] for dimension in none["layout"]["dim"]] == ["columns", f"nodes of {'b0' * 32}", "xyz"]
    found = decode_columns(travelled(graph.ATLAS_RETRACTION, none))
    assert (found.columns.shape, found.patient_id) == ((0, 5, 3), "b0" * 32)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 2**32 - 1), max_size=4), st.integers(0, 2**32 - 1), st.lists(st.floats(width=32), max_size=20))
def test_columns_with_any_layout_raise_nothing_but_input_errors(sizes, offset, numbers):
    layout = SimpleNamespace(dim=[SimpleNamespace(size=size, stride=0, label="nodes") for size in sizes], data_offset=offset)
    with contextlib.suppress(InputError):
        columns = decode_columns(SimpleNamespace(layout=layout, data=np.array(numbers, dtype=np.float32)))
        assert columns.columns.shape == tuple(sizes)


INFO = {"schema": "brainshift/atlas-info/1", "path": "/a.h5", "atlas_id": "aa", "patient_id": "bb", "nodes": 12}


def test_texts_travel_and_keep_further_keys():
    message = travelled(graph.ATLAS_INFO, encode_text(AtlasInfo.model_validate(INFO)))
    assert json.loads(message.data) == INFO
    assert decode_text(AtlasInfo, message, graph.ATLAS_INFO).atlas_id == "aa"


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("not JSON", "JSON"),
        ("[1]", "object"),
        (json.dumps(INFO | {"schema": "brainshift/atlas-info/9"}), "schema: "),
        (json.dumps({key: INFO[key] for key in ("schema", "path")}), "atlas_id: Field required; patient_id: Field required"),
        (json.dumps(INFO | {"path": ""}), "path: "),
    ],
)
def test_faults_of_a_text(text, fault):
    with pytest.raises(InputError, match=r"^atlas/info: ") as caught:
        decode_text(AtlasInfo, SimpleNamespace(data=text), graph.ATLAS_INFO)
    assert fault in str(caught.value)


ESTIMATE = {
    "schema": "brainshift/shift-estimate/2",
    "valid": False,
    "reasons": ["the atlas cannot be read"],
    "ids": {"atlas": "aa"},
    "stamp": {"sec": 3, "nanosec": 5},
    "ages_s": {"points": 0.2},
    "displacement_field": {"stamp": {"sec": 1, "nanosec": 0}, "points": "pp", "atlas": "aa", "current": False},
}


def test_an_estimate_that_gave_nothing_travels_and_names_the_field_that_is_latched():
    message = travelled(graph.SHIFT_ESTIMATE, encode_text(ShiftEstimateText.model_validate(ESTIMATE)))
    assert json.loads(message.data) == ESTIMATE
    assert TextStamp.of(3_000_000_005) == ShiftEstimateText.model_validate(ESTIMATE).stamp


@pytest.mark.parametrize("missing", ["stamp", "ages_s", "displacement_field"])
def test_an_estimate_is_never_sent_without(missing):
    with pytest.raises(ValueError, match=f"{missing}\n *Field required"):
        ShiftEstimateText.model_validate({key: value for key, value in ESTIMATE.items() if key != missing})


def test_ages_that_are_not_finite_are_never_sent():
    with pytest.raises(ValueError, match="finite"):
        ShiftEstimateText.model_validate(ESTIMATE | {"ages_s": {"points": np.nan}})


def test_arrows_run_from_where_tissue_was_to_where_it_is_and_the_scale_is_in_mm():
    mesh = tetrahedron()
    displacement = np.array([[0.0, 0.0, -0.001], [0.0, 0.0, -0.004], [0.0, 0.002, 0.0], [0.0, 0.0, 0.0]])
    plain = displacement_markers(mesh.nodes, mesh.facets["skull"], displacement, 10, 0)
    markers = travelled(graph.DISPLACEMENT_MARKERS, plain).markers
    assert markers[0].action == 3, "the arrows of an earlier field are deleted first"
    arrows = [marker for marker in markers if marker.ns == "displacement"]
    assert len(arrows) == 4
    start, end = arrows[1].points
    np.testing.assert_allclose([start.x, start.y, start.z], [0.1, 0.0, 0.0])
    np.testing.assert_allclose([end.x, end.y, end.z], [0.1, 0.0, -0.004])
    scale = [marker.text for marker in markers if marker.ns == "scale"]
    assert (scale[0], scale[-1]) == ("0.0 mm", "4.0 mm")
    for arrow, fraction in ((arrows[0], 0.25), (arrows[1], 1.0), (arrows[2], 0.5), (arrows[3], 0.0)):
        assert (arrow.color.r, arrow.color.g, arrow.color.b) == pytest.approx(colormaps["viridis"](fraction)[:3], abs=0.01)
    assert len({(marker.ns, marker.id) for marker in markers}) == len(markers)


def test_arrows_of_an_outdated_field_are_grey_and_say_so():
    mesh = tetrahedron()
    plain = displacement_markers(mesh.nodes, mesh.facets["skull"], 0.01 * mesh.nodes, 10, 0, current=False)
    markers = travelled(graph.DISPLACEMENT_MARKERS, plain).markers
    for marker in markers:
        if marker.ns in ("displacement", "scale"):
            assert marker.color.r == marker.color.g == marker.color.b
            assert marker.color.a < 0.5
    assert [marker.text for marker in markers if marker.ns == "notice"] == ["not of the newest measurement"]
    assert len({(marker.ns, marker.id) for marker in markers}) == len(markers)


def test_the_surface_marker_holds_each_facet():
    mesh = tetrahedron()
    marker = travelled(graph.ATLAS_SURFACE, surface_marker(mesh.nodes, mesh.facets["skull"], 0))
    corners = np.array([[point.x, point.y, point.z] for point in marker.points])
    np.testing.assert_array_equal(corners.reshape(-1, 3, 3), mesh.nodes[mesh.facets["skull"]])
    assert marker.header.frame_id == "patient"


def test_arrows_are_spread_evenly_and_always_the_same():
    nodes = np.random.default_rng(0).uniform(0.0, 0.1, (3000, 3))
    candidates = np.arange(3000)
    chosen = spread_out(nodes, candidates, 200)
    assert 120 <= len(chosen) <= 200
    np.testing.assert_array_equal(chosen, spread_out(nodes, candidates, 200))
    octants = np.unique((nodes[chosen] > 0.05) @ [1, 2, 4], return_counts=True)[1]
    assert octants.min() > 0.08 * len(chosen)
