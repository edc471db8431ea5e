"""Weak form of elasticity against exact fields: patch test, rigid modes, energy, convergence rates."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from mechanics_cases import box, outer_facets, plain, split_box
from scipy.spatial.transform import Rotation
from skfem import Basis, BilinearForm, ElementTetP0, Functional, LinearForm
from skfem.helpers import ddot, div, sym_grad

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.clipping import whole_integrals
from brainshift_ros.mechanics.elasticity import assemble_stiffness, lame_parameters
from brainshift_ros.mechanics.materials import TABLE_1, Material, material_of
from brainshift_ros.mechanics.space import space_of
from brainshift_ros.mesh.patient import Tissue
from brainshift_ros.solvers.direct import factorize

STRAIN = np.array([[0.02, 0.01, -0.03], [0.04, -0.01, 0.02], [0.0, 0.03, 0.05]])


def uniform(count, youngs_modulus=2100.0, poissons_ratio=0.45):
    return Material(np.full(count, youngs_modulus), np.full(count, poissons_ratio), np.full(count, 1000.0))


def varied(count, seed=1):
    rng = np.random.default_rng(seed)
    return Material(rng.uniform(500.0, 5000.0, count), rng.uniform(0.1, 0.48, count), np.full(count, 1000.0))


def on_boundary(space):
    """Mask of the dofs on facets named `outer`."""
    mask = np.zeros(len(space), bool)
    mask[space.facets["outer"]] = True
    return np.repeat(mask, 3)


def solve_dirichlet(stiffness, values, known, load=None):
    """Displacement with given values at known dofs."""
    free = np.flatnonzero(~known)
    rhs = (np.zeros(len(values)) if load is None else load) - stiffness @ np.where(known, values, 0.0)
    solution = np.where(known, values, 0.0)
    solution[free] = factorize(stiffness[free][:, free].tocsr()).solve(rhs[free, None])[:, 0]
    return solution


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_patch_test_linear_field_is_reproduced(element):
    nodes, elements = box((4, 3, 4), jiggle=0.25)
    space = space_of(plain(nodes, elements, {"outer": outer_facets(elements)}), element)
    exact = (space.points @ STRAIN.T + 0.1).ravel()
    known = on_boundary(space)
    solution = solve_dirichlet(assemble_stiffness(space, uniform(len(elements))), exact, known)
    assert np.count_nonzero(~known) > 30
    np.testing.assert_allclose(solution, exact, rtol=0, atol=1e-12)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_patch_test_of_each_side_of_a_split_mesh(element):
    # The two halves share no node on the sheet: each takes its own linear field.
    mesh = split_box((4, 3, 3))
    space = space_of(mesh, element)
    right = np.zeros(len(space), bool)
    right[space.elements[mesh.nodes[mesh.elements].mean(axis=1)[:, 0] > 0.04]] = True
    fields = [space.points @ STRAIN.T, -space.points @ STRAIN + 1.0]
    exact = np.where(right[:, None], fields[1], fields[0]).ravel()
    known = np.zeros(len(space), bool)
    known[np.concatenate([space.facets["skull"].ravel(), space.facets["falx"].ravel()])] = True
    assert np.count_nonzero(~known) >= 8
    solution = solve_dirichlet(assemble_stiffness(space, uniform(len(mesh.elements))), exact, np.repeat(known, 3))
    np.testing.assert_allclose(solution, exact, rtol=0, atol=1e-12)


def test_quadratic_elements_reproduce_a_quadratic_field():
    # u = (x^2, xy, -yz): strain is linear, so -div sigma is constant; the nodal load is its integral with each shape function.
    nodes, elements = box((3, 3, 3), jiggle=0.2)
    space = space_of(plain(nodes, elements, {"outer": outer_facets(elements)}), "P2")
    E, nu = 2100.0, 0.45
    lam, mu = lame_parameters(np.array(E), np.array(nu))
    x, y, z = space.points.T
    exact = np.stack([x**2, x * y, -y * z], axis=1).ravel()
    # div u = 3x - y, lap u = (2, 0, 0)
    force = -(np.array([3.0, -1.0, 0.0]) * (lam + mu) + mu * np.array([2.0, 0.0, 0.0]))
    integrals = whole_integrals(space.mesh.volumes, 2)
    load = np.zeros((len(space), 3))
    np.add.at(load, space.elements, integrals[:, :, None] * force)
    solution = solve_dirichlet(
        assemble_stiffness(space, uniform(len(elements), E, nu)), exact, on_boundary(space), load.ravel()
    )
    np.testing.assert_allclose(solution, exact, rtol=0, atol=1e-12)


def test_patch_test_two_stiffnesses_in_series():
    # Without lateral contraction a bar of two materials stretches uniformly in each: E1 e1 = E2 e2.
    nodes, elements = box((2, 2, 4))
    soft = nodes[elements].mean(axis=1)[:, 2] < 0.5
    material = Material(np.where(soft, 2100.0, 100_000.0), np.zeros(len(elements)), np.full(len(elements), 1000.0))
    stiffness = assemble_stiffness(space_of(plain(nodes, elements)), material)
    ratio = 2100.0 / 100_000.0
    stretch = 0.02 / (1.0 + ratio)  # the soft half takes most of the 0.01
    z = nodes[:, 2]
    exact = np.zeros_like(nodes)
    exact[:, 2] = stretch * np.minimum(z, 0.5) + ratio * stretch * np.maximum(z - 0.5, 0.0)
    known = np.zeros_like(nodes, dtype=bool)
    known[np.isclose(z, 0.0) | np.isclose(z, 1.0)] = True
    assert exact[np.isclose(z, 1.0), 2] == pytest.approx(0.01)
    np.testing.assert_allclose(solve_dirichlet(stiffness, exact.ravel(), known.ravel()), exact.ravel(), atol=1e-14)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_six_rigid_modes_and_no_more_are_free(element):
    nodes, elements = box((2, 2, 2), jiggle=0.2)
    space = space_of(plain(nodes, elements), element)
    stiffness = assemble_stiffness(space, varied(len(elements)))
    translations = [np.tile(axis, (len(space), 1)) for axis in np.eye(3)]
    rotations = [np.cross(axis, space.points) for axis in np.eye(3)]
    modes = np.stack([mode.ravel() for mode in translations + rotations], axis=1)
    scale = abs(stiffness).max()
    assert np.abs(stiffness @ modes).max() < 1e-13 * scale
    eigenvalues = np.linalg.eigvalsh(stiffness.toarray())
    assert np.count_nonzero(eigenvalues < 1e-10 * eigenvalues[-1]) == 6
    assert abs(stiffness - stiffness.T).max() < 1e-13 * scale


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_energy_of_uniform_strain_with_properties_of_each_element(element):
    nodes, elements = box((3, 3, 3), jiggle=0.2)
    mesh, material = plain(nodes, elements), varied(len(elements))
    space = space_of(mesh, element)
    field = (space.points @ STRAIN.T).ravel()
    eps = 0.5 * (STRAIN + STRAIN.T)
    lam, mu = lame_parameters(material.youngs_modulus, material.poissons_ratio)
    density = 0.5 * lam * np.trace(eps) ** 2 + mu * np.sum(eps**2)
    assert 0.5 * field @ assemble_stiffness(space, material) @ field == pytest.approx(density @ mesh.volumes, rel=1e-13)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_component_by_component_equals_the_vector_valued_form(element):
    nodes, elements = box((3, 2, 2), jiggle=0.2)
    space, material = space_of(plain(nodes, elements), element), varied(len(elements))
    lam, mu = lame_parameters(material.youngs_modulus, material.poissons_ratio)

    @BilinearForm
    def whole(u, v, w):
        return w.lam * div(u) * div(v) + 2.0 * w.mu * ddot(sym_grad(u), sym_grad(v))

    per_element = space.basis.with_element(ElementTetP0())
    reference = whole.assemble(space.basis, lam=per_element.interpolate(lam), mu=per_element.interpolate(mu))
    stiffness = assemble_stiffness(space, material)
    assert abs(stiffness - reference).max() < 1e-14 * abs(reference).max()
    frames = Rotation.random(len(space), rng=np.random.default_rng(4)).as_matrix()
    rotation = sp.block_diag(frames)
    local = assemble_stiffness(space, material, frames)
    assert abs(local - rotation @ reference @ rotation.T).max() < 1e-14 * abs(reference).max()


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_stiffness_turns_with_the_frame(element):
    nodes, elements = box((2, 3, 2), jiggle=0.2)
    R = Rotation.from_rotvec([0.3, -1.1, 0.7]).as_matrix()
    material = varied(len(elements))
    space, turned = space_of(plain(nodes, elements), element), space_of(plain(nodes @ R.T, elements), element)
    field = np.random.default_rng(3).normal(size=space.points.shape)
    here = (assemble_stiffness(space, material) @ field.ravel()).reshape(-1, 3)
    there = (assemble_stiffness(turned, material) @ (field @ R.T).ravel()).reshape(-1, 3)
    np.testing.assert_allclose(there, here @ R.T, atol=1e-12 * np.abs(here).max())


@pytest.mark.parametrize(("element", "counts", "l2_rate"), [("P1", (5, 10), 2.0), ("P2", (3, 6), 3.0)])
def test_convergence_rates_of_a_manufactured_solution(element, counts, l2_rate):
    # u = a phi, phi = sin(pi x) sin(pi y) sin(pi z), zero on the boundary; f = -(mu lap u + (lam + mu) grad div u).
    a = np.array([1.0, -0.5, 0.7])
    E, nu = 3.0, 0.3
    lam, mu = lame_parameters(np.array(E), np.array(nu))

    def parts(x):
        s, c = np.sin(np.pi * x), np.cos(np.pi * x)
        phi = s[0] * s[1] * s[2]
        gradient = np.pi * np.stack([c[0] * s[1] * s[2], s[0] * c[1] * s[2], s[0] * s[1] * c[2]])
        mixed = np.pi**2 * np.stack([c[0] * c[1] * s[2], c[0] * s[1] * c[2], s[0] * c[1] * c[2]])
        diagonal = -(np.pi**2) * phi
        hessian = np.array([[diagonal, mixed[0], mixed[1]], [mixed[0], diagonal, mixed[2]], [mixed[1], mixed[2], diagonal]])
        force = -(mu * 3.0 * diagonal * a[(...,) + (None,) * phi.ndim] + (lam + mu) * np.einsum("ij...,j->i...", hessian, a))
        return phi, gradient, force

    @LinearForm
    def load(v, w):
        return np.einsum("i...,i...->...", parts(w.x)[2], v)

    @Functional
    def l2(w):
        return np.sum((w["uh"] - np.einsum("i,...->i...", a, parts(w.x)[0])) ** 2, axis=0)

    @Functional
    def h1(w):
        return np.sum((w["uh"].grad - np.einsum("i,j...->ij...", a, parts(w.x)[1])) ** 2, axis=(0, 1))

    errors = []
    for n in counts:
        nodes, elements = box((n, n, n))
        space = space_of(plain(nodes, elements, {"outer": outer_facets(elements)}), element)
        basis = Basis(space.skfem_mesh, space.basis.elem, intorder=5)
        stiffness = assemble_stiffness(space, uniform(len(elements), E, nu))
        u = solve_dirichlet(stiffness, np.zeros(3 * len(space)), on_boundary(space), load.assemble(basis))
        field = basis.interpolate(u)
        errors.append(np.array([np.sqrt(form.assemble(basis, uh=field)) for form in (l2, h1)]))
    rates = np.log2(errors[0] / errors[1])
    assert rates[0] == pytest.approx(l2_rate, abs=0.2)
    assert rates[1] == pytest.approx(l2_rate - 1.0, abs=0.2)


def test_unknown_element_is_refused():
    with pytest.raises(InputError, match="unknown element 'P3'"):
        space_of(plain(*box((1, 1, 1))), "P3")


def test_table_1_is_spread_over_elements():
    material = material_of(np.array([Tissue.WHITE, Tissue.TUMOR, Tissue.GREY], np.uint8))
    np.testing.assert_array_equal(material.youngs_modulus, [2100.0, 100_000.0, 2100.0])
    np.testing.assert_array_equal(material.poissons_ratio, [0.45] * 3)
    assert TABLE_1[Tissue.GREY].density == 1000.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"poissons_ratio": np.array([0.45, 0.5])}, "Poisson"),
        ({"youngs_modulus": np.array([2100.0, 0.0])}, "Young"),
        ({"density": np.array([1000.0, np.nan])}, "density"),
        ({"density": np.ones(3)}, "shapes"),
    ],
)
def test_impossible_materials_are_refused(change, words):
    values = {"youngs_modulus": np.full(2, 2100.0), "poissons_ratio": np.full(2, 0.45), "density": np.full(2, 1000.0)}
    with pytest.raises(InputError, match=words):
        Material(**{**values, **change})


def test_unknown_tissue_is_refused():
    with pytest.raises(InputError, match=r"\[7\]"):
        material_of(np.array([1, 7], np.uint8))
