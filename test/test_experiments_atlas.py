"""Studies of what an atlas needs: their truths, counts and verdicts, on a ball with a tumour and a falx."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_cases import head, patient

from brainshift_ros.atlas.entry import AtlasEntry
from brainshift_ros.experiments import atlas_content, atlas_extent, atlas_levels, atlas_size, inverse_cases
from brainshift_ros.experiments.atlas_studies import (
    AS_THESIS,
    INDEPENDENT,
    NOISE_M,
    POINTS,
    Judge,
    at_orientation,
    column_truth,
    degrees_from_plan,
    measure_nodes,
    polar,
    signed_rank_p,
    solve_together,
    weights_told,
)
from brainshift_ros.experiments.inverse_cases import Targets, study_atlas, study_scene, subset
from brainshift_ros.experiments.inverse_truths import CONE_DEG, PLANNED, TruthSpec, solve_truth, tilted
from brainshift_ros.experiments.patients import craniotomy_opening, patient_path
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mechanics.system import assemble_system
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.mesh.patient_file import patient_digest, write_patient
from brainshift_ros.units import mm_to_m


def silent(stage, fraction):
    pass


def ball(n):
    mesh = head(n)
    model = patient(replace(mesh, nodes=mesh.nodes + mm_to_m([-35.0, 45.0, 50.0]) + 0.06 * np.array(PLANNED)))
    return replace(model, patient_id=patient_digest(model.mesh, model.tissue, model.cortex, model.image))


@pytest.fixture(scope="module")
def small_patient():
    return ball(6)


@pytest.fixture(scope="module")
def atlas(small_patient, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inverse_cases, "template_patient", lambda *_: small_patient)
        return study_atlas(tmp_path_factory.mktemp("atlas"), study_scene(orientations=7, skull="free_cap"), silent, nodes=200)


@pytest.mark.parametrize("skull", ["free_cap", "contact"])
def test_truths_solved_together_are_those_solved_alone(small_patient, skull):
    specs = [
        TruthSpec(seed, tilted(PLANNED, angle, azimuth), level, resected, skull=skull, stiffness_spread=0.25)
        for seed, angle, azimuth, level, resected in [
            (0, 0.1, 0.0, 0.5, True),
            (1, 0.3, 1.0, 0.4, False),
            (0, 0.5, 2.0, 0.6, True),
        ]
    ]
    for spec, together in zip(specs, solve_together(small_patient, specs), strict=True):
        alone = solve_truth(small_patient, spec)
        assert together.spec == spec
        assert together.tissue.tolist() == alone.tissue.tolist()
        assert together.displacement == pytest.approx(alone.displacement, abs=1e-9 * np.abs(alone.displacement).max())


@pytest.mark.parametrize("change", [{"mannitol": 0.2}, {"surface_shift_mm": 5.0}, {"finite_strain": True}])
def test_what_cannot_be_solved_together_is_refused(small_patient, change):
    with pytest.raises(ValueError, match="gravity at its own size"):
        solve_together(small_patient, [replace(TruthSpec(0, PLANNED, 0.5), **change)])


@pytest.mark.parametrize("mechanism", ["gravity", "mannitol"])
@pytest.mark.parametrize("resected", [False, True])
def test_a_column_taken_for_the_truth_carries_tissue_where_it_was_solved(atlas, small_patient, mechanism, resected):
    column = next(k for k, entry in enumerate(atlas.entries) if (entry.mechanism, entry.resected) == (mechanism, resected))
    truth = column_truth(atlas, column)
    system = assemble_system(small_patient.mesh, material_of(small_patient.tissue), resected=resected)
    assert truth.tissue.tolist() == (system.submesh.node_of >= 0).tolist()
    assert truth.displacement == pytest.approx(atlas.E[:, :, column])
    assert (truth.spec.mannitol > 0.0) == (mechanism == "mannitol")
    measured = measure_nodes(truth)
    opening = craniotomy_opening(truth.mesh) & truth.tissue
    opening[np.unique(truth.mesh.facets["falx"])] = False
    assert 0 < len(measured.points) <= opening.sum()
    nodes = [int(np.flatnonzero((truth.mesh.nodes == point).all(axis=1))[0]) for point in measured.points]
    assert opening[nodes].all()
    assert measured.displacements == pytest.approx(truth.displacement[nodes])


def test_an_exact_column_is_found_in_the_atlas_and_missed_once_its_orientation_is_left_out(atlas):
    judge = Judge(atlas.mesh)
    direction = atlas.entries[-1].gravity_direction
    own = at_orientation(atlas, direction)
    column = next(k for k in np.flatnonzero(own) if atlas_size.is_middle(atlas.entries[k]))
    truth = column_truth(atlas, int(column))
    within, without = (
        judge.rows(chosen, truth, measure_nodes(truth), AS_THESIS.options) for chosen in (atlas, subset(atlas, ~own))
    )
    assert max(row["error_mm"] for row in within) < 1e-3
    assert max(row["orientation_error_deg"] for row in within) < 0.1
    assert min(row["error_mm"] for row in without if row["group"] == "surface") > 0.01
    assert own.sum() == 12


def test_the_judge_s_errors_are_those_of_an_estimate(atlas, small_patient):
    """It locates a mesh's nodes once; the second truth on that mesh, and one on another, must not take the first's errors."""
    judge = Judge(atlas.mesh)
    specs = [TruthSpec(0, PLANNED, 0.5), TruthSpec(0, tilted(PLANNED, 0.3, 1.0), 0.4, resected=True)]
    for number, truth in enumerate([*solve_together(small_patient, specs), *solve_together(ball(5), specs)]):
        measured = INDEPENDENT.measured(truth, np.random.default_rng(number))
        assert len(measured.points) == POINTS
        assert measured.sigma == pytest.approx(np.full(POINTS, NOISE_M))
        locator = PointLocator(atlas.mesh)
        field = estimate_shift(atlas, measured, locator=locator).field.displacement
        expected = {row["group"]: row["error_mm"] for row in Targets(truth, atlas, locator).errors(field)}
        found = {row["group"]: row["error_mm"] for row in judge.rows(atlas, truth, measured, INDEPENDENT.options)}
        assert found == pytest.approx(expected)


def test_what_the_weights_say():
    entries = [
        AtlasEntry("gravity", (0.0, 0.0, -1.0), 0.5, 0, False),
        AtlasEntry("gravity", (0.0, -1.0, 0.0), 0.5, 0, False),
        AtlasEntry("mannitol", (0.0, 0.0, -1.0), 1.0, 1, False),
        AtlasEntry("mannitol", (0.0, -1.0, 0.0), 1.0, 1, False),
    ]
    told = weights_told(entries, np.array([0.3, 0.496, 0.2, 0.004]), (0.0, -1.0, 0.0))
    assert (told["nonzero"], told["nonzero_1_percent"]) == (4, 3)
    assert told["weight_sum"] == pytest.approx(1.0)
    assert told["mannitol_share"] == pytest.approx(0.204)
    assert told["orientation_error_deg"] == pytest.approx(45.0)
    nothing = weights_told(entries, np.zeros(4), (0.0, -1.0, 0.0))
    assert nothing["nonzero"] == nothing["nonzero_1_percent"] == 0
    assert np.isnan(nothing["mannitol_share"])
    assert np.isnan(nothing["orientation_error_deg"])


def test_tilted_truths_lie_at_every_angle_all_around_and_are_the_same_with_resection():
    specs = atlas_extent.tilted_specs(AS_THESIS, 8)
    angles = np.array([degrees_from_plan(spec.direction) for spec in specs]).reshape(2, len(atlas_extent.ANGLES_DEG), 8)
    assert angles == pytest.approx(np.broadcast_to(np.array(atlas_extent.ANGLES_DEG)[:, None], angles.shape), abs=1e-6)
    half = len(specs) // 2
    assert [replace(spec, resected=True) for spec in specs[:half]] == specs[half:]
    _, azimuth = polar(np.array([spec.direction for spec in specs[:8]]))
    assert np.diff(np.sort(azimuth)) == pytest.approx(np.full(7, np.pi / 4))
    assert min(atlas_extent.ANGLES_DEG) < CONE_DEG < max(atlas_extent.ANGLES_DEG) < atlas_extent.WIDE_DEG


def extent_rows(outside_mm, resected_mm):
    rng = np.random.default_rng(0)
    return [
        {
            "setting": setting.name,
            "cone_deg": cone,
            "angle_deg": angle,
            "resected": resected,
            "truth": number,
            "group": group,
            "error_mm": 0.5 + outside_mm * (angle > CONE_DEG) + resected_mm * resected + noise,
        }
        for setting in (AS_THESIS, INDEPENDENT)
        for cone in (CONE_DEG, atlas_extent.WIDE_DEG)
        for group in ("surface", "subsurface")
        for number in range(4)
        for angle in atlas_extent.ANGLES_DEG
        for noise in rng.uniform(0.0, 0.05, 1)
        for resected in (False, True)
    ]


@pytest.mark.parametrize(
    ("outside_mm", "resected_mm", "said"),
    [
        (1.0, 0.2, ("larger outside the cone", "larger with resection:")),
        (0.0, 0.0, ("not larger outside", "not larger with resection")),
        (-0.3, -0.2, ("not larger outside", "not larger with resection")),
    ],
)
def test_the_verdict_on_extent_follows_the_errors(outside_mm, resected_mm, said):
    summary = atlas_extent.summary_of(extent_rows(outside_mm, resected_mm))
    for words in said:
        assert summary["thesis_holds_here"].count(words) == 2
    surface = summary["median_error_mm"]["independent"]["cone of 20 degrees"]["tumour present"]["surface"]
    assert surface["outside"] - surface["inside"] == pytest.approx(outside_mm, abs=0.03)


def test_the_size_from_which_errors_stay_level():
    assert atlas_size.settled_from({5: 2.0, 14: 1.05, 21: 1.3, 30: 1.02, 59: 1.0}) == 30
    assert atlas_size.settled_from({5: 1.0, 14: 1.01, 59: 1.0}) == 5
    assert atlas_size.settled_from({5: 3.0, 14: 2.0, 59: 1.0}) == 59


def test_levels_are_ranked_by_the_shift_that_they_cause(atlas):
    largest = [np.linalg.norm(atlas.E[:, :, column], axis=1).max() for column in range(len(atlas.entries))]
    for ranks, better in (({3}, np.greater_equal), ({1}, np.less_equal)):
        kept = atlas_levels.of_levels(atlas, frozenset(ranks))
        assert len(kept.entries) == len(atlas.entries) // 3
        for entry, own in zip(kept.entries, np.linalg.norm(kept.E, axis=1).max(axis=0), strict=True):
            same = [
                shift
                for other, shift in zip(atlas.entries, largest, strict=True)
                if replace(other, fluid_level=0.0, drug_level=0, intensity=0.0)
                == replace(entry, fluid_level=0.0, drug_level=0, intensity=0.0)
            ]
            assert len(same) == 3
            assert better(own, same).all()
    assert atlas_levels.of_levels(atlas, frozenset({1, 2, 3})).entries == atlas.entries


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_the_power_of_components_is_that_of_singular_values(rows, columns, seed):
    matrix = np.random.default_rng(seed).normal(size=(rows, columns))
    singular = np.linalg.svd(matrix, compute_uv=False) ** 2
    found = atlas_content.power(matrix)
    assert found == pytest.approx(singular / singular.sum(), abs=1e-12)
    assert atlas_content.components_for(found, 1.0 - 1e-9) == len(singular)
    count = atlas_content.components_for(found, 0.9)
    assert found[:count].sum() >= 0.9 > found[: count - 1].sum()


def test_equal_pairs_differ_with_no_significance():
    assert signed_rank_p(np.ones(5), np.ones(5)) == 1.0
    assert signed_rank_p(np.arange(10.0), np.arange(10.0) + 1.0 + 0.01 * np.arange(10)) < 0.01


@pytest.fixture
def study_folder(tmp_path):
    """A folder in which both meshes of a short study are balls."""
    for seed, model in enumerate((ball(5), ball(6))):
        write_patient(patient_path(tmp_path, 3_000, seed), model)
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("study", "picture"),
    [
        (atlas_extent, "atlas_extent.png"),
        (atlas_size, "atlas_size.png"),
        (atlas_levels, "atlas_levels.png"),
        (atlas_content, "atlas_content.png"),
    ],
)
def test_a_study_runs_through_and_says_whether_the_thesis_holds(study, picture, study_folder):
    summary = study.run(study_folder, False, silent)
    written = json.loads((study_folder / "summary.json").read_text())
    assert written["thesis_holds_here"] == summary["thesis_holds_here"]
    assert " mm" in written["thesis_holds_here"] or "%" in written["thesis_holds_here"]
    assert (study_folder / "table.csv").read_text().count("\n") > 20
    assert (study_folder / picture).stat().st_size > 20_000
