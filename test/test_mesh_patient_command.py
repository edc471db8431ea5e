"""`brainshift patient`: from files to a patient file, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.spatial import cKDTree

from brainshift_ros.cli.patient import command
from brainshift_ros.errors import InputError
from brainshift_ros.files import sha256_of_file
from brainshift_ros.image.io import write_volume
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.mesh.patient_file import read_patient


def run(*arguments: object) -> None:
    CliRunner().invoke(command, [str(a) for a in arguments], catch_exceptions=False, standalone_mode=False)


def test_labels_and_tumour_mask_make_a_patient_without_septa(
    tmp_path: Path, template_case: tuple[Volume, Volume], small_patient: PatientModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    t1, labels = template_case
    tumor = labels.data == Region.TUMOR
    healthy = np.where(tumor, Region.LEFT_CEREBRUM, labels.data).astype(np.uint8)
    i, j, k = np.argwhere(labels.data == Region.RIGHT_CEREBRUM).mean(axis=0).astype(int)
    healthy[i - 3 : i + 3, j - 3 : j + 3, k - 3 : k + 3] = Region.TUMOR  # a second, smaller one
    window = tuple(slice(axis.min() - 3, axis.max() + 4) for axis in np.nonzero(tumor))
    T_mask = t1.T_patient_voxel.copy()
    T_mask[:3, 3] += T_mask[:3, :3] @ [axis.start for axis in window]
    write_volume(tmp_path / "t1.nii.gz", t1)
    write_volume(tmp_path / "labels.nii.gz", Volume(healthy, t1.T_patient_voxel))
    write_volume(tmp_path / "tumor.nii.gz", Volume(tumor[window], T_mask))  # on a grid of its own
    output = tmp_path / "patient.h5"
    options = (
        "--labels",
        tmp_path / "labels.nii.gz",
        "--tumor",
        tmp_path / "tumor.nii.gz",
        "--nodes",
        2000,
        "--seed",
        1,
        "--septa",
        "none",
    )

    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    run(tmp_path / "t1.nii.gz", *options, "--nodes", 2000, "--seed", 1, "-o", output)
    assert not list(elsewhere.iterdir())

    patient = read_patient(output)
    mesh = patient.mesh
    assert (tmp_path / "patient.png").stat().st_size > 100_000
    assert patient.template_map is None
    assert patient.image.sha256 == sha256_of_file(tmp_path / "t1.nii.gz")
    assert 0.8 * 2000 < len(mesh.nodes) < 1.2 * 2000
    assert set(mesh.facets) == {"skull", "tumor"}
    assert any("septa" in warning for warning in patient.warnings)
    assert patient.quality["tumor_pieces"] == 2
    assert len(cKDTree(mesh.nodes).query_pairs(1e-9)) == 0
    # beside the second, the same tumour as that drawn into the labels, in another mesh of the same brain
    other = small_patient.mesh
    volume = mesh.volumes[mesh.region == Region.TUMOR].sum() - 6**3 * 8e-9
    assert volume == pytest.approx(other.volumes[other.region == Region.TUMOR].sum(), rel=0.02)
    distance, _ = cKDTree(other.nodes).query(mesh.nodes)
    assert np.median(distance) > 0.001


def test_what_cannot_be_done_is_said(tmp_path: Path, template_case: tuple[Volume, Volume]) -> None:
    t1, labels = template_case
    write_volume(tmp_path / "t1.nii.gz", t1)
    write_volume(tmp_path / "labels.nii.gz", labels)
    target = ("-o", tmp_path / "p.h5")
    given = (tmp_path / "t1.nii.gz", "--labels", tmp_path / "labels.nii.gz", "--septa", "none")
    with pytest.raises(InputError, match="no such file"):
        run(tmp_path / "other.nii.gz", *target)
    with pytest.raises(InputError, match="its folder does not exist"):
        run(*given, "-o", tmp_path / "nowhere" / "p.h5")
    elsewhere = np.diag([1e-3, 1e-3, 1e-3, 1.0])
    elsewhere[:3, 3] = 0.5
    write_volume(tmp_path / "elsewhere.nii.gz", Volume(np.ones((9, 9, 9), dtype=np.uint8), elsewhere))
    with pytest.raises(InputError, match=r"elsewhere\.nii\.gz: marks no voxel of the T1"):
        run(*given, "--tumor", tmp_path / "elsewhere.nii.gz", *target)
    with pytest.raises(InputError, match="no such file"):
        run(*given, "--septa", tmp_path / "septa.yaml", *target)
    with pytest.raises(InputError, match="holds values other than"):
        run(tmp_path / "t1.nii.gz", "--labels", tmp_path / "t1.nii.gz", "--septa", "none", *target)
    headless = np.where(labels.data == Region.BRAINSTEM, Region.CEREBELLUM, labels.data).astype(np.uint8)
    write_volume(tmp_path / "no_stem.nii.gz", Volume(headless, labels.T_patient_voxel))
    with pytest.raises(InputError, match="hold no brainstem"):
        run(tmp_path / "t1.nii.gz", "--labels", tmp_path / "no_stem.nii.gz", "--septa", "none", *target)
    assert not (tmp_path / "p.h5").exists()
