"""Node `lrs` by itself, as a process: edge cases of scans and poses, arrivals, guides, dense field; it answers and lives on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml
from ros_cases import CRANIOTOMY_M, brain_patient, brain_scans, brain_shift
from ros_support import Probe
from scipy.spatial.transform import Rotation

from brainshift_ros import graph
from brainshift_ros.geometry import invert_rigid, rigid, transform_points
from brainshift_ros.mesh.patient_file import write_patient
from brainshift_ros.pictures.scan import pixels_of
from brainshift_ros.runner import Graph
from brainshift_ros.simulation.scanner import Scanner
from brainshift_ros.units import m_to_mm
from brainshift_ros.wire.pose import decode_transform, encode_pose
from brainshift_ros.wire.scan import encode_scan
from brainshift_ros.wire.vectors import decode_homologous

pytestmark = pytest.mark.integration

OK, WARN, ERROR = 0, 1, 2
DOMAIN = 17
OUTPUTS = (graph.REGISTRATION, graph.LRS_REGISTERED, graph.HOMOLOGOUS_POINTS, graph.DENSE_POINTS)

SCENE = {
    "gravity": {"direction": [0.0, -1.0, 0.0]},
    "craniotomy": {"center_mm": m_to_mm(CRANIOTOMY_M).tolist(), "diameter_mm": 30.0},
}


class Lrs:
    """The node, a probe beside it, and a case that it can do."""

    def __init__(self, folder):
        self.folder = folder
        self.first, self.later, self.T_patient_tracker, self.T_start = brain_scans(scanner=Scanner(width=320, height=240))
        write_patient(folder / "patient.h5", brain_patient())
        self.guides = folder / "guides.yaml"
        (folder / "scene.yaml").write_text(yaml.safe_dump(SCENE))
        self.lines = []
        parameters = {
            "patient_file": str(folder / "patient.h5"),
            "scene_file": str(folder / "scene.yaml"),
            "guides_file": str(self.guides),
            "fiducials_file": str(folder / "fiducials.yaml"),
            "search_after_s": 1.5,
            "dense_spacing_mm": 3.0,
        }
        self.running = Graph(
            {"lrs": parameters}, domain_id=DOMAIN, sink=lambda name, line: self.lines.append(f"[{name}] {line}")
        )
        self._stamp_ns = self.first.stamp_ns

    def reset(self):
        assert self.probe.call("lrs", "reset")[0].success
        self.marks = {topic: len(self.probe.received[topic]) for topic in OUTPUTS}
        self.probe.until(lambda: self.number("scans_received") == 0, "the counts of a new case")
        self.probe.until(lambda: "state" not in self.probe.conditions("lrs"), "the figures of a new case")

    def told(self, name):
        """A figure of the diagnostics, once it is there."""
        self.probe.until(lambda: name in self.probe.conditions("lrs"), f"the figure {name}")
        return self.probe.conditions("lrs")[name]

    def number(self, name):
        return float(self.told(name))

    def pose(self, T_patient_tracker):
        self.probe.send(graph.LRS_INITIAL_POSE, encode_pose(T_patient_tracker, 1))

    def scan(self, scan):
        """Send a scan with a stamp of its own."""
        self._stamp_ns += 1_000_000_000
        self.probe.send(graph.LRS_POINTS, encode_scan(replace(scan, stamp_ns=self._stamp_ns)))

    def after(self, topic):
        """The newest message on a topic since the case began."""
        return self.probe.after(topic, self.marks[topic])

    def tre_mm(self):
        """Error of the published registration at the craniotomy."""
        at = transform_points(invert_rigid(self.T_patient_tracker), CRANIOTOMY_M)
        return float(
            m_to_mm(np.linalg.norm(transform_points(decode_transform(self.after(graph.REGISTRATION)), at) - CRANIOTOMY_M))
        )

    def measured(self):
        return decode_homologous(self.after(graph.HOMOLOGOUS_POINTS)).points


@pytest.fixture(scope="module")
def started(tmp_path_factory):
    lrs = Lrs(tmp_path_factory.mktemp("lrs"))
    process = lrs.running.start("lrs")
    try:
        with Probe(DOMAIN) as probe:
            lrs.probe = probe
            probe.listen(*OUTPUTS)
            probe.until(lambda: "is loaded" in probe.conditions("lrs").get("patient file", ""), "the patient")
            yield lrs
            assert process.returncode is None, "no message may end the node"
    finally:
        ended = lrs.running.stop()
    assert ended == {"lrs": 0}
    assert not [line for line in lrs.lines if "Traceback" in line], "\n".join(lrs.lines)


@pytest.fixture
def lrs(started):
    """The node at the beginning of a case."""
    started.reset()
    return started


def with_dropouts(scan, share):
    rng = np.random.default_rng(0)
    points = scan.points.copy()
    points[rng.random(points.shape[:2]) < share] = np.nan
    return replace(scan, points=points)


def about_the_opening(degrees):
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * np.array([0.6, 0.8, 0.0]))
    return rigid(turn, CRANIOTOMY_M - turn.apply(CRANIOTOMY_M))


def flat(scan):
    """The scan pressed onto the plane through it."""
    seen = scan.points[scan.seen]
    centre = seen.mean(axis=0)
    normal = np.linalg.svd(seen[::50] - centre)[2][2]
    return replace(scan, points=(scan.points - ((scan.points - centre) @ normal)[..., None] * normal).astype(np.float32))


def ball(scan):
    """Something else of the size of a craniotomy: a ball of 4 cm, in the scan's colours."""
    v, u = (np.indices(scan.seen.shape) - np.array(scan.seen.shape)[:, None, None] / 2) * 0.25e-3
    height = np.sqrt(np.clip(0.04**2 - u**2 - v**2, 0.0, None))
    centre = np.nanmedian(scan.points.reshape(-1, 3), axis=0)
    return replace(scan, points=(centre + np.stack([u, v, height], axis=-1)).astype(np.float32))


