"""Consolidation in time against analytic series, and at the edges where the pressure would oscillate."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_cases import head

from brainshift_ros.errors import InputError
from brainshift_ros.experiments.consolidation_analytic import CryerSphere, PorousMedium, TerzaghiColumn
from brainshift_ros.experiments.consolidation_problem import ball, column
from brainshift_ros.mechanics.consolidation import BackwardEuler, time_steps
from brainshift_ros.mechanics.fluid import fluid_of
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.space import space_of
from brainshift_ros.mechanics.stabilization import stabilization

WHITE = PorousMedium(2100.0, 0.45, 1e-10)
COMPRESSIBLE = PorousMedium(2100.0, 0.3, 1e-10, biot=0.7, storage=1e-4)
SOFT = PorousMedium(2100.0, 0.2, 1e-10)
HEIGHT, RADIUS, LOAD = 0.1, 0.07, 1000.0

media = st.builds(
    PorousMedium,
    youngs_modulus=st.floats(500.0, 1e5),
    poissons_ratio=st.floats(0.0, 0.49),
    conductivity=st.floats(1e-13, 1e-9),
    biot=st.floats(0.3, 1.0),
    storage=st.sampled_from([0.0, 1e-6, 1e-4]),
)


def talbot(transform, time, count=32):
    """Inverse Laplace transform by a fixed Talbot contour (Abate and Valko 2004)."""
    theta = np.arange(1, count) * np.pi / count
    cot, rate = 1.0 / np.tan(theta), 2.0 * count / (5.0 * time)
    s, slope = rate * theta * (cot + 1j), theta + (theta * cot - 1.0) * cot
    values = sum((np.exp(time * z) * transform(z) * (1.0 + 1j * d)).real for z, d in zip(s, slope, strict=True))
    return rate / count * (0.5 * np.exp(rate * time) * transform(rate) + values)


@settings(max_examples=20, deadline=None)
@given(medium=media, fraction=st.floats(1e-3, 0.5), ratio=st.floats(0.05, 0.95))
def test_cryer_series_is_the_inverse_of_its_laplace_transform(medium, fraction, ratio):
    K, M, G, alpha, c = (
        medium.bulk_modulus,
        medium.confined_modulus,
        medium.shear_modulus,
        medium.biot,
        medium.consolidation,
    )
    time = fraction * RADIUS**2 / c

    def transform(s):
        # The ball's shell carries the load by its shear stiffness too: see the derivation in CryerSphere.
        x = np.sqrt(s / c) * RADIUS
        share = 1.0 / 3.0 - (x / np.tanh(x) - 1.0) / x**2
        level = (LOAD * M / s) / ((alpha**2 + medium.storage * M) * K / alpha + 4.0 * G * alpha * share)
        return level * (1.0 - np.sinh(x * ratio) / (ratio * np.sinh(x)))

    series = CryerSphere(medium, RADIUS, LOAD).pressure(ratio * RADIUS, time)
    assert float(series) == pytest.approx(talbot(transform, time), rel=1e-6, abs=1e-6 * LOAD)


@settings(max_examples=20, deadline=None)
@given(medium=media, fraction=st.floats(0.01, 0.5), ratio=st.floats(0.1, 0.8))
def test_terzaghi_series_solves_its_equation(medium, fraction, ratio):
    series, time, z, c = TerzaghiColumn(medium, 1.0, LOAD), fraction / medium.consolidation, ratio, medium.consolidation
    dz, dt = 1e-3, 1e-4 / c
    below, here, above = series.pressure([z - dz, z, z + dz], time)
    rate = (series.pressure(z, time + dt) - series.pressure(z, time - dt)) / (2.0 * dt)
    assert float(rate) == pytest.approx(c * (above - 2.0 * here + below) / dz**2, rel=1e-3, abs=1e-3 * LOAD * c)
    heights = (np.arange(2000) + 0.5) / 2000
    squeezed = (LOAD - medium.biot * series.pressure(heights, time).mean()) / medium.confined_modulus
    assert series.settlement(time) == pytest.approx(squeezed, rel=1e-5)
    assert series.pressure(1.0, time) == pytest.approx(0.0, abs=1e-9 * LOAD)


def test_time_steps_that_do_not_divide_the_duration_are_all_a_little_shorter():
    steps = time_steps(100.0, 30.0)
    assert (steps.count, steps.dt_s) == (4, 25.0)
    assert time_steps(3600.0, 60.0).count == 60
    assert time_steps(0.3, 0.1).count == 3
    assert [steps.number_at(t) for t in (0.0, 20.0, 60.0, 1e9)] == [1, 1, 2, 4]


@given(duration=st.floats(1e-3, 1e6), share=st.floats(1e-3, 1.0))
def test_time_steps_fill_the_duration(duration, share):
    steps = time_steps(duration, duration * share)
    assert steps.duration_s == pytest.approx(duration)
    assert steps.dt_s <= duration * share * (1.0 + 1e-6)
    assert steps.dt_s > duration * share / 2.0


@pytest.mark.parametrize(
    ("duration", "dt"), [(10.0, 20.0), (0.0, 1.0), (10.0, 0.0), (np.inf, 1.0), (10.0, np.nan), (-1.0, -2.0)]
)
def test_impossible_times_are_refused(duration, dt):
    with pytest.raises(InputError):
        time_steps(duration, dt)


def terzaghi_error(medium, cells, count, element="P1", time=0.1):
    """RMS pressure error relative to the load, relative error of the settlement, and the last state's residual."""
    series = TerzaghiColumn(medium, HEIGHT, LOAD)
    width = 2.0 * HEIGHT / cells
    problem = column(medium, (2, 2, cells), (width, width, HEIGHT), LOAD, element=element)
    duration = time * HEIGHT**2 / medium.consolidation
    *_, last = problem.follow(duration, count)
    error = problem.error(last.pressure[:, 0], series.pressure(problem.space.mesh.nodes[:, 2], duration), LOAD)
    top = np.isclose(problem.space.points[:, 2], HEIGHT)
    sunk = -last.displacement.reshape(-1, 3)[top, 2]
    return error, abs(sunk.mean() / series.settlement(duration) - 1.0), last.residual


