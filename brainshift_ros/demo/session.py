"""In surgery: the real graph, fed by the recorded bag, and what it published, read back from a second bag."""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainshift_ros import graph
from brainshift_ros.bags import Recorded, read_bag
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.demo.settings import DemoFiles
from brainshift_ros.runner import Graph, case_parameters
from brainshift_ros.wire.pose import decode_transform
from brainshift_ros.wire.vectors import FieldSamples, decode_field, decode_homologous

#: The graph must have answered by then, node start included.
TIME_LIMIT_S = 90.0

#: ROS_DOMAIN_ID of the demo's graph, so that it neither hears nor disturbs another one.
DOMAIN_ID = 77


@dataclass(frozen=True)
class Session:
    """What the graph published.

    Attributes
    ----------
    T_patient_tracker
        The registration.
    homologous
        The sparse measurement.
    field
        The displacement field at the atlas's nodes.
    estimate
        The JSON of `shift_estimate`.
    scan_to_field_s
        From the arrival of the second scan to that of the field, at the recorder.
    """

    T_patient_tracker: NDArray[np.float64]
    homologous: HomologousPoints
    field: FieldSamples
    estimate: dict[str, Any]
    scan_to_field_s: float


def run_session(files: DemoFiles) -> Session:
    """Start the four nodes, replay the case into them, record everything, stop them.

    Raises
    ------
    RuntimeError
        The graph did not answer in time; the message holds the last lines of the nodes.
    """
    with open(files.log, "w", encoding="utf-8") as log:

        def sink(name: str, line: str) -> None:
            log.write(f"[{name}] {line}\n")

        parameters = case_parameters(files.atlas, files.patient, image_file=files.t1, output_dir=files.folder)
        with Graph(parameters, domain_id=DOMAIN_ID, sink=sink) as running:
            goals = (graph.DISPLACEMENT_FIELD, graph.DISPLACEMENT_MARKERS, graph.SHIFT_ESTIMATE)
            until = [part for topic in goals for part in ("--until", topic.name)]
            recorder = running.tool("record", str(files.session_bag), "--replace", "--timeout", str(TIME_LIMIT_S), *until)
            # Both the node and the recorder must hear the scans, else the recorder misses when they came.
            replay = running.tool("replay", str(files.case_bag), "--subscribers", "2")
            try:
                status = recorder.wait(TIME_LIMIT_S + 30.0)
            except subprocess.TimeoutExpired:
                status = -1
            replayed = replay.wait(10.0)
    if status != 0 or replayed != 0:
        lines = files.log.read_text(encoding="utf-8").splitlines()[-12:]
        raise RuntimeError(f"the graph gave no displacement field; the end of {files.log}:\n" + "\n".join(lines))
    return read_session(files)


def read_session(files: DemoFiles) -> Session:
    """Decode what :func:`run_session` recorded."""
    recorded = read_bag(files.session_bag)
    scans = _on(recorded, graph.LRS_POINTS)
    field = _on(recorded, graph.DISPLACEMENT_FIELD)[-1]
    return Session(
        T_patient_tracker=decode_transform(_on(recorded, graph.REGISTRATION)[-1].message()),
        homologous=decode_homologous(_on(recorded, graph.HOMOLOGOUS_POINTS)[-1].message()).points,
        field=decode_field(field.message()),
        estimate=json.loads(_on(recorded, graph.SHIFT_ESTIMATE)[-1].message().data),
        scan_to_field_s=(field.stamp_ns - scans[-1].stamp_ns) / 1e9,
    )


def _on(recorded: list[Recorded], topic: graph.Topic) -> list[Recorded]:
    messages = [item for item in recorded if item.topic == topic]
    if not messages:
        raise RuntimeError(f"nothing was recorded on {topic.name}")
    return messages