def mirrored(scan):
    return replace(scan, points=scan.points * np.array([-1, 1, 1], dtype=np.float32))


@pytest.mark.parametrize("change", [mirrored, pytest.param(flat, marks=pytest.mark.slow), ball])
def test_a_scan_that_cannot_be_registered_is_refused_with_reasons_and_a_good_one_may_follow(lrs, change):
    lrs.pose(lrs.T_start)
    lrs.scan(change(lrs.first))
    lrs.probe.says("lrs", ERROR, "scan: registration refused: ")
    assert lrs.number("scans_registered") == 0
    lrs.scan(lrs.first)
    assert lrs.tre_mm() < 1.0
    lrs.probe.says("lrs", OK, "")


@pytest.mark.parametrize(
    "off",
    [
        pytest.param(rigid(Rotation.identity(), [0.07, 0.0, 0.0]), id="wrong hemisphere"),
        pytest.param(about_the_opening(30.0), id="30 degrees", marks=pytest.mark.slow),
        pytest.param(about_the_opening(60.0), id="60 degrees"),
    ],
)
def test_a_pose_from_far_off_is_refused_or_comes_out_right_and_a_good_one_may_follow(lrs, off):
    lrs.pose(off @ lrs.T_start)
    lrs.scan(lrs.first)
    lrs.told("state")
    if lrs.number("scans_registered") == 0:
        assert "ERROR: scan: registration refused: " in lrs.probe.conditions("lrs")["scan"]
        lrs.pose(lrs.T_start)
    assert lrs.tre_mm() < 1.0


@pytest.mark.parametrize("share", [pytest.param(0.02, marks=pytest.mark.slow), 0.6])
def test_dropouts_cost_points_and_nothing_else(lrs, share):
    lrs.pose(lrs.T_start)
    lrs.scan(with_dropouts(lrs.first, share))
    assert lrs.tre_mm() < 1.0
    assert lrs.after(graph.LRS_REGISTERED).width == pytest.approx((1.0 - share) * lrs.first.seen.sum(), rel=0.05)


def test_millimetres_are_named(lrs):
    lrs.pose(lrs.T_start)
    lrs.scan(replace(lrs.first, points=lrs.first.points * np.float32(1000.0)))
    lrs.probe.says("lrs", ERROR, "send metres, not millimetres")
    assert lrs.number("scans_received") == 0


def test_without_pose_and_fiducials_the_cortex_is_searched_and_scans_keep_their_order(lrs):
    lrs.scan(lrs.first)
    lrs.scan(lrs.later)
    lrs.probe.says("lrs", WARN, "2 scans wait for lrs/initial_pose")
    assert lrs.tre_mm() < 1.0
    assert lrs.told("registration_start") == "search"
    measured = lrs.measured()
    error = np.linalg.norm(measured.displacements - brain_shift(measured.points), axis=1)
    assert np.median(error) < 0.8e-3


def test_a_later_scan_without_a_first_is_taken_as_a_first_and_gives_no_points(lrs):
    lrs.pose(lrs.T_start)
    lrs.scan(lrs.later)
    lrs.told("state")
    lrs.probe.has_settled("lrs")
    assert not [
        item for item in lrs.probe.received[graph.HOMOLOGOUS_POINTS][lrs.marks[graph.HOMOLOGOUS_POINTS] :] if item.width
    ]