@pytest.mark.parametrize("medium", [WHITE, COMPRESSIBLE])
def test_terzaghi_s_column_is_of_first_order_in_time(medium):
    errors = [terzaghi_error(medium, 20, count) for count in (5, 10, 20)]
    assert all(1.7 < longer[0] / shorter[0] < 2.3 for longer, shorter in pairwise(errors))
    assert errors[-1][1] < 0.015
    assert max(residual for *_, residual in errors) < 1e-10


@pytest.mark.parametrize(("element", "medium"), [("P1", WHITE), ("P2", WHITE), ("P1", COMPRESSIBLE)])
def test_terzaghi_s_column_is_of_second_order_in_space(element, medium):
    coarse, fine = (terzaghi_error(medium, cells, 200, element)[0] for cells in (5, 10))
    assert coarse / fine > 3.0
    assert fine < 5e-3


def test_cryer_s_centre_rises_before_it_falls_as_the_series_does():
    sphere, problem = CryerSphere(SOFT, RADIUS, LOAD), ball(SOFT, 8, RADIUS, LOAD)
    centre = int(np.argmin(np.linalg.norm(problem.space.mesh.nodes, axis=1)))
    states = list(problem.follow(0.3 * RADIUS**2 / SOFT.consolidation, 60))
    computed = np.array([state.pressure[centre, 0] for state in states])
    exact = np.array([sphere.pressure(0.0, state.time_s) for state in states])
    assert computed.max() > 1.3 * LOAD
    assert computed[-1] < 0.5 * LOAD
    assert np.abs(computed - exact)[5:].max() < 0.05 * LOAD
    radii = np.linalg.norm(problem.space.mesh.nodes, axis=1)
    assert problem.error(states[-1].pressure[:, 0], sphere.pressure(radii, states[-1].time_s), LOAD) < 0.01


