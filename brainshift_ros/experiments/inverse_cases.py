"""Base of the studies of the inverse model: atlases made by the builder, measured points, and errors by target group.

The truths that the estimates are held against are in :mod:`brainshift_ros.experiments.inverse_truths`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainshift_ros.atlas.build import build_atlas
from brainshift_ros.atlas.file import VERSION, open_atlas
from brainshift_ros.atlas.scene import Craniotomy, Gravity, Mannitol, Model, Scene
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.experiments.inverse_truths import CONE_DEG, PLANNED, Direction, InverseTruth
from brainshift_ros.experiments.patients import CENTER_MM, RADIUS_MM, craniotomy_opening, study_groups, template_patient
from brainshift_ros.experiments.skull_cases import MemoryAtlas
from brainshift_ros.h5 import digest
from brainshift_ros.inverse.accuracy import angular_error_deg
from brainshift_ros.inverse.atlas_like import AtlasLike
from brainshift_ros.mechanics.skull import SkullName
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.units import m_to_mm, mm_to_m

Progress = Callable[[str, float], None]
Row = dict[str, Any]

#: A truth's node this close to the atlas's mesh, outside it, is a target still: two meshes cut one surface differently.
_BESIDE_M = float(mm_to_m(10.0))


def study_scene(
    *,
    direction: Direction = PLANNED,
    cone_deg: float = CONE_DEG,
    orientations: int = 60,
    fluid_levels: int = 3,
    permeability_levels: int = 3,
    resection: Literal["none", "resected", "both"] = "both",
    skull: SkullName = "contact",
) -> Scene:
    """Scene of a study, with the left frontal craniotomy and septa; as it stands, spec P9's default of 720 entries.

    Parameters
    ----------
    direction, cone_deg, orientations, fluid_levels, resection, skull
        As in :class:`brainshift_ros.atlas.scene.Scene`.
    permeability_levels
        Of mannitol; 0 leaves it out.
    """
    drug = Mannitol(permeability_levels=permeability_levels) if permeability_levels else None
    return Scene(
        version=1,
        head=None,
        gravity=Gravity(direction=direction, cone_deg=cone_deg, orientations=orientations, fluid_levels=fluid_levels),
        mannitol=drug,
        resection=resection,
        craniotomy=Craniotomy(center_mm=CENTER_MM, diameter_mm=2.0 * RADIUS_MM),
        model=Model(skull=skull),
    )


def study_atlas(folder: Path, scene: Scene, progress: Progress, *, nodes: int, seed: int = 0) -> MemoryAtlas:
    """Atlas of a scene on a mesh of the template, built as `brainshift atlas` does, then read into memory.

    Parameters
    ----------
    folder
        Keeps mesh and atlas: a second call reads them.
    scene
        What acts; see :func:`study_scene`.
    progress
        Called with stage and fraction done.
    nodes, seed
        Of the mesh; see :func:`.patients.template_patient`.
    """
    patient = template_patient(folder, nodes, seed, progress)
    path = folder / f"atlas_{digest(patient.patient_id, scene.model_dump_json(), str(VERSION))[:16]}.h5"
    if not path.is_file():
        build_atlas(patient, scene, path, progress=lambda stage, fraction: progress(f"atlas: {stage}", fraction))
    with open_atlas(path) as file:
        E = file.columns(range(len(file.entries)))
        return MemoryAtlas(file.mesh, E, file.entries, file.groups, path, file.atlas_id, file.patient_id)


def subset(atlas: MemoryAtlas, columns: ArrayLike) -> MemoryAtlas:
    """Atlas of some of the columns, by mask or ids in ascending order; its groups are what is left of them."""
    ids = np.asarray(columns)
    ids = np.flatnonzero(ids) if ids.dtype == bool else ids
    place = {int(column): number for number, column in enumerate(ids)}
    groups = tuple(
        replace(group, columns=kept)
        for group in atlas.groups
        if (kept := tuple(place[column] for column in group.columns if column in place))
    )
    entries = tuple(atlas.entries[column] for column in ids)
    return replace(atlas, E=atlas.E[:, :, ids], entries=entries, groups=groups, atlas_id=digest(atlas.atlas_id, ids))


def measure(truth: InverseTruth, count: int, noise_m: float, rng: np.random.Generator) -> HomologousPoints:
    """Measure random points of the cortex in the craniotomy, evenly by area and not at nodes.

    Parameters
    ----------
    truth
        What moved.
    count
        Number of points.
    noise_m
        Standard deviation of each component of the noise, and the sigma that is stated; metres.
    rng
        Decides points and noise.
    """
    return measure_facets(truth, opening_facets(truth.mesh, truth.tissue), count, noise_m, rng)


def measure_facets(
    truth: InverseTruth, facets: NDArray[np.integer], count: int, noise_m: float, rng: np.random.Generator
) -> HomologousPoints:
    """:func:`measure` on some facets, shape (k, 3)."""
    corners = truth.mesh.nodes[facets]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = facets[rng.choice(len(facets), count, p=area / area.sum())]
    barycentric = rng.dirichlet(np.ones(3), count)
    points, moved = (np.einsum("na,nai->ni", barycentric, v[chosen]) for v in (truth.mesh.nodes, truth.displacement))
    return HomologousPoints(points, moved + rng.normal(0.0, noise_m, moved.shape), np.full(count, noise_m))


def opening_facets(mesh: TetMesh, tissue: NDArray[np.bool_] | None = None) -> NDArray[np.int32]:
    """Facets (k, 3) of the cortex in the craniotomy; only those with tissue at all corners, if `tissue` (N,) is given."""
    skull = mesh.facets["skull"]
    seen = craniotomy_opening(mesh) if tissue is None else craniotomy_opening(mesh) & tissue
    return np.asarray(skull[seen[skull].all(axis=1)])


class Targets:
    """Nodes of a truth by group, found once in the atlas's mesh.

    Parameters
    ----------
    truth
        Whose nodes, as far as they carry tissue, are the targets.
    atlas
        On another mesh of the same head.
    locator
        Of the atlas's mesh.

    Attributes
    ----------
    groups
        Node ids by group; see :func:`brainshift_ros.simulation.targets.target_groups`. Nodes on septa are in none.
    """

    def __init__(self, truth: InverseTruth, atlas: AtlasLike, locator: PointLocator) -> None:
        self._mesh, self._truth = atlas.mesh, truth
        self._located = locator.locate(truth.mesh.nodes, _BESIDE_M)
        usable = self._located.found & truth.tissue
        groups = {name: ids[usable[ids]] for name, ids in study_groups(truth.mesh).items()}
        self.groups: Mapping[str, NDArray[np.intp]] = {name: ids for name, ids in groups.items() if len(ids)}

    def at_targets(self, nodal: NDArray) -> NDArray[np.float64]:
        """Values at the atlas's nodes, shape (N, ...), interpolated at the truth's nodes; NaN where there is no atlas."""
        return self._located.interpolate(self._mesh, nodal)

    def difference(self, field: NDArray[np.float64]) -> NDArray[np.float64]:
        """Field at the atlas's nodes (N, 3) less the truth, at the truth's nodes; metres."""
        return self.at_targets(field) - self._truth.displacement

    def errors(self, field: NDArray[np.float64], more: Mapping[str, NDArray[np.intp]] | None = None) -> Iterator[Row]:
        """Error of a field by group.

        Parameters
        ----------
        field
            Shape (N, 3), metres, at the atlas's nodes.
        more
            Further groups of the truth's nodes.

        Yields
        ------
        Rows with ``group``, ``targets``, ``shift_mm``, ``error_mm`` and ``error_mm_p95``, the shift correction (4.4), and the
        mean angle between the two, None where nothing moved.
        """
        true, found = self._truth.displacement, self.at_targets(field)
        error, shift = (m_to_mm(np.linalg.norm(vectors, axis=1)) for vectors in (found - true, true))
        for name, ids in {**self.groups, **(more or {})}.items():
            if len(ids):
                yield {
                    "group": name,
                    "targets": len(ids),
                    "shift_mm": float(shift[ids].mean()),
                    "error_mm": float(error[ids].mean()),
                    "error_mm_p95": float(np.quantile(error[ids], 0.95)),
                    "correction_percent": float(100.0 * (1.0 - error[ids].mean() / shift[ids].mean())),
                    "angular_error_deg": angular_error_deg(true[ids], found[ids]),
                }


def columns_where(atlas: AtlasLike, chosen: Callable[[Any], bool]) -> NDArray[np.int64]:
    """Ids of the columns whose :class:`~brainshift_ros.atlas.entry.AtlasEntry` is chosen."""
    return np.flatnonzero([chosen(entry) for entry in atlas.entries])


def mean_of_points(atlas: AtlasLike, measured: HomologousPoints) -> NDArray[np.float64]:
    """Estimate by no model: everything moves as the measured points do in the mean; shape (N, 3), metres."""
    return np.tile(measured.displacements.mean(axis=0), (len(atlas.mesh.nodes), 1))
