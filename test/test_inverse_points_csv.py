"""Points in CSV files: every form that people write, and one clear error for each fault."""

from __future__ import annotations

import numpy as np
import pytest

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.inverse.points_csv import read_homologous_points, read_points, write_homologous_points

POINTS = np.array([[10.5, -20.0, 70.25], [12.0, -18.0, 69.0]]) / 1000
SHIFTS = np.array([[0.5, -1.0, -8.0], [0.0, -1.5, -7.5]]) / 1000


def read(tmp_path, text, reader=read_homologous_points):
    path = tmp_path / "points.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return reader(path)


@pytest.mark.parametrize(
    "text",
    [
        "10.5,-20,70.25,0.5,-1,-8\n12,-18,69,0,-1.5,-7.5\n",
        "10.5 -20 70.25 0.5 -1 -8\n12 -18 69 0 -1.5 -7.5",
        "x;y;z;dx;dy;dz\r\n10.5;-20;70.25;0.5;-1;-8\r\n12;-18;69;0;-1.5;-7.5\r\n",
        "\ufeffX (mm),Y (mm),Z (mm),dx_mm,dy_mm,dz_mm\n10.5,-20,70.25,.5,-1,-8\n\n# a remark\n12,-18,69,0,-1.5,-7.5\n",
        "name,dz,dy,dx,z,y,x\na,-8,-1,.5,70.25,-20,10.5\nb,-7.5,-1.5,0,69,-18,12\n",
        "x\ty\tz\tdx\tdy\tdz\n10.5\t-20\t70.25\t0.5\t-1\t-8\n12\t-18\t69\t0\t-1.5\t-7.5\n",
    ],
)
def test_reads_what_people_write(tmp_path, text):
    measured = read(tmp_path, text)
    np.testing.assert_allclose(measured.points, POINTS)
    np.testing.assert_allclose(measured.displacements, SHIFTS)
    np.testing.assert_allclose(measured.sigma, 0.001)


def test_reads_sigma(tmp_path):
    measured = read(tmp_path, "x,y,z,dx,dy,dz,sigma\n1,2,3,0,0,-5,0.4\n1,2,4,0,0,-5,0.8\n")
    np.testing.assert_allclose(measured.sigma, [0.0004, 0.0008])


def test_round_trip(tmp_path):
    measured = HomologousPoints(POINTS, SHIFTS, np.array([0.0003, 0.0007]))
    write_homologous_points(tmp_path / "p.csv", measured)
    again = read_homologous_points(tmp_path / "p.csv")
    np.testing.assert_allclose(again.points, POINTS, atol=1e-9)
    np.testing.assert_allclose(again.displacements, SHIFTS, atol=1e-9)
    np.testing.assert_allclose(again.sigma, measured.sigma, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "is empty"),
        ("x,y,z,dx,dy,dz\n", "has a header but no points"),
        ("1,2,3\n", "line 1 has 3 values, not 6 or 7"),
        ("1,2,3,0,0,-5\n1,2,3,0,0\n", "line 2 has 5 values"),
        ("x,y,z,dx,dy,dz\n1,2,3,0,abc,-5\n", "line 2, column dy: 'abc' is not a finite number"),
        ("x,y,z,dx,dy,dz\n1,2,3,0,,-5\n", "line 2, column dy: ''"),
        ("1,2,3,0,0,-5\n1,2,nan,0,0,-5\n", "line 2, column z: 'nan'"),
        ("x,y,z,dx,dy\n1,2,3,0,0\n", "line 1: the header lacks dz"),
        ("1,2,3,0,0,-500\n", "line 1: a displacement of 500 mm"),
        ("1,2,3,0,0,-5,0\n", "line 1, column sigma: 0 is not positive"),
        ("1,2,3000,0,0,-5\n", "line 1: the point .* outside any head"),
        ("0.01,0.02,0.03,0,0,-5\n0.02,0.02,0.03,0,0,-5\n", "look like metres"),
        (b"\xff\xfe\x00\x01\x80", "is not a text file"),
    ],
)
def test_each_fault_has_its_message(tmp_path, text, match):
    with pytest.raises(InputError, match=match) as caught:
        read(tmp_path, text)
    assert "points.csv" in str(caught.value)


def test_plain_points(tmp_path):
    np.testing.assert_allclose(read(tmp_path, "1,2,3\n4,5,6\n", read_points), [[0.001, 0.002, 0.003], [0.004, 0.005, 0.006]])
    np.testing.assert_allclose(read(tmp_path, "name,z,y,x\na,3,2,1\n", read_points), [[0.001, 0.002, 0.003]])
    with pytest.raises(InputError, match="line 1 has 2 values, not 3"):
        read(tmp_path, "1,2\n", read_points)


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_homologous_points(tmp_path / "none.csv")
