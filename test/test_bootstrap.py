"""What `make` says when the machine lacks something, and that it does nothing twice."""

from __future__ import annotations

import importlib.util
import os
import stat
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def bootstrap(tmp_path, monkeypatch):
    """The module, with its .venv in an empty folder."""
    spec = importlib.util.spec_from_file_location("bootstrap", ROOT / "scripts" / "bootstrap.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "VENV", str(tmp_path / ".venv"))
    monkeypatch.setattr(module, "VENV_PYTHON", str(tmp_path / ".venv" / "bin" / "python"))
    monkeypatch.setattr(module, "STAMP", str(tmp_path / ".venv" / ".ready"))
    return module


def _fake_python(folder: Path, name: str, script: str) -> Path:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def test_an_unsupported_python_is_named_with_what_to_install(bootstrap, tmp_path, monkeypatch):
    old = _fake_python(tmp_path, "python3", "echo 3.9")
    monkeypatch.setattr(bootstrap.sys, "executable", str(old))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SystemExit, match=r"no supported Python \(3\.13 or 3\.12 or 3\.11\) on PATH; python3 is 3\.9") as end:
        bootstrap.main()
    assert "install one" in str(end.value)


def test_a_supported_python_elsewhere_on_the_path_is_taken(bootstrap, tmp_path, monkeypatch):
    monkeypatch.setattr(bootstrap.sys, "executable", str(_fake_python(tmp_path, "python3", "echo 3.9")))
    newer = _fake_python(tmp_path, "python3.11", "echo 3.11")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert bootstrap.find_python() == str(newer)


def test_a_python_without_venv_is_told_the_package(bootstrap, tmp_path, monkeypatch):
    bare = _fake_python(tmp_path, "python3", 'case "$2" in *venv*) exit 1;; *) echo 3.11;; esac')
    monkeypatch.setattr(bootstrap.sys, "executable", str(bare))
    with pytest.raises(SystemExit, match="lacks venv or pip") as end:
        bootstrap.main()
    assert "apt-get install python3-venv python3-pip" in str(end.value)


def test_an_environment_that_is_as_wanted_is_left_alone(bootstrap, tmp_path, monkeypatch):
    (tmp_path / ".venv").mkdir()
    Path(bootstrap.STAMP).write_text(bootstrap.fingerprint())
    monkeypatch.setattr(bootstrap.subprocess, "run", lambda *_args, **_kw: pytest.fail("something was started"))
    bootstrap.main()


def test_make_says_when_python_is_missing(tmp_path):
    for tool in ("make", "sh"):
        source = next(Path(folder) / tool for folder in os.environ["PATH"].split(os.pathsep) if (Path(folder) / tool).exists())
        (tmp_path / tool).symlink_to(source)
    shown = subprocess.run(
        [str(tmp_path / "make"), "-C", str(ROOT), "setup", f"SHELL={tmp_path / 'sh'}"],
        env={"PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert shown.returncode != 0
    assert "python3 is missing: apt-get install python3 python3-venv python3-pip" in shown.stderr


def test_the_lock_pins_every_direct_requirement():
    def pins(name):
        lines = (line.split("#")[0].strip() for line in (ROOT / "requirements" / name).read_text().splitlines())
        return {line.split(";")[0].strip().lower().replace("_", "-") for line in lines if line}

    lock = pins("lock.txt")
    for name in ("runtime.txt", "ros_wheels.txt", "dev.txt"):
        assert pins(name) <= lock, name
