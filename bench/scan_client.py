"""A scanner's side of the graph, which measures how long the node `lrs` takes to answer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bench.graph_client import GraphClient
from brainshift_ros import graph
from brainshift_ros.graph import Topic
from brainshift_ros.nodes.messages import message_class
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.wire.pose import encode_pose
from brainshift_ros.wire.scan import encode_scan


class ScanClient(GraphClient):
    """Sends scans and waits for what comes of them.

    Parameters
    ----------
    domain_id
        ROS domain of the node.
    """

    def __init__(self, domain_id: int) -> None:
        sent, awaited = (graph.LRS_POINTS, graph.LRS_INITIAL_POSE), (graph.LRS_REGISTERED, graph.HOMOLOGOUS_POINTS)
        super().__init__("lrs", domain_id, sent, awaited)
        self._reset = self.node.create_client(message_class("std_srvs/srv/Trigger"), "lrs/reset")

    def wait_until_ready(self) -> None:
        """Wait until the node has loaded its patient and is matched with every publisher and service here."""
        self.until(lambda: "is loaded" in self.figures.get("patient file", ""), "the patient")
        self.wait_for_subscribers()
        self.until(self._reset.service_is_ready, "the service")

    def begin_case(self, T_patient_tracker: NDArray[np.float64]) -> None:
        """Reset the node and give it the pose to start from."""
        answer = self._reset.call_async(self._reset.srv_type.Request())
        self.until(answer.done, "the reset")
        # Diagnostics of the case before may still be on their way; the next heartbeat tells of this one.
        self.until(lambda: self.figures.get("scans_received") == "0", "the new case")
        self.send(graph.LRS_INITIAL_POSE, encode_pose(T_patient_tracker, 1))
        self.until(lambda: self.figures.get("pose", "").endswith("known"), "the pose")

    def seconds_to_answer(self, topic: Topic, scan: OrganisedScan) -> float:
        """Seconds from handing a scan to the publisher until `topic` is received."""
        return self.seconds_to([topic], graph.LRS_POINTS, encode_scan(scan))[0]
