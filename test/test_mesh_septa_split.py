"""Splitting meshes of known shape along known sheets: invariants, joints, gaps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mechanics_cases import box
from scipy.spatial.transform import Rotation

from brainshift_ros.experiments import septa_gap
from brainshift_ros.image.volume import Region
from brainshift_ros.mesh.patient import PatientModel
from brainshift_ros.mesh.septa_gap import gap_figures
from brainshift_ros.mesh.septa_join import with_gap
from brainshift_ros.mesh.split import SplitMesh, split_along_septa
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.septa.sheets import Septum, sheet
from brainshift_ros.septa.template import septa_from_template
from brainshift_ros.surface.facets import components, face_table, facet_areas
from brainshift_ros.surface.surface import Surface

SIDE = 0.08  # of the cube in which the sheets stand, metres
CELLS = 8  # along it: cells of 10 mm


def cube(jiggle: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Nodes around the origin; `jiggle` moves those off the sheets' planes, and those on them within the planes."""
    nodes, elements = box((CELLS, CELLS, CELLS), (SIDE, SIDE, SIDE))
    nodes = nodes - SIDE / 2
    moved = np.random.default_rng(seed).uniform(-jiggle, jiggle, nodes.shape) * SIDE / CELLS
    moved[np.abs(nodes) > SIDE / 2 - 1e-9] = 0.0
    moved[np.abs(nodes) < 1e-9] = 0.0  # the sheets' planes x = 0 and z = 0, and y = 0 with their free edges
    return nodes + moved, elements


def sheets(outside_mm: float = 8.0, short_mm: float = 0.0) -> tuple[Septum, ...]:
    """A falx x = 0 above a tentorium z = 0, both behind y = 0, their free edge; attached on the cube's other faces.

    With `short_mm` their attached edges end that far inside the cube.
    """
    end = 40.0 + outside_mm if short_mm == 0.0 else 40.0 - short_mm
    step = 5.0

    def ring(corners: list[list[float]]) -> np.ndarray:
        points = []
        for start, stop in zip(corners, [*corners[1:], corners[0]], strict=True):
            count = round(np.linalg.norm(np.subtract(stop, start)) / step)
            points += [start + np.subtract(stop, start) * k / count for k in range(count)]
        return np.array(points)

    found = []
    for name, corners, normal in (
        ("falx", [[0.0, 0.0, 0.0], [0.0, -end, 0.0], [0.0, -end, end], [0.0, 0.0, end]], (1.0, 0.0, 0.0)),
        ("tentorium", [[0.0, 0.0, 0.0], [0.0, -end, 0.0], [-end, -end, 0.0], [-end, 0.0, 0.0]], (0.0, 0.0, 1.0)),
        ("tentorium", [[0.0, 0.0, 0.0], [0.0, -end, 0.0], [end, -end, 0.0], [end, 0.0, 0.0]], (0.0, 0.0, 1.0)),
    ):
        points = ring(corners)
        surface = sheet(points, (), normal, step)
        far = np.abs(points).max(axis=1) >= end - 1e-9
        found.append(Septum(name, surface, np.flatnonzero(far).astype(np.int32)))
    return tuple(found)


def named(split: SplitMesh) -> TetMesh:
    boundary = face_table(split.elements).boundary
    on_wall = (np.abs(split.nodes[boundary].mean(axis=1)) > SIDE / 2 - 1e-6).any(axis=1)
    region = np.full(len(split.elements), Region.LEFT_CEREBRUM, dtype=np.uint8)
    rims = {f"{name}_rim": rim for name, rim in split.rims.items()}
    return TetMesh(split.nodes, split.elements, region, {"skull": boundary[on_wall], **split.facets}, rims)


def keys(facets: np.ndarray) -> set[tuple[int, ...]]:
    return {tuple(f) for f in np.sort(facets, axis=1).tolist()}


