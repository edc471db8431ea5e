"""A build that is interrupted, wherever, resumes and gives the same atlas; two builds of one file refuse each other."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from mechanics_cases import head, patient

from brainshift_ros.atlas import lock
from brainshift_ros.atlas.build import build_atlas
from brainshift_ros.atlas.building import building_path
from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.atlas.scene import Gravity, Mannitol, Scene
from brainshift_ros.errors import InputError

PATIENT = patient(head(4))
SCENE = Scene(
    gravity=Gravity(direction=(0.0, -0.6, -0.8), cone_deg=25.0, orientations=24, fluid_levels=4),
    mannitol=Mannitol(permeability_levels=1),
    resection="both",
)
#: 240 entries in jobs of at most 64, whole orientations of 5: 12 orientations each, 2 jobs a resection state.
JOBS = 4


def build(path, scene=SCENE, **options):
    return build_atlas(PATIENT, scene, path, solver="scipy", **options)


def content(path):
    with open_atlas(path) as atlas:
        return atlas.atlas_id, atlas.columns(range(len(atlas.entries))), atlas.diagnostics


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "atlas.h5"
    assert build(path).resumed == 0
    return content(path)


def assert_same(path, expected):
    found = content(path)
    assert found[0] == expected[0]
    np.testing.assert_array_equal(found[1], expected[1])
    assert found[2].tobytes() == expected[2].tobytes()  # not-a-number counts as equal
    assert [p.name for p in path.parent.iterdir() if p.name.startswith(".")] == []


class Died(BaseException):
    """Stands for the end of the process."""


def jobs_done(path):
    return len(list(building_path(path).glob("*.done")))


def test_a_build_that_dies_at_any_write_resumes(tmp_path, monkeypatch, uninterrupted):
    # Every file gets its name by os.replace: die at the first, the second, and so on, and resume, until one comes through.
    path, replace, deaths = tmp_path / "atlas.h5", os.replace, 0
    for turn in range(40):
        allowed = iter(range(turn % 4))

        def die(source, target, allowed=allowed):
            if next(allowed, None) is None:
                raise Died
            replace(source, target)

        before = jobs_done(path)
        with monkeypatch.context() as patched, suppress(Died):
            patched.setattr("brainshift_ros.atlas.building.os.replace", die)
            report = build(path)
            break
        assert not path.exists()
        assert jobs_done(path) >= before
        deaths += 1
    assert deaths >= JOBS
    assert report.resumed > 0
    assert_same(path, uninterrupted)


def build_in_a_process(path, begun):
    begun.set()
    build(Path(path))


def test_a_killed_process_resumes(tmp_path, uninterrupted):
    # A server that has imported the package forks the builds: starting Python every time would take most of a minute.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["brainshift_ros.atlas.build", "hypothesis", "pytest"])
    path, chance, kills, kept, process = tmp_path / "atlas.h5", random.Random(3), 0, [], None
    while not path.exists():
        begun = context.Event()
        process = context.Process(target=build_in_a_process, args=(str(path), begun))
        process.start()
        assert begun.wait(60.0)
        # The longer it takes the more time it gets, so that it ends on the slowest machine as well.
        process.join(chance.uniform(0.0, 0.06) * 1.5**kills)
        if process.is_alive():
            os.kill(process.pid, signal.SIGKILL)
        process.join()
        assert process.exitcode in (0, -signal.SIGKILL)
        kills += process.exitcode != 0
        # A kill may also come after the atlas has got its name and before the process has ended: then it is whole (below).
        kept += [] if path.exists() else [jobs_done(path)]
        assert path.exists() or process.exitcode != 0
    assert kills >= 2
    assert kept == sorted(kept)  # nothing that was kept is ever lost
    assert_same(path, uninterrupted)


def interrupted_after(path, jobs, **options):
    """Leave a building folder with some jobs done."""

    def stop(stage, fraction):
        if jobs_done(path) >= jobs:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build(path, progress=stop, **options)
    assert jobs_done(path) == jobs


def damage_columns(folder):
    path = folder / "job-1.columns"
    data = bytearray(path.read_bytes())
    data[1000] ^= 1
    path.write_bytes(data)


def shorten_columns(folder):
    path = folder / "job-1.columns"
    path.write_bytes(path.read_bytes()[:-4])


def damage_record(folder):
    path = folder / "job-1.json.done"
    path.write_text(path.read_text().replace("scipy", "pardiso"))


def empty_record(folder):
    (folder / "job-1.json.done").write_text("")


def lose_columns(folder):
    (folder / "job-1.columns").unlink()


@pytest.mark.parametrize("damage", [damage_columns, shorten_columns, damage_record, empty_record, lose_columns])
def test_what_was_kept_is_looked_at_again(tmp_path, damage, uninterrupted):
    path = tmp_path / "atlas.h5"
    interrupted_after(path, 3)
    damage(building_path(path))
    report = build(path)
    assert report.resumed == 2 * 60
    assert damage is lose_columns or any("job 1 is damaged" in warning for warning in report.warnings)
    assert_same(path, uninterrupted)


def test_another_scene_starts_anew_and_says_so(tmp_path):
    path = tmp_path / "atlas.h5"
    interrupted_after(path, 2)
    other = SCENE.model_copy(update={"septa": False})
    report = build(path, other)
    assert report.resumed == 0
    assert any("an unfinished build of another scene was discarded" in warning for warning in report.warnings)
    with open_atlas(path) as atlas:
        assert atlas.scene == other
    assert [p.name for p in tmp_path.iterdir()] == ["atlas.h5"]


def test_another_software_version_starts_anew(tmp_path, monkeypatch):
    path = tmp_path / "atlas.h5"
    with monkeypatch.context() as patched:
        patched.setattr("brainshift_ros.atlas.building.__version__", "0.0.1")
        interrupted_after(path, 2)
    report = build(path)
    assert report.resumed == 0
    assert any("another software" in warning for warning in report.warnings)


def test_fresh_discards_what_was_kept(tmp_path, uninterrupted):
    path = tmp_path / "atlas.h5"
    interrupted_after(path, 2)
    assert build(path, fresh=True).resumed == 0
    assert_same(path, uninterrupted)


def test_progress_resumes_where_it_was(tmp_path):
    path = tmp_path / "atlas.h5"
    interrupted_after(path, 2)
    fractions = []
    build(path, progress=lambda stage, fraction: fractions.append(fraction))
    assert fractions == sorted(fractions)
    assert 0.4 < fractions[0] < 0.5
    assert fractions[-1] == 1.0


def test_two_builds_of_one_file_refuse_each_other(tmp_path):
    path = tmp_path / "atlas.h5"

    def second(stage, fraction):
        with pytest.raises(InputError, match=rf"another build of it is running \(process {os.getpid()} on") as caught:
            build(path)
        assert caught.value.source == str(path)
        build(tmp_path / "other.h5", SCENE.model_copy(update={"resection": "none"}))  # another file does not mind
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build(path, progress=second)
    # Neither the refused one nor the ended one leaves a lock that blocks.
    assert build(path).entries == 240


def test_a_lock_of_a_dead_process_does_not_block(tmp_path, uninterrupted):
    path = tmp_path / "atlas.h5"
    building_path(path).mkdir()
    (building_path(path) / "lock").write_text("999999 on another machine")
    (building_path(path) / "left over").mkdir()
    build(path)
    assert_same(path, uninterrupted)


def test_lock_that_was_removed_in_between_is_taken_again(tmp_path, monkeypatch):
    # The holder before us removes the folder after we have opened its lock and before we hold it.
    path, flock, calls = tmp_path / "atlas.h5", lock.fcntl.flock, []

    def removed_meanwhile(descriptor, operation):
        if not calls:
            (building_path(path) / "lock").unlink()
        calls.append(operation)
        flock(descriptor, operation)

    monkeypatch.setattr("brainshift_ros.atlas.lock.fcntl.flock", removed_meanwhile)
    build(path, SCENE.model_copy(update={"resection": "none"}))
    assert len(calls) == 2


def test_a_full_disk_is_an_error_and_the_build_resumes(tmp_path, monkeypatch, uninterrupted):
    path, fsync, calls = tmp_path / "atlas.h5", os.fsync, []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) > 12:
            raise OSError(28, "No space left on device")
        fsync(descriptor)

    with monkeypatch.context() as patched:
        patched.setattr("brainshift_ros.atlas.building.os.fsync", full)
        with pytest.raises(OSError, match="No space left"):
            build(path)
    assert jobs_done(path) >= 1
    assert build(path).resumed > 0
    assert_same(path, uninterrupted)


def test_half_an_atlas_of_a_killed_build_is_removed(tmp_path, uninterrupted):
    path, foreign = tmp_path / "atlas.h5", tmp_path / ".part-1-other.h5"
    for name in (".part-1-atlas.h5", foreign.name):
        (tmp_path / name).write_bytes(b"half")
    build(path)
    foreign.unlink()  # of another file: not touched
    assert_same(path, uninterrupted)
