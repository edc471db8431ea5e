"""From a scan's message to its registered cloud, from a second scan to homologous points: in process and through the node."""

from __future__ import annotations

import os
import statistics
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time
from types import SimpleNamespace
from typing import Any

from bench.measure import timed
from bench.scan_client import ScanClient
from brainshift_ros import graph
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.mesh.patient_file import patient_digest, write_patient
from brainshift_ros.registration.target import CortexTarget, prepare_target
from brainshift_ros.runner import Graph
from brainshift_ros.session.session import LrsSession
from brainshift_ros.simulation.scan_cases import ScanCase, make_scan_case
from brainshift_ros.simulation.scanner import Scanner
from brainshift_ros.wire.plain import NS_PER_S, Plain
from brainshift_ros.wire.scan import decode_scan, encode_registered, encode_scan

SIZES = ((640, 480), (1280, 960))
CASE, RUNS, DOMAIN = 0, 5, 88


def run(output: Path, patient: PatientModel) -> dict[str, list[dict[str, Any]]]:
    """Measure each size of scan on a simulated case.

    Parameters
    ----------
    output
        Folder for the patient file that the node reads.
    patient
        Lends its mesh; the cortex is the case's own.
    """
    cases = {size: make_scan_case(CASE, scanner=Scanner(width=size[0], height=size[1])) for size in SIZES}
    return {
        "scan_stages": [in_process(case, prepare_target(case.cortex), name(size)) for size, case in cases.items()],
        "scan_latency": [through_node(case, output, patient, name(size)) for size, case in cases.items()],
    }


def name(size: tuple[int, int]) -> str:
    """Return a size as people write it."""
    return f"{size[0]} x {size[1]}"


def in_process(case: ScanCase, target: CortexTarget, size: str) -> dict[str, Any]:
    """Measure each stage in this process: medians of wall time, and CPU time of the two whole ways."""
    messages = [as_message(encode_scan(scan.scan)) for scan in (case.first, case.later)]
    stages: dict[str, list[float]] = {}
    cpu: dict[str, list[float]] = {"message to registered cloud": [], "second scan to points": []}
    points = 0
    for _ in range(RUNS):
        session = LrsSession(target)
        session.set_initial_pose(case.start)
        begin = process_time()
        placed = session.place(decode_scan(messages[0]))
        if placed.registered is None:
            raise RuntimeError(f"case {CASE} is refused: {placed.warnings}")
        encode_registered(placed.registered)
        cpu["message to registered cloud"].append(process_time() - begin)
        prepared = session.compare()
        assert prepared is not None
        begin = process_time()
        again = session.place(decode_scan(messages[1]))
        assert again.registered is not None
        encode_registered(again.registered)
        compared = session.compare()
        assert compared is not None
        assert compared.homologous is not None
        cpu["second scan to points"].append(process_time() - begin)
        points = len(compared.homologous.points)
        for update in (placed, prepared, compared):
            for stage, seconds in update.times_s.items():
                stages.setdefault(stage, []).append(seconds)
    decode = timed(lambda: decode_scan(messages[0]), runs=RUNS)
    encode = timed(lambda: encode_registered(again.registered), runs=RUNS)
    return {
        "scan": size,
        "homologous points": points,
        "decode, ms": 1e3 * decode.wall_s,
        **{f"{stage.replace('_', ': ', 1)}, ms": 1e3 * statistics.median(seconds) for stage, seconds in stages.items()},
        "encode, ms": 1e3 * encode.wall_s,
        **{f"{way}, CPU ms": 1e3 * statistics.median(seconds) for way, seconds in cpu.items()},
    }


def as_message(value: Plain) -> Any:
    """Attributes as a message has them, for decoding without ROS."""

    def part(item: Any) -> Any:
        if isinstance(item, list):
            return [part(each) for each in item]
        return as_message(item) if isinstance(item, dict) else item

    return SimpleNamespace(**{key: part(item) for key, item in value.items()})


def through_node(case: ScanCase, output: Path, patient: PatientModel, size: str) -> dict[str, Any]:
    """Measure the node in a process of its own, as a client sees it: medians of wall time, and the node's CPU time."""
    path = output / "scan_patient.h5"
    digest = patient_digest(patient.mesh, patient.tissue, case.cortex, patient.image)
    write_patient(path, replace(patient, cortex=case.cortex, patient_id=digest))
    running = Graph({"lrs": {"patient_file": str(path)}}, domain_id=DOMAIN, sink=lambda *_: None)
    node = running.start("lrs")
    laps: list[_Lap] = []
    try:
        with ScanClient(DOMAIN) as client:
            client.wait_until_ready()
            for _ in range(RUNS + 1):
                client.begin_case(case.start)
                laps.append(_lap(client, case, node.popen.pid))
    finally:
        running.stop()
    counted = laps[1:]  # the first one imports and allocates
    median = {key: 1e3 * statistics.median(getattr(lap, key) for lap in counted) for key in _Lap.__dataclass_fields__}
    return {
        "scan": size,
        "message to registered cloud, ms": median["registered_s"],
        "message to registered cloud, node's CPU ms": median["registered_cpu_s"],
        "second scan to its registered cloud, ms": median["second_registered_s"],
        "second scan to homologous points, ms": median["points_s"],
        "second scan to homologous points, node's CPU ms": median["points_cpu_s"],
    }


@dataclass(frozen=True)
class _Lap:
    """Times of one case, seconds."""

    registered_s: float
    registered_cpu_s: float
    second_registered_s: float
    points_s: float
    points_cpu_s: float


def _lap(client: ScanClient, case: ScanCase, pid: int) -> _Lap:
    begin = cpu_seconds(pid)
    registered = client.seconds_to_answer(graph.LRS_REGISTERED, replace(case.first.scan, stamp_ns=NS_PER_S))
    registered_cpu = cpu_seconds(pid) - begin
    client.wait_for_figure("scans_registered", 1)
    client.figure("candidates")  # the first scan is prepared for comparison
    begin = cpu_seconds(pid)
    points = client.seconds_to_answer(graph.HOMOLOGOUS_POINTS, replace(case.later.scan, stamp_ns=2 * NS_PER_S))
    points_cpu = cpu_seconds(pid) - begin
    client.wait_for_figure("scans_compared", 1)
    return _Lap(registered, registered_cpu, client.figure("time_message_to_registered_s"), points, points_cpu)


def cpu_seconds(pid: int) -> float:
    """User and system time of a process and its threads so far (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