def assert_valid(split: SplitMesh, nodes: np.ndarray, elements: np.ndarray) -> None:
    """One component; both sides alike; every boundary facet on the wall or on a sheet; geometry untouched."""
    np.testing.assert_array_equal(split.nodes[split.elements], nodes[elements])
    table = face_table(split.elements)
    assert components(len(elements), table.owners).max() == 0
    walls = np.abs(split.nodes[table.boundary].mean(axis=1)).max(axis=1) > SIDE / 2 - 1e-6
    assert keys(table.boundary[~walls]) == set().union(*(keys(f) for f in split.facets.values()))
    for name, facets in split.facets.items():
        one, other = np.split(facets, 2)
        np.testing.assert_array_equal(split.nodes[one], split.nodes[other][:, ::-1])
        both = np.intersect1d(one, other)
        assert set(split.rims[name]) <= set(both)


@pytest.mark.parametrize("jiggle", [0.0, 0.2])
def test_falx_on_tentorium_is_split_exactly(jiggle: float) -> None:
    nodes, elements = cube(jiggle)
    septa = sheets()
    split = split_along_septa(nodes, elements, septa)
    assert_valid(split, nodes, elements)
    half = SIDE / 2
    assert facet_areas(split.nodes, split.facets["falx"]).sum() == pytest.approx(2 * half * half)
    assert facet_areas(split.nodes, split.facets["tentorium"]).sum() == pytest.approx(2 * SIDE * half)
    one, _ = np.split(split.facets["falx"], 2)
    edges = split.nodes[one[:, 1]] - split.nodes[one[:, 0]], split.nodes[one[:, 2]] - split.nodes[one[:, 0]]
    assert (np.cross(*edges)[:, 0] > 0).all()  # those of the left side point right, out of their elements
    # on the straight sinus three copies meet: left, right, below; at its end on the free edge all are one
    y = np.unique(nodes[(nodes[:, 0] == 0) & (nodes[:, 2] == 0), 1])
    for value in y:
        copies = np.count_nonzero((np.abs(split.nodes - [0.0, value, 0.0]) < 1e-12).all(axis=1))
        assert copies == (3 if value < 0 else 1)
    for name, axis in (("falx", 0), ("tentorium", 2)):
        np.testing.assert_allclose(split.nodes[split.rims[name]][:, [axis, 1]], 0.0, atol=1e-12)


def test_sheets_that_reach_out_leave_no_gap_and_short_ones_theirs() -> None:
    nodes, elements = cube()
    closed = gap_figures(named(split_along_septa(nodes, elements, sheets())), sheets())
    assert closed == {
        f"{name}_{figure}": value
        for name in ("falx", "junction", "tentorium")
        for figure, value in (("gap_mm_mean", 0.0), ("gap_mm_max", 0.0), ("closed_percent", 100.0))
    }
    short = sheets(short_mm=12.0)  # the outermost whole row of faces that lies on such a sheet ends at 10 mm depth
    figures = gap_figures(named(split_along_septa(nodes, elements, short)), short)
    for name in ("falx", "tentorium"):
        assert figures[f"{name}_closed_percent"] < 25.0
        assert 6.0 < figures[f"{name}_gap_mm_mean"] < 14.0


def test_a_sheet_beside_the_mesh_faces_still_divides_without_holes() -> None:
    """Sheets between the faces, as a mesher's envelope allows: the cut follows the faces, in one piece, to the skull."""
    nodes, elements = cube(0.25, seed=4)
    beside = np.array([0.0007, 0.0, 0.0006])
    shifted = tuple(Septum(s.name, Surface(s.surface.vertices + beside, s.surface.faces)) for s in sheets())
    split = split_along_septa(nodes, elements, shifted)
    assert_valid(split, nodes, elements)
    for name, expected in (("falx", SIDE**2 / 4), ("tentorium", SIDE**2 / 2)):
        assert facet_areas(split.nodes, split.facets[name]).sum() / 2 == pytest.approx(expected, rel=0.03)


@settings(max_examples=8, deadline=None)
@given(
    turn=st.tuples(*3 * [st.floats(-0.3, 0.3)]),
    shift=st.tuples(*3 * [st.floats(-0.008, 0.008)]),
    jiggle=st.floats(0.0, 0.25),
    seed=st.integers(0, 1000),
)
def test_any_place_of_the_sheets_gives_a_valid_split(
    turn: tuple[float, ...], shift: tuple[float, ...], jiggle: float, seed: int
) -> None:
    """Also where no mesh face lies on the sheets: no pockets, no holes, equal sides, nothing moved."""
    nodes, elements = cube(jiggle, seed)
    rotation = Rotation.from_rotvec(turn)
    septa = tuple(
        Septum(s.name, Surface(rotation.apply(s.surface.vertices) + shift, s.surface.faces)) for s in sheets(outside_mm=30.0)
    )
    assert_valid(split_along_septa(nodes, elements, septa), nodes, elements)