@pytest.mark.parametrize("medium", [WHITE, COMPRESSIBLE, SOFT])
def test_load_is_carried_by_the_fluid_first(medium):
    problem = column(medium, (2, 2, 12), (0.02, 0.02, HEIGHT), LOAD)
    first = next(problem.follow(1e-9 * HEIGHT**2 / medium.consolidation, 1))
    deep = problem.space.mesh.nodes[:, 2] < 0.5 * HEIGHT
    assert first.pressure[deep, 0] == pytest.approx(TerzaghiColumn(medium, HEIGHT, LOAD).undrained_pressure, rel=0.01)


def overshoot(problem, step, term=None, count=3):
    """How far the first steps leave the range from zero to the load, relative to it; steps in units of h^2 / (6 M k)."""
    dt = step * 0.01**2 / (6.0 * WHITE.confined_modulus * WHITE.conductivity)
    states = list(problem.follow(count * dt, count, term))
    return max(max(s.pressure.max() / LOAD - 1.0, -s.pressure.min() / LOAD) for s in states)


def rough_column(element="P1", conductivity=None, medium=WHITE):
    size = (0.03, 0.03, HEIGHT)
    return column(medium, (3, 3, 10), size, LOAD, element=element, irregular=0.25, conductivity=conductivity)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_no_time_step_makes_the_pressure_oscillate(element):
    problem = rough_column(element)
    assert max(overshoot(problem, step) for step in (1e-6, 0.01, 0.1, 1.0, 10.0, 100.0)) < 0.01
    # Without the stabilisation it does, with the "stable" pair P2-P1 too.
    assert overshoot(problem, 0.01, stabilization(problem.fluid, safety=1e-9)) > 0.3


@pytest.mark.parametrize("lower", [1e-10, 1e-14])
@pytest.mark.parametrize("upper", [5e-12, 1e-14])
def test_no_permeability_makes_the_pressure_oscillate(lower, upper):
    problem = rough_column(conductivity=lambda height: np.where(height < HEIGHT / 2.0, lower, upper))
    assert max(overshoot(problem, step) for step in (0.01, 1.0, 100.0)) < 0.01


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.499])
def test_no_poisson_s_ratio_makes_the_pressure_oscillate(nu):
    assert overshoot(rough_column(medium=PorousMedium(2100.0, nu, 1e-10)), 0.01) < 0.02


def test_stored_fluid_does_not_make_the_pressure_oscillate():
    medium = PorousMedium(2100.0, 0.45, 1e-10, storage=1e-4)
    highest = TerzaghiColumn(medium, HEIGHT, LOAD).undrained_pressure / LOAD
    problem = rough_column(medium=medium)
    for step in (0.01, 1.0, 100.0):
        assert overshoot(problem, step) <= 0.01  # never below zero
        *_, last = problem.follow(step * 100.0, 3)
        assert last.pressure.max() < 1.01 * highest * LOAD


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_stabilisation_keeps_constants_and_a_maximum_principle_on_any_element(element):
    mesh = head(6)
    space = space_of(mesh, element)
    tissue = np.where(mesh.nodes[mesh.elements].mean(axis=1)[:, 0] < 0.0, 1, 2).astype(np.uint8)
    made = stabilization(fluid_of(space.basis, material_of(tissue)))
    scale = made.diagonal().max()
    assert np.abs(made @ np.ones(len(mesh.nodes))).max() < 1e-14 * scale
    assert abs(made - made.T).max() < 1e-16 * scale
    assert (made - sp.diags_array(made.diagonal())).max() <= 0.0
    assert np.linalg.eigvalsh(made.toarray()).min() > -1e-14 * scale


def test_step_s_matrix_is_symmetric_with_blocks_of_one_size():
    problem = column(WHITE, (2, 2, 4), (0.02, 0.02, 0.04), LOAD)
    fluid = problem.fluid
    flow = fluid.helmholtz(fluid.material.exchange_at(0.0))
    step = BackwardEuler(problem.stiffness, fluid.coupling, stabilization(fluid), flow, 10.0)
    assert abs(step.matrix - step.matrix.T).max() < 1e-12 * abs(step.matrix).max()
    diagonal, count = step.matrix.diagonal(), problem.stiffness.shape[0]
    assert diagonal[:count].mean() == pytest.approx(-diagonal[count:].mean())
