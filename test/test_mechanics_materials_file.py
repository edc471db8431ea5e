"""The materials file: table 1 as shipped, faults named, and an atlas that is built with it and remembers it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mechanics_cases import head, patient

from brainshift_ros.atlas.build import build_atlas
from brainshift_ros.atlas.file import open_atlas
from brainshift_ros.atlas.scene import Gravity, Scene
from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.materials import TABLE_1
from brainshift_ros.mechanics.materials_file import EXAMPLE, MaterialsFile, read_materials
from brainshift_ros.mesh.patient import Tissue
from brainshift_ros.resources import resource


def test_the_shipped_file_is_table_1() -> None:
    assert dict(read_materials(resource(EXAMPLE))) == dict(TABLE_1)


def test_every_property_says_its_unit() -> None:
    properties = MaterialsFile.model_json_schema()["$defs"]["_Properties"]["properties"]
    assert "Pa" in properties["youngs_modulus_pa"]["description"]
    assert "kg/m^3" in properties["density_kg_m3"]["description"]


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("poissons_ratio: 0.45", "poissons_ratio: 0.5", "white.poissons_ratio"),
        ("youngs_modulus_pa: 100000", "youngs_modulus_pa: -1", "tumor.youngs_modulus_pa"),
        ("youngs_modulus_pa: 100000", "youngs_modulus_kpa: 100", "tumor.youngs_modulus_kpa"),
        ("tumor:", "tumour:", "tumor: Field required"),
        ("density_kg_m3: 1000", "density_kg_m3: .nan", "white.density_kg_m3"),
        ("[2.3e-9, 6.9e-9]", "[-2.3e-9, 6.9e-9]", "white.exchange_per_pa_s"),
        ("biot: 1.0", "biot: 1.5", "white.biot"),
    ],
)
def test_faults_are_named(tmp_path: Path, old: str, new: str, fault: str) -> None:
    path = tmp_path / "materials.yaml"
    text = resource(EXAMPLE).read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(InputError, match=fault):
        read_materials(path)


def test_an_atlas_is_built_with_it_and_remembers_it(tmp_path: Path) -> None:
    model = patient(head(5))
    scene = Scene(gravity=Gravity(direction=(0.0, -0.6, -0.8), cone_deg=25.0, orientations=1, fluid_levels=1))
    soft = {tissue: replace(values, youngs_modulus=0.5 * values.youngs_modulus) for tissue, values in TABLE_1.items()}
    build_atlas(model, scene, tmp_path / "table1.h5")
    build_atlas(model, scene, tmp_path / "soft.h5", materials=soft)
    with open_atlas(tmp_path / "table1.h5") as table1, open_atlas(tmp_path / "soft.h5") as halved:
        assert dict(table1.materials) == dict(TABLE_1)
        assert halved.materials[Tissue.GREY] == soft[Tissue.GREY]
        assert halved.atlas_id != table1.atlas_id
        # half the stiffness everywhere, twice the sag: the model is linear
        np.testing.assert_allclose(halved.columns([0]), 2.0 * table1.columns([0]), rtol=1e-3, atol=1e-9)
