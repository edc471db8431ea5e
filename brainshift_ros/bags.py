"""Read and write bags of the graph's topics, without ROS: rosbag2 folders and single mcap files."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection, Nodetype, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.interfaces import Qos as OfferedQos
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from brainshift_ros import graph
from brainshift_ros.errors import InputError
from brainshift_ros.graph import Qos, Topic
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.wire.plain import Plain
from brainshift_ros.wire.pose import encode_pose
from brainshift_ros.wire.retraction import encode_blade, encode_retraction_vector
from brainshift_ros.wire.scan import encode_scan

TYPES = get_typestore(Stores.ROS2_KILTED)

_ZERO = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}


def to_recordable(type_name: str, plain: Plain) -> Any:
    """Rosbags message of a type with the given attributes; what `plain` leaves out is zero or empty."""
    _, fields = TYPES.fielddefs[type_name]
    values = {name: _value(kind, detail, plain.get(name)) for name, (kind, detail) in fields}
    unknown = set(plain) - set(values)
    assert not unknown, f"{type_name} has no {unknown}"
    return TYPES.types[type_name](**values)


def _value(kind: Nodetype, detail: Any, given: Any) -> Any:
    if kind == Nodetype.NAME:
        return to_recordable(detail, given or {})
    if kind == Nodetype.BASE:
        if given is None:
            return _ZERO.get(detail[0], 0)
        return given[0] if isinstance(given, bytes) else given  # rclpy wants `byte` as bytes, rosbags as a number
    item_kind, item = detail[0]
    if item_kind == Nodetype.NAME:
        return [to_recordable(item, part) for part in given or []]
    if item[0] == "string":
        return list(given or [])
    return np.asarray([] if given is None else given, dtype=item[0])


class BagWriter:
    """Writes a bag of the graph's topics; it appears under its name only when the `with` block ends well.

    Parameters
    ----------
    path
        A folder to be made (rosbag2 with mcap storage), or a single file if it ends in ``.mcap``.
    replace
        Whether an existing bag is replaced; otherwise it is refused.

    Examples
    --------
    >>> with BagWriter("case") as bag:  # doctest: +SKIP
    ...     bag.add_initial_pose(T_patient_tracker, stamp_ns)
    ...     bag.add_scan(first_scan)
    """

    def __init__(self, path: str | Path, *, replace: bool = False) -> None:
        self.path = Path(path)
        self.counts: dict[str, int] = {}
        self._connections: dict[str, Connection] = {}
        if not self.path.parent.is_dir():
            raise InputError(self.path, "its folder does not exist", "create the folder or choose another path")
        if self.path.exists() and not replace:
            raise InputError(self.path, "exists already", "choose another path, or remove it first")
        if self.path.is_dir() and any(self.path.iterdir()) and not (self.path / "metadata.yaml").is_file():
            raise InputError(self.path, "is a folder that holds something else than a bag", "choose another path")
        self._scratch = Path(tempfile.mkdtemp(prefix=f".part-{self.path.stem}-", dir=self.path.parent))
        self._writer = Writer(self._scratch / self.path.stem, version=9, storage_plugin=StoragePlugin.MCAP)

    def __enter__(self) -> BagWriter:
        self._writer.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self._writer.close()
            if kind is None:
                self._publish()
        finally:
            shutil.rmtree(self._scratch, ignore_errors=True)

    def add(self, topic: Topic, stamp_ns: int, plain: Plain) -> None:
        """Record a message given as plain attributes."""
        self.add_raw(topic, stamp_ns, bytes(TYPES.serialize_cdr(to_recordable(topic.type, plain), topic.type)))

    def add_raw(self, topic: Topic, stamp_ns: int, cdr: bytes) -> None:
        """Record a message as it travelled (CDR)."""
        if topic.name not in self._connections:
            name = "/" + topic.name.lstrip("/")
            self._connections[topic.name] = self._writer.add_connection(
                name, topic.type, typestore=TYPES, offered_qos_profiles=[_offered(topic.qos)]
            )
        self._writer.write(self._connections[topic.name], stamp_ns, cdr)
        self.counts[topic.name] = self.counts.get(topic.name, 0) + 1

    def add_scan(self, scan: OrganisedScan) -> None:
        """Record a scan at its own time."""
        self.add(graph.LRS_POINTS, scan.stamp_ns, encode_scan(scan))

    def add_initial_pose(self, T_patient_tracker: NDArray[np.float64], stamp_ns: int) -> None:
        """Record the tracker's approximate pose in the patient frame."""
        self.add(graph.LRS_INITIAL_POSE, stamp_ns, encode_pose(T_patient_tracker, stamp_ns))

    def add_blade(self, corners: NDArray[np.float64], displacement: NDArray[np.float64], stamp_ns: int) -> None:
        """Record a retractor blade and how far it pushes: corners (n, 3), displacement (3,), metres, patient frame."""
        self.add(graph.RETRACTOR_BLADE, stamp_ns, encode_blade(corners, stamp_ns))
        self.add(graph.RETRACTOR_DISPLACEMENT, stamp_ns, encode_retraction_vector(displacement, stamp_ns))

    def _publish(self) -> None:
        """Move the finished bag to its name."""
        made = self._scratch / self.path.stem
        if self.path.suffix == ".mcap":
            (made / f"{made.name}.mcap").replace(self.path)
            return
        if self.path.is_dir():
            self.path.replace(self._scratch / "earlier")
        made.replace(self.path)