def test_tumour_that_grew_through_stays_whole() -> None:
    nodes, elements = cube()
    tumor = np.linalg.norm(nodes[elements].mean(axis=1) - [0.0, -0.02, 0.02], axis=1) < 0.012
    split = split_along_septa(nodes, elements, sheets(), uncut=tumor)
    assert_valid(split, nodes, elements)
    assert split.facets["falx"].size < split_along_septa(nodes, elements, sheets()).facets["falx"].size
    pairs = face_table(split.elements[tumor]).owners
    assert components(np.count_nonzero(tumor), pairs).max() == 0


def test_joining_near_the_skull_is_like_never_having_cut_there() -> None:
    nodes, elements = cube()
    mesh = named(split_along_septa(nodes, elements, sheets()))
    same, node_of = with_gap(mesh, 0.0)
    np.testing.assert_array_equal(same.nodes[node_of], mesh.nodes)
    assert len(same.nodes) == len(mesh.nodes)
    joined, node_of = with_gap(mesh, 0.0101)
    np.testing.assert_array_equal(joined.nodes[node_of], mesh.nodes)
    one, other = np.split(joined.facets["falx"], 2)
    np.testing.assert_array_equal(joined.nodes[one], joined.nodes[other][:, ::-1])
    before, _ = np.split(mesh.facets["falx"], 2)
    _, y, z = mesh.nodes[before].mean(axis=1).T
    kept = np.min([SIDE / 2 - np.abs(y), SIDE / 2 - z, z], axis=0) > 0.0101
    assert 0 < np.count_nonzero(kept) < len(before)
    # but for single facets in a corner whose nodes all belong to joined ones: they part nothing
    expected = facet_areas(mesh.nodes, before[kept]).sum()
    assert 0.8 * expected < facet_areas(joined.nodes, one).sum() <= expected + 1e-12
    figures = gap_figures(joined, sheets())
    assert 10.0 <= figures["falx_gap_mm_max"] < 20.0
    assert figures["falx_closed_percent"] == 0.0
    # nodes that only joined facets carried have one copy, and no two nodes of one place are held apart by nothing
    at_wall = np.abs(mesh.nodes).max(axis=1) > SIDE / 2 - 1e-9
    assert len(np.unique(node_of[at_wall])) == len(np.unique(mesh.nodes[at_wall].round(9), axis=0))
    assert with_gap(mesh, 1.0)[0].facets["falx"].size == 0


def test_a_real_brain_has_no_gaps_and_gaps_change_its_field_little_but_truly(
    small_patient: PatientModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(septa_gap, "GAPS_MM", (4.0, 8.0))
    monkeypatch.setattr(septa_gap, "ORIENTATIONS", {"lateral": (0.94, -0.34, 0.0)})
    septa = septa_from_template(lambda points: points, 9.0)
    figures = gap_figures(small_patient.mesh, septa)
    assert figures["falx_gap_mm_mean"] < 0.2
    assert figures["tentorium_gap_mm_mean"] < 0.5
    assert figures["falx_closed_percent"] > 95.0
    gaps, rows = septa_gap.compare(small_patient, small_patient, septa, lambda stage, fraction: None)
    assert gaps["gap 8 mm"]["falx_gap_mm_mean"] > gaps["gap 4 mm"]["falx_gap_mm_mean"] > 1.0
    means = {(r.orientation, r.variant, r.group): r.difference_mean_mm for r in rows}
    # the same mesh is no other mesh, and a gap is not as bad as no septa
    assert means["lateral", "another mesh", "subsurface"] < 1e-6
    assert 0.0 < means["lateral", "gap 4 mm", "subsurface"] < 0.5 * means["lateral", "no septa", "subsurface"]
