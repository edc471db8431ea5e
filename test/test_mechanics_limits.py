"""Where the model's methods end (spec E8): near incompressibility, stiff inclusions, slivers, caps and levels at the edge."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from mechanics_cases import box, brain, column, head, ids, outer_facets, plain
from skfem import Basis, Functional, LinearForm
from test_mechanics_elasticity import on_boundary, solve_dirichlet, uniform

from brainshift_ros.errors import InputError
from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.boundary import NodeKind
from brainshift_ros.mechanics.cases import Case
from brainshift_ros.mechanics.elasticity import assemble_stiffness, lame_parameters
from brainshift_ros.mechanics.forward import solve_system
from brainshift_ros.mechanics.materials import GRAVITY, Material
from brainshift_ros.mechanics.space import space_of
from brainshift_ros.mechanics.steady import SteadyModel
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mesh.quality import dihedral_angles_deg

DOWN = (0.0, 0.0, -1.0)
OBLIQUE = (0.1, -0.5, -0.8)


def vortex(x):
    """A divergence-free field that vanishes on the unit cube's boundary, curl of (0, 0, psi), and its Laplacian."""
    waves = [
        (0.5 * (1.0 - np.cos(2.0 * np.pi * t)), np.pi * np.sin(2.0 * np.pi * t),
         2.0 * np.pi**2 * np.cos(2.0 * np.pi * t), -4.0 * np.pi**3 * np.sin(2.0 * np.pi * t))
        for t in x
    ]  # fmt: skip

    def term(i, j, k):
        return waves[0][i] * waves[1][j] * waves[2][k]

    field = np.stack([term(0, 1, 0), -term(1, 0, 0), np.zeros_like(x[0])])
    laplacian = np.stack([
        term(2, 1, 0) + term(0, 3, 0) + term(0, 1, 2), -(term(3, 0, 0) + term(1, 2, 0) + term(1, 0, 2)), np.zeros_like(x[0])
    ])  # fmt: skip
    return field, laplacian


def vortex_error(element, n, poissons_ratio):
    """Relative L2 error; the force -mu lap(u) does not depend on the bulk modulus, and neither does the solution."""
    nodes, elements = box((n, n, n))
    space = space_of(plain(nodes, elements, {"outer": outer_facets(elements)}), element)
    basis = Basis(space.skfem_mesh, space.basis.elem, intorder=6)
    _, mu = lame_parameters(np.array(1.0), np.array(poissons_ratio))
    load = LinearForm(lambda v, w: -mu * np.einsum("i...,i...->...", vortex(w.x)[1], v)).assemble(basis)
    stiffness = assemble_stiffness(space, uniform(len(elements), 1.0, poissons_ratio))
    u = solve_dirichlet(stiffness, np.zeros(3 * len(space)), on_boundary(space), load)
    error = Functional(lambda w: np.sum((w["uh"] - vortex(w.x)[0]) ** 2, axis=0)).assemble(basis, uh=basis.interpolate(u))
    return np.sqrt(error / Functional(lambda w: np.sum(vortex(w.x)[0] ** 2, axis=0)).assemble(basis))


def test_linear_elements_lock_and_quadratic_ones_do_not():
    ratios = (0.45, 0.49, 0.499, 0.4999)
    linear = [vortex_error("P1", 6, ratio) for ratio in ratios]
    quadratic = [vortex_error("P2", 3, ratio) for ratio in ratios]  # on the same nodes
    assert np.all(np.diff(linear) > 0.0)
    assert linear[-1] > 0.99  # nothing moves any more
    assert quadratic[-1] < 1.1 * quadratic[-2] < 0.7
    assert np.all(np.array(quadratic) < 0.7 * np.array(linear))
    # Refined, quadratic elements converge at the end of the scale as well; linear ones do not.
    assert vortex_error("P1", 9, 0.4999) > 0.98
    assert vortex_error("P2", 5, 0.4999) < 0.45 * quadratic[-1]