def _offered(qos: Qos) -> OfferedQos:
    """Give the QoS that `ros2 bag play` shall offer: latched topics stay latched."""
    latched = qos is Qos.LATCHED
    forever = QosTime(sec=9223372036, nsec=854775807)  # RMW_DURATION_INFINITE
    return OfferedQos(
        history=QosHistory.KEEP_LAST,
        depth=1 if latched else 10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=forever,
        lifespan=forever,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=forever,
        avoid_ros_namespace_conventions=False,
    )


@dataclass(frozen=True)
class Recorded:
    """One recorded message: the graph's topic, when it was recorded, its bytes as they travelled."""

    topic: Topic
    stamp_ns: int
    cdr: bytes

    def message(self) -> Any:
        """Deserialise the message by rosbags."""
        return TYPES.deserialize_cdr(self.cdr, self.topic.type)


@contextmanager
def _opened(path: Path) -> Iterator[Reader]:
    if not path.exists():
        raise InputError(path, "no such bag", "give a rosbag2 folder or an .mcap file")
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise InputError(path, "is a folder without metadata.yaml, not a bag", "give a rosbag2 folder or an .mcap file")
    reader = None
    try:
        reader = Reader(path)
        reader.open()
    except Exception as error:  # rosbags reports damage by many exceptions: struct, YAML, sqlite, assertions
        raise InputError(path, f"is not a bag, or it is cut off ({_brief(error)})", "record it again") from error
    try:
        yield reader
    finally:
        reader.close()


def read_bag(path: str | Path, topics: Sequence[Topic] = graph.TOPICS, require: Sequence[Topic] = ()) -> list[Recorded]:
    """Messages of a bag in the order of their recording.

    Parameters
    ----------
    path
        A rosbag2 folder (mcap or sqlite3) or a single mcap file.
    topics
        Which of the graph's topics to read; others that the bag may hold are passed over.
    require
        Topics that must have at least one message.

    Raises
    ------
    InputError
        No such bag, not a bag, cut off or damaged; a required topic lacks; a topic has another type than the graph's.
    """
    path = Path(path)
    by_name = {topic.name.lstrip("/"): topic for topic in topics}
    with _opened(path) as reader:
        wanted = {
            item.topic: by_name[item.topic.lstrip("/")] for item in reader.connections if item.topic.lstrip("/") in by_name
        }
        chosen = [item for item in reader.connections if item.topic in wanted]
        for item in chosen:
            if item.msgtype != wanted[item.topic].type:
                problem = f"its topic {item.topic} is a {item.msgtype}, not a {wanted[item.topic].type}"
                raise InputError(path, problem, "record the case with this software's message types")
        for topic in require:
            if not any(item.msgcount for item in chosen if wanted[item.topic] == topic):
                held = ", ".join(sorted(item.topic for item in reader.connections if item.msgcount)) or "nothing"
                raise InputError(path, f"holds no message on {topic.name} (it holds {held})", f"record {topic.name} too")
        if not chosen:
            return []  # no connections would mean all of them to rosbags
        try:
            found = [Recorded(wanted[item.topic], stamp, bytes(cdr)) for item, stamp, cdr in reader.messages(chosen)]
        except Exception as error:  # as above
            raise InputError(path, f"is damaged ({_brief(error)})", "record it again") from error
    counted = sum(item.msgcount for item in chosen)
    if len(found) != counted:
        raise InputError(path, f"is cut off: {len(found)} of {counted} messages can be read", "record it again")
    return found


def _brief(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0]
