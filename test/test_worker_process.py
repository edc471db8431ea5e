"""A worker ends with the process that started it, and its folder goes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from brainshift_ros.worker_process import run_worker

pytestmark = pytest.mark.integration

WORKER = """
import os, sys, time
open("../worker.pid", "w").write(str(os.getpid()))
print("working")
seconds = float(sys.argv[1])
end = time.monotonic() + 5.0 * seconds
while time.process_time() < seconds and time.monotonic() < end: pass
print("did", sys.argv[2])
sys.exit(int(sys.argv[3]))
"""


@pytest.fixture
def work(tmp_path: Path) -> Path:
    folder = tmp_path / "work"
    folder.mkdir()
    (folder / "busy_worker.py").write_text(WORKER)
    return folder


@pytest.mark.parametrize("status", [0, 3])
def test_result_status_and_last_line(work: Path, status: int) -> None:
    waited: list[float] = []
    result = run_worker("busy_worker", ["0.4", "all", str(status)], work, timeout_s=60.0, waiting=waited.append)
    assert (result.status, result.last_line) == (status, "did all")
    assert result.cpu_s >= 0.4
    assert 1e6 < result.peak_bytes < 1e9
    assert waited == sorted(waited)
    assert waited


def test_a_worker_that_takes_too_long_is_killed(work: Path) -> None:
    with pytest.raises(TimeoutError, match="busy_worker"):
        run_worker("busy_worker", ["600", "late", "0"], work, timeout_s=1.0)
    assert ended(int((work.parent / "worker.pid").read_text()))


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
def test_worker_and_folder_go_with_the_starter(work: Path, how: signal.Signals) -> None:
    call = "from pathlib import Path; from brainshift_ros.worker_process import run_worker; run_worker('busy_worker', "
    call += f"['600', 'x', '0'], Path({str(work)!r}), timeout_s=600.0)"
    starter = subprocess.Popen([sys.executable, "-c", call])
    pid_file = work.parent / "worker.pid"
    try:
        assert within(30.0, lambda: pid_file.is_file() and pid_file.read_text() != "")
        pid = int(pid_file.read_text())
        starter.send_signal(how)
        assert starter.wait(30.0) == -how
        assert within(30.0, lambda: ended(pid) and not work.exists())
    finally:
        starter.kill()
        starter.wait()


def ended(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    stat = Path(f"/proc/{pid}/stat")  # a zombie whose parent is slow to collect it has ended too
    return stat.is_file() and stat.read_text().rsplit(")", 1)[1].split()[0] == "Z"


def within(seconds: float, true: object) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if true():  # type: ignore[operator]
            return True
        time.sleep(0.05)
    return False
