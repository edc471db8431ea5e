"""The same jobs on a scheduler's workers: equal to solving them here, whatever dies."""

from __future__ import annotations

import os
import signal
from dataclasses import replace

import dask
import numpy as np
import pytest
from distributed import LocalCluster
from mechanics_cases import head, patient

from brainshift_ros.atlas.build import build_atlas
from brainshift_ros.atlas.building import building_path
from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.atlas.scene import Gravity, Mannitol, Scene
from brainshift_ros.errors import InputError

pytestmark = pytest.mark.integration

PATIENT = patient(head(5))
SCENE = Scene(
    gravity=Gravity(direction=(0.0, -0.6, -0.8), cone_deg=25.0, orientations=64, fluid_levels=3),
    mannitol=Mannitol(permeability_levels=1),
    resection="both",
)  # 512 entries, 8 jobs


def build(path, **options):
    return build_atlas(PATIENT, SCENE, path, solver="scipy", **options)


def matrix(path):
    with open_atlas(path) as atlas:
        return atlas.columns(range(len(atlas.entries)))


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    path = tmp_path_factory.mktemp("here") / "atlas.h5"
    build(path)
    return matrix(path)


@pytest.fixture(scope="module")
def cluster():
    # A scheduler tries to reach a dead worker, for a result that lay there, for 30 seconds unless told otherwise.
    with (
        dask.config.set({"distributed.comm.timeouts.connect": "2s"}),
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0", host="127.0.0.1") as running,
    ):
        yield running


def pids(cluster):
    """Worker processes by address, as the nannies know them."""
    return {nanny.worker_address: nanny.pid for nanny in cluster.workers.values() if nanny.pid}


def assert_equal(path, here):
    found = matrix(path)
    assert np.linalg.norm(found - here) <= 1e-9 * np.linalg.norm(here)


def test_two_workers_give_what_this_process_gives(tmp_path, cluster, here):
    stages = []
    report = build(tmp_path / "a.h5", scheduler=cluster.scheduler_address, progress=lambda *step: stages.append(step))
    assert_equal(tmp_path / "a.h5", here)
    assert report.entries == 512
    assert report.solver == "scipy"
    assert {"assemble", "factorise", "solve", "check", "write"} == set(report.times_s)
    fractions = [fraction for _, fraction in stages]
    assert fractions == sorted(fractions)
    assert stages[0] == ("solve on 2 workers", 0.0)
    assert not building_path(tmp_path / "a.h5").exists()


def test_a_killed_worker_loses_nothing(tmp_path, cluster, here):
    killed = []

    def kill(stage, fraction):
        if 0.0 < fraction < 0.6 and not killed:
            killed.append(next(iter(pids(cluster).values())))
            os.kill(killed[0], signal.SIGKILL)

    build(tmp_path / "a.h5", scheduler=cluster.scheduler_address, progress=kill)
    assert killed
    assert_equal(tmp_path / "a.h5", here)


def test_an_interrupted_build_resumes_without_the_cluster(tmp_path, cluster, here):
    path = tmp_path / "a.h5"

    def stop(stage, fraction):
        if fraction > 0.3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build(path, scheduler=cluster.scheduler_address, progress=stop)
    assert building_path(path).exists()
    assert build(path).resumed > 0
    assert_equal(path, here)


def test_workers_of_another_version_are_refused(tmp_path, cluster, monkeypatch):
    monkeypatch.setattr("brainshift_ros.atlas.cluster.__version__", "0.0.1")
    with pytest.raises(InputError, match=r"runs brainshift_ros .*, here it is 0\.0\.1") as caught:
        build(tmp_path / "a.h5", scheduler=cluster.scheduler_address)
    assert caught.value.source.startswith("tcp://")
    assert list(tmp_path.iterdir()) == []


def test_a_fault_on_a_worker_is_the_error_it_would_be_here(tmp_path, cluster):
    mesh = head(4)
    afloat = patient(replace(mesh, node_sets={**mesh.node_sets, "brainstem": np.zeros(0, np.int32)}))
    with pytest.raises(InputError, match="brainstem") as caught:
        build_atlas(afloat, SCENE, tmp_path / "a.h5", solver="scipy", scheduler=cluster.scheduler_address)
    assert caught.value.source == "mesh"


def test_a_scheduler_without_workers_is_one_clear_error(tmp_path, monkeypatch):
    monkeypatch.setattr("brainshift_ros.atlas.cluster.WORKERS_S", 0.2)
    with (
        LocalCluster(n_workers=0, dashboard_address=":0", host="127.0.0.1") as empty,
        pytest.raises(InputError, match=r"has no workers; start some: `dask worker tcp://.* --nthreads 1"),
    ):
        build(tmp_path / "a.h5", scheduler=empty.scheduler_address)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:9", "nonsense://x", "127.0.0.1:notaport"])
def test_an_unreachable_scheduler_is_one_clear_error(tmp_path, monkeypatch, address):
    monkeypatch.setattr("brainshift_ros.atlas.cluster.CONNECT_S", 0.5)
    with pytest.raises(InputError, match="no dask scheduler answers there") as caught:
        build(tmp_path / "a.h5", scheduler=address)
    assert caught.value.source == address
    assert list(tmp_path.iterdir()) == []
