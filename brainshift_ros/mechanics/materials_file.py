"""Tissue properties from a YAML file that a person may change."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from brainshift_ros.mechanics.materials import TABLE_1, TissueProperties
from brainshift_ros.mesh.patient import Tissue
from brainshift_ros.yaml_files import read_yaml, validated

EXAMPLE = "config/materials_table1.yaml"

_Permeability = Annotated[float, Field(ge=0.0, le=1e-3)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Properties(_Part):
    youngs_modulus_pa: float = Field(ge=3.0, le=1e7, description="Young's modulus, Pa; table 1: 2100, tumour 100,000")
    poissons_ratio: float = Field(ge=0.0, lt=0.5, description="Poisson's ratio; linear elements lock as it nears 0.5")
    density_kg_m3: float = Field(ge=500.0, le=3000.0, description="density, kg/m^3")
    conductivity_m3_s_kg: float | None = Field(None, ge=1e-15, le=1e-6, description="hydraulic conductivity k, m^3 s/kg")
    exchange_per_pa_s: tuple[_Permeability, _Permeability] | None = Field(
        None, description="capillary permeability k_c without the drug and at its largest effect, 1/(Pa s)"
    )
    biot: float | None = Field(None, ge=0.0, le=1.0, description="Biot's coefficient alpha")
    storage_per_pa: float | None = Field(None, ge=0.0, le=1e-2, description="storage 1/S, 1/Pa")

    def fluid(self) -> dict[str, float | tuple[float, float]]:
        """Give what the file says of the fluid phase, by the names of TissueProperties."""
        given = {
            "conductivity": self.conductivity_m3_s_kg,
            "exchange": self.exchange_per_pa_s,
            "biot": self.biot,
            "storage": self.storage_per_pa,
        }
        return {name: value for name, value in given.items() if value is not None}


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
        YAML file with the keys of ``config/materials_table1.yaml``; those of the fluid phase may be left out and are then
        table 1's.

    Raises
    ------
    InputError
        The file is missing, is not YAML, or a key is unknown, missing or out of range; every fault is named.
    """
    content = validated(path, MaterialsFile, read_yaml(path, "materials file", EXAMPLE), EXAMPLE)
    sections = {Tissue.WHITE: content.white, Tissue.GREY: content.grey, Tissue.TUMOR: content.tumor}
    return {
        tissue: replace(
            TABLE_1[tissue],
            youngs_modulus=section.youngs_modulus_pa,
            poissons_ratio=section.poissons_ratio,
            density=section.density_kg_m3,
            **section.fluid(),  # type: ignore[arg-type]
        )
        for tissue, section in sections.items()
    }
