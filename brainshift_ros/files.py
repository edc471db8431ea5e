"""Write files whole or not at all, and know a file again by its hash."""

from __future__ import annotations

import glob
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from brainshift_ros.errors import InputError


def writable_target(path: str | Path, suffixes: tuple[str, ...] = ()) -> Path:
    """`path` if a file can be written there, else an :class:`InputError`; long work asks before it starts.

    Parameters
    ----------
    path
        Need not exist; a file that does is replaced.
    suffixes
        Endings of which the name must have one, where the writer chooses its format by them.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(path, "its folder does not exist", "create the folder or choose another output path")
    if path.is_dir():
        raise InputError(path, "is a folder", "give the path of a file to write")
    if not os.access(path.parent, os.W_OK):
        raise InputError(path, "its folder cannot be written to", "change its permissions or choose another output path")
    if suffixes and not path.name.endswith(suffixes):
        raise InputError(path, f"its name does not end in {' or '.join(suffixes)}", "choose such a name")
    return path


@contextmanager
def atomic_path(target: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `target`; rename it over `target` on success, remove it on any failure.

    The temporary name keeps the suffixes (``.nii.gz``), since writers choose the format by them.
    """
    target = writable_target(target)
    temporary = target.with_name(f".part-{os.getpid()}-{target.name}")
    try:
        yield temporary
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def remove_unfinished(target: str | Path) -> None:
    """Remove what writers of `target` left that were killed in :func:`atomic_path`; only where none can be alive."""
    target = Path(target)
    for temporary in target.parent.glob(f".part-*-{glob.escape(target.name)}"):
        temporary.unlink(missing_ok=True)


def sha256_of_file(path: str | Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def existing_file(path: str | Path, what: str) -> Path:
    """`path` if it is a readable file, else an :class:`InputError` that says what was expected there."""
    path = Path(path)
    if path.is_dir():
        raise InputError(path, f"is a folder, not a {what}", f"give the path of a {what}")
    if not path.is_file():
        raise InputError(path, "no such file", f"check the path of the {what}")
    if not os.access(path, os.R_OK):
        raise InputError(path, "cannot be read (permission denied)", "change its permissions")
    return path


#: What changes when a file is replaced: modification time (ns), size, inode; None where there is no file.
Signature = tuple[int, int, int]


def signature_of(path: str | Path) -> Signature | None:
    """Recognise a file's present state without reading it."""
    try:
        found = os.stat(path)
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size, found.st_ino
