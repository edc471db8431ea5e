"""The fluid phase: its matrices against integrals known by hand, and a Helmholtz problem against its analytic solution."""

from __future__ import annotations

import numpy as np
import pytest
from mechanics_cases import box, plain
from scipy.sparse.linalg import spsolve

from brainshift_ros.mechanics.fluid import fluid_of
from brainshift_ros.mechanics.materials import Material
from brainshift_ros.mechanics.space import space_of


def material(count, conductivity=1e-10, exchange=(2e-9, 6e-9), biot=1.0, storage=0.0):
    every = np.ones(count)
    conductivity, biot = np.broadcast_to(conductivity, count), np.broadcast_to(biot, count)
    return Material(2100.0 * every, 0.45 * every, 1000.0 * every, conductivity, np.array(exchange), biot, np.array(storage))


def fluid(nodes, elements, element="P1", **values):
    space = space_of(plain(nodes, elements), element)
    return space, fluid_of(space.basis, material(len(elements), **values))


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_coupling_is_the_fluid_that_a_displacement_draws_in(element):
    nodes, elements = box((3, 2, 2), (0.3, 0.2, 0.1), jiggle=0.2)
    space, made = fluid(nodes, elements, element, biot=0.8)
    gradient = np.array([[0.1, 0.2, 0.0], [-0.3, 0.4, 0.1], [0.0, 0.5, -0.2]])
    displacement = (space.points @ gradient.T).ravel()
    pressure = 3.0 + nodes @ [1.0, -2.0, 0.5]
    mean = 3.0 + np.array([0.15, 0.1, 0.05]) @ [1.0, -2.0, 0.5]
    expected = 0.8 * np.trace(gradient) * mean * 0.3 * 0.2 * 0.1
    assert displacement @ made.coupling @ pressure == pytest.approx(expected, rel=1e-12)


def test_coupling_sees_the_curvature_of_quadratic_displacements():
    nodes, elements = box((2, 2, 2), jiggle=0.2)
    space, made = fluid(nodes, elements, "P2")
    displacement = np.zeros((len(space), 3))
    displacement[:, 0] = space.points[:, 0] ** 2
    # The integral of 2 x times x over the unit cube.
    assert displacement.ravel() @ made.coupling @ nodes[:, 0] == pytest.approx(2.0 / 3.0, rel=1e-12)


def test_constant_pressure_loads_only_the_boundary():
    nodes, elements = box((4, 4, 4), jiggle=0.2)
    _, made = fluid(nodes, elements)
    load = (made.coupling @ np.ones(len(nodes))).reshape(-1, 3)
    inner = np.all((nodes > 0.0) & (nodes < 1.0), axis=1)
    assert np.abs(load[inner]).max() < 1e-15
    assert load[nodes[:, 2] == 1.0, 2].sum() == pytest.approx(1.0)


def test_conductance_has_each_element_s_own_conductivity():
    nodes, elements = box((4, 2, 2), jiggle=0.1)
    conductivity = np.linspace(1e-12, 1e-10, len(elements))
    _, made = fluid(nodes, elements, conductivity=conductivity)
    pressure = nodes @ [1.0, 2.0, -1.0]
    assert pressure @ made.conductance @ pressure == pytest.approx(6.0 * (conductivity * made.volume).sum(), rel=1e-12)
    assert np.abs(made.conductance @ np.ones(len(nodes))).max() < 1e-22


def test_lumped_masses_hold_the_whole_volume():
    nodes, elements = box((3, 3, 3), (0.1, 0.2, 0.3), jiggle=0.2)
    _, made = fluid(nodes, elements)
    assert made.lumped(np.full(len(elements), 2.0)).sum() == pytest.approx(2.0 * 0.006)
    assert np.all(made.lumped(np.ones(len(elements))) > 0.0)


def slab(cells, conductivity, exchange, length=0.1):
    """Steady pressure of a slab whose capillaries suck with -1000 Pa, drained at x = 0; nodes and pressure."""
    nodes, elements = box((cells, 1, 1), (length, length / cells, length / cells))
    _, made = fluid(nodes, elements, conductivity=conductivity, exchange=(exchange, exchange))
    k_c = made.material.exchange_at(0.0)
    source, free = made.source(k_c, np.full(len(elements), -1000.0)), nodes[:, 0] > 0.0
    pressure = np.zeros(len(nodes))
    pressure[free] = spsolve(made.helmholtz(k_c)[free][:, free], source[free])
    return nodes, pressure


def test_steady_pressure_of_a_slab_converges_to_the_analytic_one():
    reach = np.sqrt(1e-10 / 1e-7)
    errors = []
    for cells in (8, 16, 32):
        nodes, pressure = slab(cells, 1e-10, 1e-7)
        exact = -1000.0 * (1.0 - np.cosh((0.1 - nodes[:, 0]) / reach) / np.cosh(0.1 / reach))
        errors.append(np.abs(pressure - exact).max())
    assert np.log2(errors[0] / errors[1]) > 1.7
    assert np.log2(errors[1] / errors[2]) > 1.7
    assert errors[-1] < 2.0


@pytest.mark.parametrize("conductivity", [1e-10, 1e-14, 1e-20])
@pytest.mark.parametrize("exchange", [1e-8, 1e-3])
def test_steady_pressure_stays_between_that_of_capillaries_and_air(conductivity, exchange):
    nodes, pressure = slab(10, conductivity, exchange)
    assert pressure.min() >= -1000.0 * (1.0 + 1e-9)
    assert pressure.max() <= 1e-6
    if conductivity / exchange < 1e-8:  # a boundary layer thinner than an element
        assert pressure[nodes[:, 0] > 0.0] == pytest.approx(-1000.0, rel=1e-3)
