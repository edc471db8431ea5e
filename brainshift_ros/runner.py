"""Start the node graph as processes, without `ros2`: for machines that have only the wheels, for tests and the demo.

It imports no ROS. `launch_scripts/brainshift.launch.py` starts the same list of nodes under `ros2 launch`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType

from brainshift_ros import graph
from brainshift_ros.errors import InputError
from brainshift_ros.resources import resource

#: Where a line of a process's output goes: (name of the process, line).
Sink = Callable[[str, str], None]

STOP_LIMIT_S = 3.0
_KEPT_LINES = 200

TOOLS = {"replay": "brainshift_ros.nodes.replay", "record": "brainshift_ros.nodes.record"}


def ros_environment(domain_id: int | None = None) -> dict[str, str]:
    """Environment of a ROS process of the graph.

    Parameters
    ----------
    domain_id
        ROS_DOMAIN_ID of a graph that shall be alone on this machine; None keeps what the caller's environment says.

    Notes
    -----
    The transport profile is set in any case: with Fast DDS's default transport large clouds get lost. A profile that the
    user has chosen is kept.
    """
    environment = dict(os.environ)
    environment.setdefault("FASTDDS_DEFAULT_PROFILES_FILE", str(resource("config/fastdds_large_clouds.xml")))
    environment.setdefault("AMENT_PREFIX_PATH", sys.prefix)
    environment["PYTHONUNBUFFERED"] = "1"
    if domain_id is not None:
        environment["ROS_DOMAIN_ID"] = str(domain_id)
        environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    return environment


def require_ros() -> None:
    """Refuse to start ROS processes where this Python has no ROS: one error here instead of one traceback a process.

    Raises
    ------
    InputError
        rclpy or a message package of the graph is not installed; names each.
    """
    types = [*(topic.type for topic in graph.TOPICS), *(service.type for service in graph.SERVICES)]
    needed = sorted({"rclpy", *(name.split("/")[0] for name in types)})
    missing = [name for name in needed if find_spec(name) is None]
    if missing:
        remedy = "run `pip install -r requirements/ros_wheels.txt` in this environment, or source a ROS 2 installation first"
        raise InputError("ROS 2", f"{', '.join(missing)} not found by {sys.executable}", remedy)


class Process:
    """One process whose output goes line by line to a sink."""

    def __init__(self, name: str, arguments: Sequence[str], environment: Mapping[str, str], sink: Sink) -> None:
        self.name = name
        self.lines: deque[str] = deque(maxlen=_KEPT_LINES)
        # A session of its own: Ctrl-C in a terminal then reaches only the runner, which ends its processes in order.
        self.popen = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._read, args=(sink,), daemon=True)
        self._reader.start()

    @property
    def returncode(self) -> int | None:
        """Exit status, None while it runs."""
        return self.popen.poll()

    def wait(self, timeout_s: float | None = None) -> int:
        """Wait for its end and for the last line of its output; TimeoutExpired if it runs on."""
        status = self.popen.wait(timeout_s)
        self._reader.join(1.0)
        return status

    def terminate(self) -> None:
        """Ask it to end; to be done once, since a second SIGTERM may meet a process that is clearing up."""
        if self.popen.poll() is None:
            self.popen.terminate()

    def reap(self) -> int:
        """Kill it if it has not ended 3 s after it was asked to; return its exit status."""
        try:
            return self.wait(STOP_LIMIT_S)
        except subprocess.TimeoutExpired:
            self.popen.kill()
            return self.wait()

    def _read(self, sink: Sink) -> None:
        assert self.popen.stdout is not None
        for line in self.popen.stdout:
            self.lines.append(line.rstrip("\n"))
            sink(self.name, line.rstrip("\n"))


def print_line(name: str, line: str) -> None:
    """Print a line under its process's name."""
    print(f"[{name}] {line}", flush=True)