def test_a_case_with_all_its_services(lrs):
    """Two identical scans, a later one, dense field, guides, a pose that disagrees, a scan twice, a stamp of the past."""
    lrs.pose(lrs.T_start)
    lrs.scan(lrs.first)
    lrs.scan(lrs.first)
    still = lrs.measured()
    assert np.linalg.norm(still.displacements, axis=1).max() < 0.1e-3

    lrs.marks[graph.HOMOLOGOUS_POINTS] = len(lrs.probe.received[graph.HOMOLOGOUS_POINTS])
    lrs.scan(lrs.later)
    moved = lrs.measured()
    error = np.linalg.norm(moved.displacements - brain_shift(moved.points), axis=1)
    assert np.median(error) < 0.8e-3
    registering = [f"registration_{stage}" for stage in ("prepare", "coarse", "fine", "verdict")]
    for stage in ("decode", "wait", "check", *registering, "place", "resample", "coarse", "fine", "lift", "encode"):
        assert lrs.number(f"time_{stage}_s") >= 0.0
    assert 0.0 < lrs.number("time_message_to_registered_s") < lrs.number("time_message_to_points_s")

    response, _ = lrs.probe.call("lrs", "dense")
    assert response.success, response.message
    dense = decode_homologous(lrs.after(graph.DENSE_POINTS)).points
    assert len(dense.points) > 2 * len(moved.points)
    assert np.median(np.linalg.norm(dense.displacements - brain_shift(dense.points), axis=1)) < 1e-3

    lrs.guides.unlink(missing_ok=True)
    response, _ = lrs.probe.call("lrs", "guide")
    assert (response.success, response.message.split(": ")[1].split(";")[0]) == (False, "no such file")
    lrs.guides.write_text(yaml.safe_dump({"pairs_px": pairs_of_still_scanner(moved, lrs)}))
    response, _ = lrs.probe.call("lrs", "guide")
    assert response.success, response.message
    assert response.message.endswith("homologous points")

    lrs.pose(rigid(Rotation.identity(), [0.0, 0.02, 0.0]) @ lrs.T_patient_tracker)
    lrs.probe.says("lrs", WARN, "the pose disagrees with the registration by 20 mm: the registration is kept")
    assert len(lrs.probe.received[graph.REGISTRATION]) == lrs.marks[graph.REGISTRATION] + 1
    lrs.pose(lrs.T_patient_tracker)
    lrs.probe.says("lrs", OK, "")

    lrs._stamp_ns -= 1_000_000_000
    lrs.scan(lrs.later)
    lrs.probe.says("lrs", WARN, "the same scan came twice in a row")
    lrs._stamp_ns -= 5_000_000_000
    lrs.scan(lrs.later)
    lrs.probe.says("lrs", ERROR, "its stamp lies 4.000 s before that of an earlier scan")
    lrs._stamp_ns += 10_000_000_000
    lrs.scan(lrs.later)
    lrs.probe.says("lrs", OK, "")


def pairs_of_still_scanner(measured, lrs):
    """Marks as a person would set them: the scanner did not move, so points lie where they project in each scan."""
    T_tracker_patient = invert_rigid(lrs.T_patient_tracker)
    chosen = (
        measured.points[:: len(measured.points) // 8],
        (measured.points + measured.displacements)[:: len(measured.points) // 8],
    )
    pixels = [
        pixels_of(scan, transform_points(T_tracker_patient, points))[:, ::-1]
        for scan, points in zip((lrs.first, lrs.later), chosen, strict=True)
    ]
    return np.hstack(pixels).round(1).tolist()


def test_services_say_what_is_missing(lrs):
    for service, fault in (("dense", "there are no homologous points"), ("guide", "")):
        response, _ = lrs.probe.call("lrs", service)
        assert not response.success
        assert fault in response.message


def test_fiducials_start_the_registration(lrs):
    rng = np.random.default_rng(0)
    patient = rng.uniform(-0.1, 0.1, (6, 3))
    tracker = transform_points(invert_rigid(lrs.T_patient_tracker), patient) + rng.normal(0.0, 1e-3, patient.shape)
    names = [
        {"name": f"F{k}", "patient_mm": (1e3 * p).tolist(), "tracker_mm": (1e3 * t).tolist()}
        for k, (p, t) in enumerate(zip(patient, tracker, strict=True))
    ]
    (lrs.folder / "fiducials.yaml").write_text(yaml.safe_dump({"fiducials": names}))
    try:
        lrs.probe.until(lambda: "predicted TRE" in lrs.probe.conditions("lrs").get("fiducials file", ""), "the fiducials")
        assert 0.3 < lrs.number("fre_mm") < 2.5
        lrs.scan(lrs.first)
        assert lrs.tre_mm() < 1.0
        assert lrs.number("time_wait_s") < 1.0, "nothing waits for a pose"
    finally:
        (lrs.folder / "fiducials.yaml").unlink()


def test_twelve_scans_of_300000_points_are_all_answered(lrs):
    """Each as fast as it goes; of the comparisons, which are slower, only the newest matters."""
    large = replace(lrs.first, points=lrs.first.points.repeat(2, 0).repeat(2, 1), rgb=lrs.first.rgb.repeat(2, 0).repeat(2, 1))
    lrs.pose(lrs.T_start)
    count = 12
    for _ in range(count):
        lrs.scan(large)
    sent = [lrs._stamp_ns - 1_000_000_000 * k for k in reversed(range(count))]
    lrs.probe.after(graph.LRS_REGISTERED, lrs.marks[graph.LRS_REGISTERED] + count - 1)
    answered = lrs.probe.received[graph.LRS_REGISTERED][lrs.marks[graph.LRS_REGISTERED] :]
    assert [item.header.stamp.sec * 10**9 + item.header.stamp.nanosec for item in answered] == sent
    assert {item.width for item in answered} == {large.seen.sum()}
    lrs.probe.until(lambda: lrs.probe.conditions("lrs").get("scans_received") == str(count), "the counts")
    assert lrs.measured().points.shape[1] == 3