@pytest.mark.parametrize("poissons_ratio", [0.45, 0.499])
def test_tumour_fifty_times_as_stiff_and_nearly_incompressible(poissons_ratio):
    # Layers in uniaxial strain: u' = rho g (H - z) / M(z), so u is quadratic in each layer.
    mesh = column(10, 0.1, across=2)
    middle = mesh.nodes[mesh.elements].mean(axis=1)[:, 2]
    stiff = (middle > 0.04) & (middle < 0.07)
    E, nu = np.where(stiff, 105_000.0, 2100.0), np.where(stiff, poissons_ratio, 0.45)
    material = Material(E, nu, np.full(len(E), 1000.0))
    u = solve_system(assemble_system(mesh, material, element="P2"), DOWN, 0.0, cap_level=0.99).displacement
    modulus = lambda E, nu: E * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu))  # noqa: E731
    z, exact = mesh.nodes[:, 2], 0.0
    for low, high, M in (
        (0.0, 0.04, modulus(2100.0, 0.45)),
        (0.04, 0.07, modulus(105_000.0, poissons_ratio)),
        (0.07, 0.1, modulus(2100.0, 0.45)),
    ):
        inside = np.clip(z, low, high)
        exact = exact - 1000.0 * GRAVITY / M * (0.1 * (inside - low) - 0.5 * (inside**2 - low**2))
    np.testing.assert_allclose(u[:, 2], exact, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize(("element", "n", "limit"), [("P1", 8, 0.04), ("P2", 5, 0.01)])
def test_locking_stays_in_a_tumour_that_is_nearly_incompressible(element, n, limit):
    # So stiff an inclusion hardly strains: whether it could change its volume decides little, locked or not.
    mesh = head(n)
    material, tumor = brain(mesh), mesh.region == Region.TUMOR
    assert material.youngs_modulus[tumor].min() > 45.0 * material.youngs_modulus[~tumor].max()
    u = [
        solve_system(
            assemble_system(mesh, dataclasses.replace(material, poissons_ratio=np.where(tumor, ratio, 0.45)), element=element),
            OBLIQUE,
            0.4,
        ).displacement
        for ratio in (0.45, 0.4999)
    ]
    assert 0.0 < np.linalg.norm(u[1] - u[0]) < limit * np.linalg.norm(u[0])


def flattened(angle_deg):
    """A box with one element cut in four by a node so close to one of its faces that a dihedral angle is as given."""
    nodes, elements = box((3, 3, 3), jiggle=0.1)
    a, b, c, d = elements[40]
    face, count = nodes[[a, b, c]].mean(axis=0), len(nodes)
    four = np.array([[a, b, c, count], [a, b, count, d], [a, count, c, d], [count, b, c, d]])
    low, high = 0.0, 0.25
    for _ in range(60):
        share = 0.5 * (low + high)
        trial = np.vstack([nodes, face + share * (nodes[d] - face)])
        low, high = (share, high) if dihedral_angles_deg(trial, four).min() < angle_deg else (low, share)
    return trial, np.vstack([np.delete(elements, 40, axis=0), four])


@pytest.mark.parametrize("element", ["P1", "P2"])
@pytest.mark.parametrize("angle_deg", [2.0, 0.1, 1e-3])
def test_slivers_are_reported_and_the_solution_stays_right(element, angle_deg):
    nodes, elements = flattened(angle_deg)
    mesh = plain(nodes, elements, {"outer": outer_facets(elements)}, {"brainstem": ids(nodes[:, 2] == 0.0)})
    assert dihedral_angles_deg(nodes, elements).min() == pytest.approx(angle_deg, rel=1e-3)
    assert (mesh.volumes > 0.0).all()
    warnings = assemble_system(mesh, uniform(len(elements)), element=element).warnings
    assert len(warnings) == (angle_deg < 1.0)
    assert all("dihedral angle below 1 degree" in warning for warning in warnings)
    space = space_of(mesh, element)
    exact = (space.points @ np.array([[0.02, 0.01, -0.03], [0.04, -0.01, 0.02], [0.0, 0.03, 0.05]])).ravel()
    solution = solve_dirichlet(assemble_stiffness(space, uniform(len(elements))), exact, on_boundary(space))
    np.testing.assert_allclose(solution, exact, rtol=0, atol=1e-9)


@pytest.mark.parametrize("element", ["P1", "P2"])
@pytest.mark.parametrize("skull", ["free_cap", "contact"])
def test_no_cap_and_no_slip(element, skull):
    mesh = head(5, sheet=False)
    system = assemble_system(mesh, brain(mesh), element=element)
    sag, closed = {}, {}
    for cap_level in (1.0, 0.6, -0.1):
        model = SteadyModel(system, [OBLIQUE], skull=skull, cap_level=cap_level)
        (block,) = model.solve([Case("gravity", OBLIQUE, 0.4), Case("mannitol", OBLIQUE, 1.0, 0.5)])
        sag[cap_level], closed[cap_level] = np.abs(block.displacement[:, :, 0]).max(), block.closed_normals[0]
        assert np.isfinite(block.displacement).all()
    if skull == "free_cap":
        assert 0.0 < sag[1.0] < sag[0.6] < sag[-0.1]
        assert set(solve_system(system, OBLIQUE, 0.4, cap_level=-0.1).kinds) == {
            NodeKind.INTERIOR,
            NodeKind.FIXED,
            NodeKind.FREE,
        }
    else:
        assert closed[1.0] == 0  # nothing is one-sided: all is held
        assert closed[-0.1] > 0  # below, the skull carries the brain


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_fluid_above_and_below_the_brain(element):
    mesh = head(5)
    system = assemble_system(mesh, brain(mesh), element=element)
    weight = GRAVITY * 1000.0 * mesh.volumes.sum() * np.array(OBLIQUE) / np.linalg.norm(OBLIQUE)

    def total(level):
        return (system.rotation.T @ system.gravity(OBLIQUE, level)).reshape(-1, 3).sum(axis=0)

    for level in (-3.0, -0.01, 0.0):
        np.testing.assert_allclose(total(level), weight, rtol=1e-12)
    for level in (1.0, 1.01, 4.0):
        assert np.all(system.gravity(OBLIQUE, level) == 0.0)
    with pytest.raises(InputError, match="level: is inf"):
        system.gravity(OBLIQUE, np.inf)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_brain_that_nothing_holds_is_refused(element):
    mesh = head(5)
    for node_sets in ({}, {"brainstem": np.zeros(0, np.int32)}):
        with pytest.raises(InputError, match="brainstem node set is empty"):
            assemble_system(dataclasses.replace(mesh, node_sets=node_sets), brain(mesh), element=element)