class Graph:
    """The running nodes.

    Parameters
    ----------
    parameters
        Node name -> parameter name -> value; they win over every file.
    params_files
        ROS 2 parameter files (YAML) read after the shipped ``config/nodes.yaml``.
    domain_id
        See :func:`ros_environment`.
    sink
        Takes the nodes' output.

    Raises
    ------
    InputError
        No ROS 2 is installed.

    Examples
    --------
    >>> with Graph(case_parameters("atlas.h5", "patient.h5")) as running:  # doctest: +SKIP
    ...     replayed = running.tool("replay", "case").wait()
    """

    def __init__(
        self,
        parameters: Mapping[str, Mapping[str, object]],
        *,
        params_files: Sequence[str | Path] = (),
        domain_id: int | None = None,
        sink: Sink = print_line,
    ) -> None:
        require_ros()
        self.environment = ros_environment(domain_id)
        self.processes: dict[str, Process] = {}
        self._parameters = parameters
        self._params_files = [resource("config/nodes.yaml"), *params_files]
        self._sink = sink
        self._tools: list[Process] = []

    def __enter__(self) -> Graph:
        try:
            for node in graph.NODES:
                self.start(node.name)
        except BaseException:
            self.stop()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.stop()

    def start(self, name: str) -> Process:
        """Start a node, or start it again after its end."""
        node = next(item for item in graph.NODES if item.name == name)
        arguments = [node.module, "--ros-args"]
        for path in self._params_files:
            arguments += ["--params-file", str(path)]
        for parameter, value in self._parameters.get(name, {}).items():
            # JSON is YAML with the strings quoted; the node's name makes it win over a file's section for that node.
            arguments += ["-p", f"{name}:{parameter}:={json.dumps(value)}"]
        self.processes[name] = Process(name, arguments, self.environment, self._sink)
        return self.processes[name]

    def tool(self, name: str, *arguments: str) -> Process:
        """Start `replay` or `record` in the graph's domain; it ends with the graph if not before."""
        process = Process(name, [TOOLS[name], *arguments], self.environment, self._sink)
        self._tools.append(process)
        return process

    def ended(self) -> dict[str, int]:
        """Nodes that have ended by themselves, with their exit status."""
        return {name: status for name, process in self.processes.items() if (status := process.returncode) is not None}

    def stop(self) -> dict[str, int]:
        """End every process: SIGTERM to all, then kill what is left; return the nodes' exit status."""
        everything = [*self._tools, *self.processes.values()]
        for process in everything:
            process.terminate()
        for process in everything:
            process.reap()
        return self.ended()


def case_parameters(
    atlas_file: str | Path,
    patient_file: str | Path,
    *,
    image_file: str | Path | None = None,
    output_dir: str | Path | None = None,
    scene_file: str | Path | None = None,
    fiducials_file: str | Path | None = None,
    guides_file: str | Path | None = None,
) -> dict[str, dict[str, object]]:
    """Parameters that a case needs, by node; paths become absolute."""
    parameters: dict[str, dict[str, object]] = {
        "atlas_loader": {"atlas_file": str(Path(atlas_file).resolve())},
        "lrs": {"patient_file": str(Path(patient_file).resolve())},
        "inverse": {},
    }
    optional = {
        ("inverse", "image_file"): image_file,
        ("inverse", "output_dir"): output_dir,
        ("lrs", "scene_file"): scene_file,
        ("lrs", "fiducials_file"): fiducials_file,
        ("lrs", "guides_file"): guides_file,
    }
    for (node, name), path in optional.items():
        if path is not None:
            parameters[node][name] = str(Path(path).resolve())
    return parameters


class Respawner:
    """Starts a node again that has ended, unless it ends again and again.

    Parameters
    ----------
    running
        The graph.
    say
        Takes a line for the person at the terminal.
    """

    LIMIT, WINDOW_S = 3, 30.0

    def __init__(self, running: Graph, say: Callable[[str], None]) -> None:
        self._running = running
        self._say = say
        self._ends: dict[str, list[float]] = {}

    def look_after(self) -> bool:
        """Start ended nodes again; False if one has ended three times within 30 s."""
        for name, status in self._running.ended().items():
            now = time.monotonic()
            ends = [moment for moment in self._ends.get(name, []) if now - moment < self.WINDOW_S] + [now]
            self._ends[name] = ends
            last = self._running.processes[name].lines
            reason = f"; its last line: {last[-1]}" if last else ""
            if len(ends) >= self.LIMIT:
                self._say(f"node {name} ended {len(ends)} times within {self.WINDOW_S:.0f} s (status {status}){reason}")
                return False
            self._say(f"node {name} ended (status {status}), starting it again{reason}")
            self._running.start(name)
        return True
