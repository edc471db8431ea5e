"""A process ends in time even while native code holds Python's global lock."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

pytestmark = pytest.mark.integration

HELD = """
import ctypes, sys
from brainshift_ros.nodes.deadline import exit_after
exit_after(0.5, int(sys.argv[1]))
ctypes.PyDLL(None).sleep(60)  # PyDLL keeps the global lock
print("slept to the end")
"""


@pytest.mark.parametrize("status", [0, 3])
def test_a_deadline_holds_while_the_global_lock_is_taken(status):
    begin = time.monotonic()
    ended = subprocess.run([sys.executable, "-c", HELD, str(status)], capture_output=True, text=True, timeout=50, check=False)
    assert (ended.returncode, ended.stdout) == (status, "")
    assert time.monotonic() - begin < 40.0


def test_a_process_that_is_done_earlier_does_not_wait_for_it():
    program = "from brainshift_ros.nodes.deadline import exit_after; exit_after(60.0, 1)"
    assert subprocess.run([sys.executable, "-c", program], timeout=50, check=False).returncode == 0
