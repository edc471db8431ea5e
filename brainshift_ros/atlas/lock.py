"""One process at a time on a folder: a lock that the kernel releases with its process, however that ends."""

from __future__ import annotations

import fcntl
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from brainshift_ros.errors import InputError

#: Name of the lock's file; it says which process holds it.
LOCK = "lock"


@contextmanager
def held(folder: Path, output: str | Path) -> Iterator[None]:
    """Make a folder and hold its lock.

    Parameters
    ----------
    folder
        Whose content is this process's alone as long as the lock is held. The holder may remove the folder with its lock.
    output
        What the folder is for, for messages.

    Raises
    ------
    InputError
        Another process holds it.
    """
    while True:
        folder.mkdir(exist_ok=True)
        try:
            lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        except FileNotFoundError:  # another build has just removed the folder
            continue
        try:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = os.pread(lock, 200, 0).decode(errors="replace") or "of unknown number"
                problem = f"another build of it is running (process {holder})"
                raise InputError(output, problem, "wait until it has ended, or stop it") from None
            if not _is_same(lock, folder / LOCK):
                continue  # its holder removed it between our opening and our locking
            os.truncate(lock, 0)
            os.pwrite(lock, f"{os.getpid()} on {platform.node()}".encode(), 0)
            yield
            return
        finally:
            os.close(lock)


def _is_same(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False
