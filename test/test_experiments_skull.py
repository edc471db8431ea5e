"""Parts of the study of the skull's model, on a ball with a tumour and a falx."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mechanics_cases import head, patient

from brainshift_ros.experiments.skull import _forward_rows, _Inverse, _summary, _verdict
from brainshift_ros.experiments.skull_cases import SKULLS, TruthCase, Truths, build_memory_atlas
from brainshift_ros.mechanics.forward import solve_system
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.units import mm_to_m

DOWN = (0.0, -0.94, -0.34)
CASE = TruthCase("supine", DOWN, 0.6, False)
LABELS = {"orientation": "supine", "truth's cap": "fluid", "resected": False}


@pytest.fixture(scope="module")
def small_head():
    mesh = head(6)
    return patient(replace(mesh, nodes=mesh.nodes + mm_to_m([-35.0, 45.0, 50.0]) + 0.06 * np.array(DOWN)))


@pytest.fixture(scope="module")
def truths(small_head):
    return Truths(small_head)


def test_measured_points_lie_in_the_opening_and_carry_the_truth_and_its_noise(truths):
    field = np.tile([1e-3, -2e-3, 3e-3], (len(truths.mesh.nodes), 1))
    measured = truths.measured(CASE, field, 2000, 5e-4, np.random.default_rng(0))
    assert np.linalg.norm(measured.points - mm_to_m([-35.0, 45.0, 50.0]), axis=1).max() < 0.036
    noise = measured.displacements - field[0]
    assert noise.std(axis=0) == pytest.approx(np.full(3, 5e-4), rel=0.1)
    assert np.abs(noise.mean(axis=0)).max() < 5e-5
    assert measured.sigma == pytest.approx(np.full(2000, 5e-4))


def test_the_atlas_in_memory_holds_the_reference_s_columns(small_head, truths):
    material = material_of(small_head.tissue)
    systems = {resected: assemble_system(small_head.mesh, material, resected=resected) for resected in (False, True)}
    skull = SKULLS["contact, high cap"]
    atlas, watch = build_memory_atlas(systems, DOWN, np.radians(20.0), 2, (0.4, 0.6), skull)
    assert [entry.resected for entry in atlas.entries] == [False] * 4 + [True] * 4
    assert watch.cpu_s > 0.0
    for column in (1, 6):
        entry = atlas.entries[column]
        expected = solve_system(
            systems[entry.resected],
            entry.gravity_direction,
            entry.fluid_level,
            cap_level=skull.cap_level,
            skull=skull.model,
            opening=truths.opening,
        ).displacement
        assert atlas.E[:, :, column] == pytest.approx(expected, abs=1e-6 * np.abs(expected).max())
    assert atlas.rows([3, 5]) == pytest.approx(atlas.columns(range(8))[[3, 5]])


def test_the_verdict_goes_by_the_estimates_and_settles_ties_forward():
    def errors(estimates, forward):
        by_name = lambda values: {n: {"below the surface": v} for n, v in zip(SKULLS, values, strict=True)}  # noqa: E731
        return {"inverse": by_name(estimates), "forward": by_name(forward)}

    names = list(SKULLS)
    first = lambda verdict: next(n for n in names if verdict.split("best first: ")[1].startswith(n))  # noqa: E731
    assert first(_verdict(errors([0.5, 0.9, 0.6, 0.7], [0.4, 4.0, 0.1, 0.1]))) == names[0]
    assert first(_verdict(errors([0.5, 0.9, 0.6, 0.52], [0.4, 4.0, 0.1, 0.3]))) == names[3]


def test_a_truth_that_is_in_the_atlas_s_theory_is_met_by_that_model_alone(small_head, truths):
    """The study must find the model that made the truth: here a linear truth with contact down to the fluid."""
    made_by = "contact to the fluid"
    truth = truths.linear(CASE, SKULLS[made_by])
    rows = _forward_rows(truths, CASE, truth, LABELS)
    own = [row["error_mm_mean"] for row in rows if row["model"] == made_by]
    assert max(own) < 1e-9
    assert min(row["error_mm_mean"] for row in rows if row["model"] == "free to the fluid" and row["group"] == "deep") > 1e-3
    inverse = _Inverse(small_head)
    rows += inverse.rows(truths, CASE, truth, LABELS, inverse.atlases(DOWN))
    summary = _summary(rows, [], inverse.build_cpu_s)
    assert summary["error_mm_mean"]["inverse"][made_by]["below the surface"] < 1.0
    assert set(summary["build_cpu_s"]) == set(SKULLS)
