"""Bags: written whole or not at all, read back byte for byte, and one clear error for each bad one."""

from __future__ import annotations

import contextlib
import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from brainshift_ros import graph
from brainshift_ros.bags import TYPES, BagWriter, read_bag, to_recordable
from brainshift_ros.errors import InputError
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.wire.pose import decode_pose, encode_pose
from brainshift_ros.wire.retraction import decode_blade
from brainshift_ros.wire.scan import decode_scan

S = 1_000_000_000


def serialised(type_name, plain):
    return bytes(TYPES.serialize_cdr(to_recordable(type_name, plain), type_name))


def small_scan(stamp_ns=2 * S):
    rng = np.random.default_rng(stamp_ns)
    points = rng.normal(0.0, 0.1, (6, 8, 3)).astype(np.float32)
    points[0, :3] = np.nan
    return OrganisedScan(points, rng.integers(0, 256, (6, 8, 3), dtype=np.uint8), "tracker", stamp_ns)


def write_case(path, **options):
    T = np.eye(4)
    T[:3, 3] = [0.1, 0.2, 0.3]
    with BagWriter(path, **options) as bag:
        bag.add_initial_pose(T, 1 * S)
        bag.add_scan(small_scan(2 * S))
        bag.add_scan(small_scan(3 * S))
        bag.add_blade(np.eye(3) * 0.05, np.array([0.0, 0.01, 0.0]), 4 * S)
    return path


@pytest.mark.parametrize("name", ["case", "case.mcap"])
def test_a_case_is_read_back(tmp_path, name):
    path = write_case(tmp_path / name)
    messages = read_bag(path, require=graph.CASE_INPUTS)
    assert [message.stamp_ns for message in messages] == [1 * S, 2 * S, 3 * S, 4 * S, 4 * S]
    np.testing.assert_allclose(decode_pose(messages[0].message())[:3, 3], [0.1, 0.2, 0.3])
    scan = decode_scan(messages[2].message())
    np.testing.assert_array_equal(scan.points, small_scan(3 * S).points)
    np.testing.assert_array_equal(scan.rgb, small_scan(3 * S).rgb)
    np.testing.assert_allclose(decode_blade(messages[3].message()), np.eye(3) * 0.05, rtol=1e-6)
    assert [item.name for item in tmp_path.iterdir()] == [name], "no scratch is left"


def test_ros2_bag_play_would_offer_the_graphs_qos(tmp_path):
    with Reader(write_case(tmp_path / "case")) as reader:
        found = {item.topic: (item.msgtype, item.ext.offered_qos_profiles[0].durability.name) for item in reader.connections}
    durability = {graph.Qos.LATCHED: "TRANSIENT_LOCAL", graph.Qos.RELIABLE: "VOLATILE"}
    assert found == {f"/{topic.name}": (topic.type, durability[topic.qos]) for topic in graph.CASE_INPUTS}


def test_bytes_are_kept_as_they_travelled(tmp_path):
    cdr = bytes(
        TYPES.serialize_cdr(to_recordable(graph.LRS_INITIAL_POSE.type, encode_pose(np.eye(4), 5)), graph.LRS_INITIAL_POSE.type)
    )
    with BagWriter(tmp_path / "raw") as bag:
        bag.add_raw(graph.LRS_INITIAL_POSE, 7, cdr)
    assert read_bag(tmp_path / "raw")[0].cdr == cdr


def test_a_bag_that_fails_leaves_nothing_and_keeps_the_earlier_one(tmp_path):
    write_case(tmp_path / "case")

    def killed_half_way():
        with BagWriter(tmp_path / "case", replace=True) as bag:
            bag.add_initial_pose(np.eye(4), 1)
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError):
        killed_half_way()
    assert len(read_bag(tmp_path / "case")) == 5
    assert [item.name for item in tmp_path.iterdir()] == ["case"]


