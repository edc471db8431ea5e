"""Cases marched together in time: against the steady limit, against a plain solver, and under contact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from hypothesis import given
from hypothesis import strategies as st
from mechanics_cases import head, patient
from scipy.sparse.linalg import spsolve

from brainshift_ros.errors import InputError
from brainshift_ros.mechanics.batches import batches
from brainshift_ros.mechanics.cases import Capillaries, Case
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.stabilization import stabilization
from brainshift_ros.mechanics.steady import SteadyModel
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mechanics.transient import TransientModel
from brainshift_ros.solvers.direct import BLOCK

UP, TILTED, SIDE = (0.0, 0.0, -1.0), (0.2, 0.0, -0.98), (0.0, -0.5, -0.87)
DIRECTIONS = (UP, TILTED, SIDE)
CASES = [
    Case(mechanism, direction, level, intensity)
    for direction in DIRECTIONS
    for mechanism, level, intensity in (
        ("gravity", 0.4, 0.0),
        ("gravity", 0.7, 0.0),
        ("mannitol", 0.4, 0.0),
        ("mannitol", 0.4, 1.0),
        ("swelling", 0.4, 0.5),
    )
]


def system(**options):
    made = patient(head(6))
    return assemble_system(made.mesh, material_of(made.tissue), **options)


def fields(model, cases, **options):
    """Displacement (N, 3, cases), largest residual, and number of closed normals of each case."""
    blocks = list(model.solve(cases, **options))
    order = np.concatenate([block.cases for block in blocks])
    assert sorted(order) == list(range(len(cases)))
    displacement = np.concatenate([block.displacement for block in blocks], axis=2)
    closed = np.concatenate([block.closed_normals for block in blocks])
    back = np.argsort(order)
    return displacement[:, :, back], max(block.residual for block in blocks), closed[back]


@pytest.mark.parametrize(
    ("options", "skull"),
    [({}, "free_cap"), ({}, "contact"), ({"resected": True}, "free_cap"), ({"element": "P2", "septa": False}, "contact")],
    ids=str,
)
def test_after_a_long_time_the_solution_is_the_steady_one(options, skull):
    cases = CASES[:5] if "element" in options else CASES
    if "resected" in options:
        cases = [case for case in CASES if case.mechanism != "swelling"]
    made = system(**options)
    steady, _, steady_closed = fields(SteadyModel(made, DIRECTIONS, skull=skull), cases)
    model = TransientModel(made, DIRECTIONS, duration_s=2e9, dt_s=1e9, skull=skull)
    late, residual, closed = fields(model, cases)
    size = np.abs(steady).max(axis=(0, 1))
    assert (np.abs(late - steady).max(axis=(0, 1)) / size).max() < 1e-7
    assert residual < 1e-9
    assert np.array_equal(closed, steady_closed)


def test_marching_many_at_once_is_marching_each_alone():
    made = system()
    model = TransientModel(made, DIRECTIONS, duration_s=1800.0, dt_s=600.0)
    cases = [case for case in CASES if case.gravity_direction != SIDE]
    together, _, _ = fields(model, cases)
    alone = np.stack([marched(made, case, 3, 600.0) for case in cases], axis=2)
    assert np.abs(together - alone).max() < 1e-9 * np.abs(alone).max()
    single, _, _ = fields(TransientModel(made, DIRECTIONS, duration_s=1800.0, dt_s=600.0, dense_bytes=0.0), cases)
    assert np.abs(together - single).max() < 1e-9 * np.abs(alone).max()


def marched(made, case, count, dt):
    """Backward Euler in SI units by SciPy's general solver: displacement (N, 3)."""
    fluid, capillaries, direction = made.fluid, Capillaries(made), case.gravity_direction
    exchange = capillaries.exchange(case)
    weight = case.mechanism == "gravity"
    force = made.gravity(direction, case.fluid_level) if weight else np.zeros(made.stiffness.shape[0])
    source = fluid.source(exchange, capillaries.pressure(case))
    drained = made.drained(direction, case.fluid_level) if weight else made.stress_free(direction)
    free = np.flatnonzero(~np.append(made.constrained(direction), drained))
    Q, S = made.rotation @ fluid.coupling, stabilization(fluid)
    matrix = sp.bmat([[made.stiffness, -Q], [Q.T, S + dt * fluid.helmholtz(exchange)]]).tocsr()[free][:, free]
    state = np.zeros(len(force) + len(source))
    for _ in range(count):
        u, p = state[: len(force)], state[len(force) :]
        right = np.append(force, Q.T @ u + S @ p + dt * source)
        state[free] = spsolve(matrix.tocsc(), right[free])
    return made.displacement(state[: len(force), None])[:, :, 0]


def test_history_ends_with_the_solution_and_grows_towards_the_steady_one():
    made = system()
    cases = [CASES[0], CASES[2], CASES[3]]
    model = TransientModel(made, [UP], duration_s=7200.0, dt_s=600.0)
    history = model.history(cases, [600.0, 1750.0, 7200.0, 1e9])
    assert history.times_s == pytest.approx([600.0, 1800.0, 7200.0])
    last, residual, _ = fields(model, cases)
    assert np.abs(history.displacement[-1] - last).max() < 1e-9 * np.abs(last).max()
    assert max(history.residual, residual) < 1e-9
    steady, _, _ = fields(SteadyModel(made, [UP]), cases)
    apart = np.linalg.norm(history.displacement - steady, axis=(1, 2)) / np.linalg.norm(steady, axis=(0, 1))
    assert np.all(np.diff(apart, axis=0) < 0.0)
    assert np.all(apart[0] > 0.1)


