"""Properties of the fluid phase: table 1, defaults, faults."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.materials import TABLE_1, Material, TissueProperties, material_of
from brainshift_ros.mesh.patient import Tissue

SOLID = {"youngs_modulus": np.full(3, 2100.0), "poissons_ratio": np.full(3, 0.45), "density": np.full(3, 1000.0)}


def test_table_1_of_the_fluid_is_spread_over_elements():
    material = material_of(np.array([Tissue.GREY, Tissue.WHITE, Tissue.TUMOR], np.uint8))
    np.testing.assert_array_equal(material.conductivity, [5e-12, 1e-10, 1e-10])
    np.testing.assert_array_equal(material.exchange, [[11.5e-9, 34.5e-9], [2.3e-9, 6.9e-9], [2.3e-9, 6.9e-9]])
    np.testing.assert_array_equal(material.biot, 1.0)
    np.testing.assert_array_equal(material.storage, 0.0)


def test_drug_levels_are_table_1s_three_permeabilities():
    material = material_of(np.array([Tissue.WHITE, Tissue.GREY], np.uint8))
    levels = np.stack([material.exchange_at(fraction) for fraction in (0.0, 0.5, 1.0)])
    np.testing.assert_allclose(levels, [[2.3e-9, 11.5e-9], [4.6e-9, 23.0e-9], [6.9e-9, 34.5e-9]], rtol=1e-15)


def test_a_material_of_the_solid_alone_has_white_matters_fluid():
    material = Material(**SOLID)
    white = TABLE_1[Tissue.WHITE]
    np.testing.assert_array_equal(material.conductivity, np.full(3, white.conductivity))
    np.testing.assert_array_equal(material.exchange, np.tile(white.exchange, (3, 1)))
    softer = replace(material, youngs_modulus=np.full(3, 1.0))
    np.testing.assert_array_equal(softer.exchange, material.exchange)
    assert softer.select(np.array([0, 2])).exchange.shape == (2, 2)


def test_one_value_stands_for_all_elements():
    material = Material(**SOLID, biot=np.array(0.7), exchange=np.array([1e-9, 2e-9]))
    np.testing.assert_array_equal(material.biot, [0.7] * 3)
    np.testing.assert_array_equal(material.exchange_at(1.0), [2e-9] * 3)


def test_properties_survive_json():
    for properties in TABLE_1.values():
        assert TissueProperties(**json.loads(json.dumps(asdict(properties)))) == properties
    old = {"youngs_modulus": 2100.0, "poissons_ratio": 0.45, "density": 1000.0}  # as files before the fluid phase hold
    assert TissueProperties(**old) == TABLE_1[Tissue.WHITE]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"conductivity": np.array(0.0)}, "hydraulic conductivity"),
        ({"conductivity": np.ones(4)}, r"conductivity has shape \(4,\)"),
        ({"exchange": np.array([-1e-9, 1e-9])}, "capillary permeability"),
        ({"exchange": np.ones((3, 3))}, "exchange has shape"),
        ({"biot": np.array(1.1)}, "Biot"),
        ({"biot": np.array(np.nan)}, "Biot"),
        ({"storage": np.array(-1e-6)}, "storage"),
        ({"storage": np.array(np.inf)}, "storage"),
    ],
)
def test_impossible_fluids_are_refused(change, words):
    with pytest.raises(InputError, match=words):
        Material(**SOLID, **change)