@pytest.mark.parametrize("name", ["case", "case.mcap"])
def test_an_existing_bag_is_replaced_only_if_asked(tmp_path, name):
    write_case(tmp_path / name)
    with pytest.raises(InputError, match="exists already"):
        BagWriter(tmp_path / name)
    with BagWriter(tmp_path / name, replace=True) as bag:
        bag.add_initial_pose(np.eye(4), 1)
    assert len(read_bag(tmp_path / name)) == 1


def test_a_folder_of_something_else_is_never_replaced(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("years of work")
    with pytest.raises(InputError, match="holds something else than a bag"):
        BagWriter(tmp_path / "thesis", replace=True)
    assert (tmp_path / "thesis" / "chapter1.tex").exists()


def test_sqlite_bags_and_single_topics_are_read(tmp_path):
    with Writer(tmp_path / "old", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/lrs/initial_pose", graph.LRS_INITIAL_POSE.type, typestore=TYPES)
        foreign = writer.add_connection("/camera/name", "std_msgs/msg/String", typestore=TYPES)
        writer.write(connection, 5, serialised(graph.LRS_INITIAL_POSE.type, encode_pose(np.eye(4), 5)))
        writer.write(foreign, 6, serialised("std_msgs/msg/String", {"data": "x"}))
    assert [message.topic for message in read_bag(tmp_path / "old")] == [graph.LRS_INITIAL_POSE]


def missing(path):
    return path / "none"


def empty_folder(path):
    (path / "bag").mkdir()
    return path / "bag"


def not_a_bag(path):
    (path / "notes.mcap").write_text("not a bag")
    return path / "notes.mcap"


def cut_off(path):
    whole = write_case(path / "case") / "case.mcap"
    whole.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    return path / "case"


def cut_off_file(path):
    whole = write_case(path / "case.mcap")
    whole.write_bytes(whole.read_bytes()[:-100])
    return whole


def without_data(path):
    whole = write_case(path / "case")
    (whole / "case.mcap").unlink()
    return whole


def without_metadata(path):
    whole = write_case(path / "case")
    (whole / "metadata.yaml").write_text(": : :")
    return whole


@pytest.mark.parametrize("make", [missing, empty_folder, not_a_bag, cut_off, cut_off_file, without_data, without_metadata])
def test_bad_bags_are_refused_by_name(tmp_path, make):
    path = make(tmp_path)
    with pytest.raises(InputError) as caught:
        read_bag(path)
    assert caught.value.source == str(path)


def test_a_bag_that_lacks_a_topic_says_which(tmp_path):
    with BagWriter(tmp_path / "poses") as bag:
        bag.add_initial_pose(np.eye(4), 1)
    with pytest.raises(InputError, match=r"holds no message on lrs/points \(it holds /lrs/initial_pose\)"):
        read_bag(tmp_path / "poses", require=[graph.LRS_POINTS])


def test_topics_that_a_bag_lacks_are_read_as_nothing(tmp_path):
    with BagWriter(tmp_path / "poses") as bag:
        bag.add_initial_pose(np.eye(4), 1)
    assert read_bag(tmp_path / "poses", [graph.LRS_POINTS]) == []


def test_a_topic_of_another_type_is_refused(tmp_path):
    with Writer(tmp_path / "other", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/lrs/points", "std_msgs/msg/String", typestore=TYPES)
        writer.write(connection, 6, serialised("std_msgs/msg/String", {"data": "x"}))
    with pytest.raises(InputError, match="/lrs/points is a std_msgs/msg/String, not a sensor_msgs/msg/PointCloud2"):
        read_bag(tmp_path / "other")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return write_case(tmp_path_factory.mktemp("bag") / "case.mcap").read_bytes()


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_damage_anywhere_raises_nothing_but_input_errors(whole, tmp_path_factory, data):
    damaged = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    folder = tmp_path_factory.mktemp("damaged")
    (folder / "case.mcap").write_bytes(damaged)
    with contextlib.suppress(InputError):
        read_bag(folder / "case.mcap")
    shutil.rmtree(folder)