def test_pressure_is_that_of_air_where_it_drains_and_within_its_range_elsewhere():
    made = system()
    case = Case("gravity", UP, 0.4), Case("mannitol", UP, 0.4, 1.0), Case("swelling", UP, 0.4, 1.0)
    for dt_s in (1e-3, 10.0, 1e5):
        history = TransientModel(made, [UP], duration_s=3 * dt_s, dt_s=dt_s).history(case, [dt_s, 3 * dt_s])
        gravity, mannitol, swelling = np.moveaxis(history.pressure, 2, 0)
        assert np.all(gravity[:, made.drained(UP, 0.4)] == 0.0)
        assert np.all(mannitol[:, made.stress_free(UP)] == 0.0)
        assert mannitol.min() >= -3633.0 * 1.01
        assert mannitol.max() <= 0.01 * np.abs(mannitol).max()
        assert swelling.max() <= 3633.0 * 1.01


@pytest.mark.parametrize("conductivity", [1e-20, 1e-10, 1e-4])
@pytest.mark.parametrize("exchange", [1e-14, 1e-8, 1.0])
def test_extreme_permeabilities_of_tissue_and_capillaries_keep_the_pressure_in_its_range(conductivity, exchange):
    made = patient(head(6))
    count = len(made.tissue)
    usual = material_of(made.tissue)
    extreme = replace(usual, conductivity=np.full(count, conductivity), exchange=np.full((count, 2), exchange))
    solved = assemble_system(made.mesh, extreme)
    model = TransientModel(solved, [UP], duration_s=180.0, dt_s=60.0)
    history = model.history([Case("mannitol", UP, 0.4, 1.0)], [60.0, 180.0])
    pressure = history.pressure[..., 0]
    assert history.residual < 1e-9
    assert pressure.min() >= -3633.0 * 1.01
    assert pressure.max() <= 0.01 * np.abs(pressure).max()
    if exchange == 1.0 and conductivity == 1e-20:
        assert pressure[-1, ~solved.stress_free(UP)] == pytest.approx(-3633.0, rel=1e-3)


def test_tissue_keeps_its_volume_until_fluid_has_left():
    made = system(septa=False)
    case = [Case("gravity", UP, 0.4)]
    at_once = TransientModel(made, [UP], duration_s=1e-6, dt_s=1e-6).history(case, [1e-6])
    later = TransientModel(made, [UP], duration_s=1e9, dt_s=1e9).history(case, [1e9])
    patient_dofs = [h.displacement[0, :, :, 0][made.submesh.parent_node].ravel() for h in (at_once, later)]
    lost, squeezed = (-(made.fluid.coupling.T @ u).sum() for u in patient_dofs)
    inner = ~made.drained(UP, 0.4)
    lost_inside = -(made.fluid.coupling.T @ patient_dofs[0])[inner].sum()
    assert squeezed > 0.0
    assert abs(lost_inside) < 0.25 * abs(squeezed)
    assert abs(lost) < abs(squeezed)


def test_contact_holds_at_every_step():
    made = system()
    closed_skull = np.zeros(len(made.head.nodes), dtype=bool)
    model = TransientModel(made, [UP], duration_s=7200.0, dt_s=1800.0, skull="contact", opening=closed_skull)
    case = [Case("swelling", UP, 0.4, 1.0)]
    _, _, closed = fields(model, case)
    assert closed[0] > 0
    history = model.history(case, [1800.0, 3600.0, 5400.0, 7200.0])
    _, one_sided = made.held_and_one_sided(UP, opening=closed_skull)
    for displacement in history.displacement[..., 0]:
        local = made.rotation @ displacement[made.submesh.parent_node].ravel()
        assert local[one_sided].max() <= 1e-9 * np.abs(local).max()


def test_progress_ends_at_one_and_never_falls():
    seen = []
    model = TransientModel(system(), DIRECTIONS, duration_s=100.0, dt_s=50.0)
    list(model.solve(CASES[:8], progress=lambda stage, fraction: seen.append((stage, fraction))))
    fractions = [fraction for _, fraction in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] == pytest.approx(1.0)
    assert {stage for stage, _ in seen} == {"solve"}


def test_wrong_times_directions_and_missing_tumours_are_refused():
    made = system()
    with pytest.raises(InputError, match="longer than the duration"):
        TransientModel(made, [UP], duration_s=60.0, dt_s=100.0)
    model = TransientModel(made, [UP], duration_s=100.0, dt_s=60.0)
    assert model.steps.count == 2
    with pytest.raises(InputError, match="gravity direction"):
        list(model.solve([Case("gravity", SIDE, 0.4)]))
    assert list(model.solve([])) == []


@given(
    st.lists(st.tuples(st.integers(0, 2), st.integers(0, 5)), min_size=1, max_size=300),
    st.sampled_from([0.0, 8.0 * 40**2 * 3, 1e9]),
)
def test_batches_hold_every_case_once_within_their_limits(cases, dense_bytes):
    rng = np.random.default_rng(1)
    held, one_sided = rng.random((6, 60)) < 0.3, rng.random((6, 60)) < 0.1
    matrices, sets = zip(*cases, strict=True)
    made = list(batches(matrices, sets, lambda one: (held[one], one_sided[one]), dense_bytes))
    assert sorted(number for batch in made for number in batch) == list(range(len(cases)))
    for batch in made:
        assert len(batch) <= BLOCK
        assert len({matrices[number] for number in batch}) == 1
        distinct = list({sets[number] for number in batch})
        variable = ((held[distinct] | one_sided[distinct]).any(axis=0) & ~held[distinct].all(axis=0)).sum()
        assert len(distinct) == 1 or 8 * variable**2 * (1 + len(distinct)) <= dense_bytes
