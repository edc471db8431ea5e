"""Steady solutions of gravity, mannitol and swelling: analytic columns, plain linear algebra, invariance, refusals."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import scipy.sparse.linalg as spla
from mechanics_cases import box, brain, column, head, outer_facets, plain
from scipy.spatial.transform import Rotation

from brainshift_ros.errors import InputError
from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.cases import MANNITOL_PRESSURE, SWELLING_PRESSURE, Case, peritumoral
from brainshift_ros.mechanics.forward import solve_system
from brainshift_ros.mechanics.materials import Material
from brainshift_ros.mechanics.space import space_of
from brainshift_ros.mechanics.steady import SteadyModel
from brainshift_ros.mechanics.system import assemble_system

DOWN = (0.0, 0.0, -1.0)
OBLIQUE = (0.0, -0.6, -0.8)
HEIGHT = 0.1


def solve(model, cases):
    """Displacement (N, 3, k) of cases in their order."""
    found = {}
    for block in model.solve(cases):
        assert block.residual < 1e-10
        found.update({number: block.displacement[:, :, k] for k, number in enumerate(block.cases)})
    assert sorted(found) == list(range(len(cases)))
    return np.stack([found[number] for number in range(len(cases))], axis=2)


def matter(mesh, conductivity, exchange):
    ones = np.ones(len(mesh.elements))
    return Material(2100.0 * ones, 0.45 * ones, 1000.0 * ones, conductivity * ones, np.outer(ones, exchange))


WHITE, GREY = (1e-10, (2.3e-9, 6.9e-9)), (5e-12, (11.5e-9, 34.5e-9))


def column_errors(layers, element, properties, intensity):
    """Errors of pressure and displacement against the analytic column, relative to their largest values.

    k p'' = k_c (p - p_c) with p = 0 on top and no flux below gives p = p_c (1 - cosh(m z) / cosh(m H)), m^2 = k_c / k.
    Nothing holds the top, so the effective stress is alpha p everywhere: u' = p / M, M the uniaxial modulus.
    """
    mesh = column(layers, HEIGHT)
    system = assemble_system(mesh, matter(mesh, *properties), element=element)
    model = SteadyModel(system, [DOWN], cap_level=0.99)
    case = Case("mannitol", DOWN, 1.0, intensity)
    z = mesh.nodes[:, 2]
    m = np.sqrt(system.material.exchange_at(intensity)[0] / properties[0])
    p = MANNITOL_PRESSURE * (1.0 - np.cosh(m * z) / np.cosh(m * HEIGHT))
    modulus = 2100.0 * 0.55 / (1.45 * 0.1)
    u = MANNITOL_PRESSURE / modulus * (z - np.sinh(m * z) / (m * np.cosh(m * HEIGHT)))
    pressure, displacement = model.pressure([case])[:, 0], solve(model, [case])[:, :, 0]
    assert np.abs(displacement[:, :2]).max() < 0.05 * np.abs(u).max()
    return np.array([np.abs(pressure - p).max() / np.abs(p).max(), np.abs(displacement[:, 2] - u).max() / np.abs(u).max()])


@pytest.mark.parametrize("element", ["P1", "P2"])
@pytest.mark.parametrize(("properties", "intensity"), [(WHITE, 0.0), (WHITE, 1.0), (GREY, 0.5)])
def test_column_shrinks_under_mannitol(element, properties, intensity):
    coarse, fine = (column_errors(layers, element, properties, intensity) for layers in (6, 12))
    rates = np.log2(coarse / fine)
    assert rates[0] > 1.5
    assert rates[1] > (1.85 if element == "P2" else 1.2)
    assert fine[1] < (0.01 if element == "P2" else 0.035)


def test_pressure_of_thin_boundary_layers_does_not_overshoot():
    # k_c3 in grey matter: the layer below the drained top, 12 mm, is as thick as an element.
    mesh = column(8, HEIGHT, across=2)
    model = SteadyModel(assemble_system(mesh, matter(mesh, 1e-13, (0.0, 34.5e-9))), [DOWN], cap_level=0.99)
    pressure = model.pressure([Case("mannitol", DOWN, 1.0, 1.0)])
    assert pressure.min() >= MANNITOL_PRESSURE * (1.0 + 1e-12)
    assert pressure.max() <= 0.0


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_self_weight_column_is_exact_with_quadratic_elements(element):
    # u is quadratic above the fluid and linear below it; the level lies between two layers of elements.
    mesh, level = column(10, HEIGHT, across=2), 0.4
    model = SteadyModel(assemble_system(mesh, brain(mesh), element=element), [DOWN], cap_level=0.99)
    u = solve(model, [Case("gravity", DOWN, level)])[:, :, 0]
    z, modulus = mesh.nodes[:, 2], 2100.0 * 0.55 / (1.45 * 0.1)
    exact = -9810.0 / modulus * ((1.0 - level) * HEIGHT * z - 0.5 * np.maximum(z - level * HEIGHT, 0.0) ** 2)
    error = np.abs(u[:, 2] - exact).max() / np.abs(exact).max()
    assert error < (1e-10 if element == "P2" else 0.05)
    assert np.abs(u[:, :2]).max() < (1e-12 if element == "P2" else 1e-3)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_mannitol_and_swelling_equal_plain_linear_algebra(element):
    mesh = head(4)
    system = assemble_system(mesh, brain(mesh), resected=True, element=element)
    model = SteadyModel(system, [OBLIQUE, DOWN], cap_level=0.6)
    cases = [Case("mannitol", DOWN, 1.0, 0.25), Case("swelling", OBLIQUE, 1.0, 0.5), Case("mannitol", OBLIQUE, 1.0, 0.25)]
    u = solve(model, cases)
    near = peritumoral(mesh)[system.submesh.parent_element]
    assert 0 < np.count_nonzero(near) < len(near)
    for number, case in enumerate(cases):
        exchange = system.material.exchange_at(case.exchange_fraction)
        uniform = np.full(len(near), MANNITOL_PRESSURE)
        capillary = uniform if case.mechanism == "mannitol" else np.where(near, 0.5 * SWELLING_PRESSURE, 0.0)
        open_ = np.flatnonzero(~system.stress_free(case.gravity_direction, 0.6))
        pressure = np.zeros(system.space.vertex_count)
        matrix = system.fluid.helmholtz(exchange)[open_][:, open_]
        pressure[open_] = spla.spsolve(matrix, system.fluid.source(exchange, capillary)[open_])
        free = np.flatnonzero(~system.constrained(case.gravity_direction, 0.6))
        local = np.zeros((3 * len(system.space), 1))
        local[free, 0] = spla.spsolve(system.stiffness[free][:, free], system.pressure_load(pressure)[free])
        expected = system.displacement(local)[:, :, 0]
        assert np.abs(expected).max() > 1e-5
        np.testing.assert_allclose(u[:, :, number], expected, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("element", ["P1", "P2"])
@pytest.mark.parametrize("skull", ["free_cap", "contact"])
def test_many_gravity_cases_equal_one_by_one(element, skull):
    mesh = head(4)
    system = assemble_system(mesh, brain(mesh), element=element)
    directions = [OBLIQUE, DOWN, (0.6, 0.0, -0.8)]
    cases = [Case("gravity", direction, level) for level, direction in zip((0.3, 0.7, 0.5), directions, strict=True)]
    u = solve(SteadyModel(system, directions, skull=skull, cap_level=0.6), cases)
    for number, case in enumerate(cases):
        alone = solve_system(system, case.gravity_direction, case.fluid_level, skull=skull, cap_level=0.6).displacement
        np.testing.assert_allclose(u[:, :, number], alone, atol=1e-11 * np.abs(alone).max())


def test_solutions_are_superposed():
    mesh = head(6)
    system = assemble_system(mesh, brain(mesh))
    model = SteadyModel(system, [OBLIQUE])
    gravity, mannitol = Case("gravity", OBLIQUE, 0.4), Case("mannitol", OBLIQUE, 1.0, 0.5)
    u = solve(model, [gravity, mannitol, Case("swelling", OBLIQUE, 1.0, 1.0), Case("swelling", OBLIQUE, 1.0, 0.25)])
    load = system.gravity(OBLIQUE, 0.4) + system.pressure_load(model.pressure([mannitol])[:, 0])
    free = np.flatnonzero(~system.constrained(OBLIQUE))
    local = np.zeros((len(load), 1))
    local[free, 0] = spla.spsolve(system.stiffness[free][:, free], load[free])
    both = system.displacement(local)[:, :, 0]
    np.testing.assert_allclose(u[:, :, 0] + u[:, :, 1], both, atol=1e-11 * np.abs(both).max())
    np.testing.assert_allclose(u[:, :, 3], 0.25 * u[:, :, 2], atol=1e-12 * np.abs(u[:, :, 2]).max())


def test_gravity_alone_makes_no_pressure_matrices():
    mesh = head(5)
    system = assemble_system(mesh, brain(mesh))
    model = SteadyModel(system, [OBLIQUE])
    solve(model, [Case("gravity", OBLIQUE, 0.4)])
    assert "fluid" not in vars(system)
    solve(model, [Case("mannitol", OBLIQUE, 1.0, 0.0)])
    assert "fluid" in vars(system)


@pytest.mark.parametrize("element", ["P1", "P2"])
@pytest.mark.parametrize("skull", ["free_cap", "contact"])
def test_turning_the_whole_problem_turns_the_answer(element, skull):
    mesh = head(5)
    R = Rotation.from_rotvec([0.4, 1.3, -0.8]).as_matrix()
    turned = dataclasses.replace(mesh, nodes=mesh.nodes @ R.T + np.array([0.3, -0.2, 0.1]))
    there = tuple((R @ OBLIQUE).tolist())
    levels = (("gravity", 0.4, 0.0), ("mannitol", 1.0, 0.5), ("swelling", 1.0, 1.0))

    def solutions(mesh, direction):
        model = SteadyModel(assemble_system(mesh, brain(mesh), element=element), [direction], skull=skull, cap_level=0.61)
        return solve(model, [Case(mechanism, direction, level, intensity) for mechanism, level, intensity in levels])

    here = solutions(mesh, OBLIQUE)
    np.testing.assert_allclose(solutions(turned, there), np.einsum("ij,njk->nik", R, here), atol=1e-9 * np.abs(here).max())


def test_units_do_not_matter():
    # Lengths in mm instead of m, with E and k scaled so that the dimensionless groups rho g L / E and k_c L^2 / k stay.
    mesh = head(5)
    material = brain(mesh)
    large = dataclasses.replace(mesh, nodes=1000.0 * mesh.nodes)
    stiff = dataclasses.replace(material, youngs_modulus=1000.0 * material.youngs_modulus)
    open_ = dataclasses.replace(material, conductivity=1e6 * material.conductivity)
    gravity, mannitol = [Case("gravity", OBLIQUE, 0.4)], [Case("mannitol", OBLIQUE, 1.0, 0.5)]
    for cases, scaled in ((gravity, stiff), (mannitol, open_)):
        here = solve(SteadyModel(assemble_system(mesh, material), [OBLIQUE]), cases)
        there = solve(SteadyModel(assemble_system(large, scaled), [OBLIQUE]), cases)
        np.testing.assert_allclose(there / 1000.0, here, atol=1e-11 * np.abs(here).max())


def test_swelling_pushes_the_tissue_away_from_the_tumour():
    mesh = head(8)
    model = SteadyModel(assemble_system(mesh, brain(mesh)), [OBLIQUE])
    u = solve(model, [Case("swelling", OBLIQUE, 1.0, 1.0)])[:, :, 0]
    near = peritumoral(mesh)
    corners = mesh.nodes[mesh.elements]
    gradients = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    divergence = np.einsum("mij,mji->m", gradients, u[mesh.elements[:, 1:]] - u[mesh.elements[:, :1]])
    assert divergence[near] @ mesh.volumes[near] > 0.0
    tumor = mesh.region == Region.TUMOR
    assert near[tumor].all()
    distance = np.linalg.norm(corners.mean(axis=1)[:, None] - mesh.nodes[np.unique(mesh.elements[tumor])], axis=2).min(axis=1)
    np.testing.assert_array_equal(near, tumor | (distance <= 0.02))


def test_linear_and_quadratic_elements_agree_as_the_mesh_is_refined():
    differences = []
    for n in (3, 6):
        nodes, elements = box((n, n, n), (0.08,) * 3)
        facets = {"skull": outer_facets(elements)}
        mesh = plain(nodes, elements, facets, {"brainstem": np.flatnonzero(nodes[:, 2] == 0.0).astype(np.int32)})
        cases = [Case("gravity", OBLIQUE, 0.4), Case("mannitol", OBLIQUE, 1.0, 0.0)]
        linear, quadratic = (
            solve(SteadyModel(assemble_system(mesh, brain(mesh), element=element), [OBLIQUE]), cases)
            for element in ("P1", "P2")
        )
        differences.append(np.linalg.norm(linear - quadratic, axis=(0, 1)) / np.linalg.norm(quadratic, axis=(0, 1)))
    assert (differences[1] < 0.7 * differences[0]).all()


def test_progress_and_blocks(monkeypatch):
    monkeypatch.setattr("brainshift_ros.mechanics.steady.BLOCK", 2)
    mesh = head(5)
    model = SteadyModel(assemble_system(mesh, brain(mesh)), [OBLIQUE, DOWN])
    kinds = (("gravity", 0.3), ("mannitol", 1.0), ("gravity", 0.7))
    cases = [Case(mechanism, direction, level) for mechanism, level in kinds for direction in (OBLIQUE, DOWN)]
    seen = []
    numbers = [block.cases for block in model.solve(cases, lambda stage, fraction: seen.append((stage, fraction)))]
    assert numbers == [[0, 4], [1, 5], [2, 3]]
    assert seen == [("solve", pytest.approx(done / 3)) for done in (1, 2, 3)]


def test_faults_are_named():
    mesh = head(5)
    healthy = dataclasses.replace(mesh, region=np.ones_like(mesh.region))
    model = SteadyModel(assemble_system(healthy, brain(healthy)), [OBLIQUE])
    with pytest.raises(InputError, match="is none of the model's"):
        next(model.solve([Case("gravity", DOWN, 0.4)]))
    with pytest.raises(InputError, match="no tumour whose surroundings"):
        next(model.solve([Case("swelling", OBLIQUE, 1.0, 1.0)]))
    with pytest.raises(InputError, match="unknown mechanism 'levity'"):
        Case("levity", OBLIQUE, 0.4)
    with pytest.raises(InputError, match=r"intensity is 1\.5"):
        Case("mannitol", OBLIQUE, 0.4, 1.5)
    with pytest.raises(InputError, match="unknown model 'glued'"):
        SteadyModel(assemble_system(healthy, brain(healthy)), [OBLIQUE], skull="glued")
    assert space_of(healthy).order == 1
