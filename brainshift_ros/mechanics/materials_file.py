"""Tissue properties from a YAML file that a person may change."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from brainshift_ros.mechanics.materials import TissueProperties
from brainshift_ros.mesh.patient import Tissue
from brainshift_ros.yaml_files import read_yaml, validated

EXAMPLE = "config/materials_table1.yaml"


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Properties(_Part):
    youngs_modulus_pa: float = Field(ge=3.0, le=1e7, description="Young's modulus, Pa; table 1: 2100, tumour 100,000")
    poissons_ratio: float = Field(ge=0.0, lt=0.5, description="Poisson's ratio; linear elements lock as it nears 0.5")
    density_kg_m3: float = Field(ge=500.0, le=3000.0, description="density, kg/m^3")


class MaterialsFile(_Part):
    """What the file holds: a section for each tissue."""

    white: _Properties
    grey: _Properties
    tumor: _Properties


def read_materials(path: str | Path) -> Mapping[Tissue, TissueProperties]:
    """Read the properties of white matter, grey matter and tumour.

    Parameters
    ----------
    path
        YAML file with the keys of ``config/materials_table1.yaml``, all of them.

    Raises
    ------
    InputError
        The file is missing, is not YAML, or a key is unknown, missing or out of range; every fault is named.
    """
    content = validated(path, MaterialsFile, read_yaml(path, "materials file", EXAMPLE), EXAMPLE)
    sections = {Tissue.WHITE: content.white, Tissue.GREY: content.grey, Tissue.TUMOR: content.tumor}
    return {
        tissue: TissueProperties(section.youngs_modulus_pa, section.poissons_ratio, section.density_kg_m3)
        for tissue, section in sections.items()
    }
