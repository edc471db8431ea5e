"""PointCloud2 decoding against an encoder written with `struct`, and against corruption."""

from __future__ import annotations

import contextlib
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainshift_ros.bags import TYPES, to_recordable
from brainshift_ros.errors import InputError
from brainshift_ros.graph import LRS_POINTS
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.wire.scan import decode_scan, encode_registered, encode_scan

NUMBERS = {"b": 1, "B": 2, "h": 3, "H": 4, "i": 5, "I": 6, "f": 7, "d": 8}


def cloud(points, rgb, *, fields, big_endian=False, point_gap=0, row_gap=0, frame="tracker"):
    """PointCloud2 as plain attributes, packed value by value; `fields` is a list of (name, struct format, gap before)."""
    order = ">" if big_endian else "<"
    offsets, step = [], 0
    for _, code, gap in fields:
        offsets.append(step + gap)
        step = offsets[-1] + struct.calcsize(code)
    step += point_gap
    height, width = points.shape[:2]
    row_step = step * width + row_gap
    data = bytearray(b"\xa5" * (row_step * height))
    for row in range(height):
        for column in range(width):
            red, green, blue = (int(value) for value in rgb[row, column])
            packed = {"rgb": red * 65536 + green * 256 + blue, "bgr": blue * 65536 + green * 256 + red}
            values = dict(zip("xyz", map(float, points[row, column]), strict=True)) | dict(
                zip("rgb", rgb[row, column], strict=True)
            )
            for (name, code, _), offset in zip(fields, offsets, strict=True):
                at = row * row_step + column * step + offset
                if name[:3] in packed:
                    alpha = 0xFF000000 if name.endswith("a") else 0
                    struct.pack_into(order + "I", data, at, packed[name[:3]] | alpha)
                else:
                    struct.pack_into(order + code, data, at, values.get(name, 7))
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=12, nanosec=34), frame_id=frame),
        height=height,
        width=width,
        fields=[
            SimpleNamespace(name=name, offset=offset, datatype=NUMBERS[code], count=1)
            for (name, code, _), offset in zip(fields, offsets, strict=True)
        ],
        is_bigendian=big_endian,
        point_step=step,
        row_step=row_step,
        data=bytes(data),
        is_dense=False,
    )


def small_scan(seed=0, shape=(3, 4)):
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, 0.1, (*shape, 3)).astype(np.float32)
    return points, rng.integers(0, 256, (*shape, 3), dtype=np.uint8)


PLAIN_FIELDS = [("x", "f", 0), ("y", "f", 0), ("z", "f", 0), ("rgb", "f", 4)]


@st.composite
def layouts(draw):
    real = draw(st.sampled_from("fd"))
    packed = [[(name, code)] for name in ("rgb", "rgba", "bgr", "bgra") for code in "fIi"]
    separate = [[("b", code), ("g", code), ("r", code)] for code in "Bf"]
    colour = draw(st.sampled_from([*packed, *separate]))
    others = draw(
        st.lists(st.sampled_from([("intensity", "f"), ("ring", "H"), ("t", "d"), ("q", "b")]), unique=True, max_size=2)
    )
    order = draw(st.permutations([("x", real), ("y", real), ("z", real), *colour, *others]))
    return [(name, code, draw(st.integers(0, 5))) for name, code in order]


@settings(max_examples=60, deadline=None)
@given(layouts(), st.booleans(), st.integers(0, 7), st.integers(0, 9), st.integers(0, 2**32 - 1))
def test_any_layout_decodes_to_the_same_scan(fields, big_endian, point_gap, row_gap, seed):
    points, rgb = small_scan(seed)
    points[1, 2] = np.nan
    message = cloud(points, rgb, fields=fields, big_endian=big_endian, point_gap=point_gap, row_gap=row_gap)
    scan = decode_scan(message)
    np.testing.assert_array_equal(scan.points, points)
    np.testing.assert_array_equal(scan.rgb, rgb)
    assert (scan.frame_id, scan.stamp_ns) == ("tracker", 12_000_000_034)
    assert not scan.seen[1, 2]
    assert scan.seen.sum() == scan.seen.size - 1


def test_separate_floats_are_shares_of_full_brightness_where_none_is_above_one():
    points, rgb = small_scan()
    fields = [*PLAIN_FIELDS[:3], ("r", "f", 0), ("g", "f", 0), ("b", "f", 0)]
    shares = cloud(points, rgb / 255.0, fields=fields)
    np.testing.assert_array_equal(decode_scan(shares).rgb, rgb)
    with pytest.raises(InputError, match=r"its colour fields r, g, b run from 0 to 1e\+06"):
        decode_scan(cloud(points, np.where(rgb == rgb.max(), 1e6, 0.0), fields=fields))


@settings(max_examples=40, deadline=None)
@given(layouts(), st.booleans(), st.booleans(), st.integers(0, 2**32 - 1))
def test_a_flag_that_lies_about_the_byte_order_is_found_out(fields, big_endian, round_numbers, seed):
    """Also where the numbers are round: read in the wrong order they are all next to zero, not immense."""
    points, rgb = small_scan(seed, (5, 6))
    if round_numbers:
        points = np.round(points * 16) / 16
    points[1, 2] = np.nan
    message = cloud(points, rgb, fields=fields, big_endian=big_endian)
    message.is_bigendian = not big_endian
    sense = "big-endian" if big_endian else "little-endian"
    with pytest.raises(InputError, match=f"its numbers make sense only as {sense}; set is_bigendian"):
        decode_scan(message)


def test_a_point_with_one_bad_coordinate_was_not_seen():
    points, rgb = small_scan()
    points[0, 0, 1] = np.nan
    points[2, 1, 2] = np.inf
    scan = decode_scan(cloud(points, rgb, fields=PLAIN_FIELDS))
    assert np.isnan(scan.points[0, 0]).all()
    assert np.isnan(scan.points[2, 1]).all()
    assert scan.seen.sum() == 10


@settings(max_examples=30, deadline=None)
@given(st.integers(2, 9), st.integers(2, 9), st.integers(0, 2**32 - 1))
def test_encode_is_read_back_from_a_serialised_message(height, width, seed):
    points, rgb = small_scan(seed, (height, width))
    points[0, 1] = np.nan
    scan = OrganisedScan(points, rgb, "tracker", 1_700_000_000_123_456_789)
    cdr = TYPES.serialize_cdr(to_recordable(LRS_POINTS.type, encode_scan(scan)), LRS_POINTS.type)
    again = decode_scan(TYPES.deserialize_cdr(cdr, LRS_POINTS.type))
    np.testing.assert_array_equal(again.points, points)
    np.testing.assert_array_equal(again.rgb, rgb)
    assert again.stamp_ns == scan.stamp_ns


def test_a_registered_cloud_holds_only_what_was_seen():
    points, rgb = small_scan()
    points[1] = np.nan
    plain = encode_registered(OrganisedScan(points, rgb, "patient", 5))
    sent = np.frombuffer(plain["data"], dtype="<f4").reshape(-1, 4)
    assert (plain["height"], plain["width"], plain["is_dense"]) == (1, 8, True)
    np.testing.assert_array_equal(sent[:, :3], points[[0, 2]].reshape(-1, 3))


def broken(**changes):
    points, rgb = small_scan()
    message = cloud(points, rgb, fields=PLAIN_FIELDS)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def without_colour():
    points, rgb = small_scan()
    return cloud(points, rgb, fields=PLAIN_FIELDS[:3])


def moved_field():
    message = broken()
    message.fields[2].offset = 19
    return message


def overlapping_field():
    message = broken()
    message.fields[2].offset = 6
    return message


def doubled_field():
    message = broken()
    message.fields[1].name = "x"
    return message


def integer_field():
    message = broken()
    message.fields[0].datatype = 6
    return message


def scaled(factor, shape=(3, 4)):
    points, rgb = small_scan(shape=shape)
    return cloud(points * np.float32(factor), rgb, fields=PLAIN_FIELDS)


FAULTS = {
    "frame is 'map', expected 'tracker'": lambda: broken(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="map")
    ),
    "frame is '', expected 'tracker'": lambda: broken(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="")
    ),
    "holds no points (height 0, width 4)": lambda: broken(height=0, data=b""),
    "data hold 100 bytes, but row_step x height is 80 x 3 = 240": lambda: broken(data=b"\0" * 100),
    "row_step is 10, but 4 points of 20 bytes do not fit in it": lambda: broken(row_step=10, data=b"\0" * 30),
    "row_step is 0": lambda: broken(row_step=0, data=b""),
    "is not organised (height 1, width 4)": lambda: scaled(1.0, (1, 4)),
    "none of its 12 points was seen": lambda: scaled(np.nan),
    "send metres, not millimetres": lambda: scaled(1000.0),
    "has no colour: its fields are ['x', 'y', 'z']": without_colour,
    "field 'z' ends at byte 23 of a point of 20": moved_field,
    "has 2 fields 'x'": doubled_field,
    "fields 'y' and 'z' overlap": overlapping_field,
    "all its points lie within 0 m": lambda: scaled(0.0),
    "field 'x' has datatype 6 (u4)": integer_field,
    "its stamp is -1 s": lambda: broken(header=SimpleNamespace(stamp=SimpleNamespace(sec=-1, nanosec=0), frame_id="tracker")),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_named(fault):
    with pytest.raises(InputError) as caught:
        decode_scan(FAULTS[fault]())
    assert fault in str(caught.value)
    assert caught.value.source == "lrs/points"


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_corruption_raises_nothing_but_input_errors(data):
    points, rgb = small_scan()
    message = cloud(points, rgb, fields=PLAIN_FIELDS)
    big = st.one_of(st.integers(0, 300), st.integers(0, 2**32 - 1))
    for _ in range(data.draw(st.integers(1, 3))):
        name = data.draw(
            st.sampled_from(["height", "width", "point_step", "row_step", "data", "field", "is_bigendian", "bytes"])
        )
        if name == "data":
            message.data = message.data[: data.draw(st.integers(0, len(message.data)))]
        elif name == "bytes":
            message.data = data.draw(st.binary(min_size=len(message.data), max_size=len(message.data)))
        elif name == "is_bigendian":
            message.is_bigendian = True
        elif name == "field":
            field = data.draw(st.sampled_from(message.fields))
            part = data.draw(st.sampled_from(["name", "offset", "datatype", "count"]))
            value = (
                data.draw(st.text(max_size=3))
                if part == "name"
                else data.draw(big if part != "datatype" else st.integers(0, 255))
            )
            setattr(field, part, value)
        else:
            setattr(message, name, data.draw(big))
    with contextlib.suppress(InputError):
        scan = decode_scan(message)
        assert scan.points.shape == (*scan.rgb.shape[:2], 3)
