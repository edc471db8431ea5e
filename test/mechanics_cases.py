"""Structured meshes and small patients that the tests of mechanics and atlas share."""

from __future__ import annotations

import numpy as np
from skfem import MeshTet

from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.materials import material_of
from brainshift_ros.mesh.patient import ImageReference, PatientModel, Tissue
from brainshift_ros.mesh.tetmesh import TetMesh
from brainshift_ros.surface.facets import LOCAL_FACES
from brainshift_ros.surface.surface import Surface


def box(counts, size=(1.0, 1.0, 1.0), jiggle=0.0, seed=0):
    """Nodes and elements of a box from the origin; inner nodes moved at random by `jiggle` cell sizes."""
    skfem_mesh = MeshTet.init_tensor(*(np.linspace(0.0, s, n + 1) for s, n in zip(size, counts, strict=True)))
    nodes = np.ascontiguousarray(skfem_mesh.p.T)
    inner = np.all((nodes > 1e-12) & (nodes < np.array(size) - 1e-12), axis=1)
    cell = np.array(size) / np.array(counts)
    nodes[inner] += np.random.default_rng(seed).uniform(-jiggle, jiggle, (inner.sum(), 3)) * cell
    return nodes, positive(nodes, skfem_mesh.t.T)


def positive(nodes, elements):
    elements = np.array(elements, dtype=np.int32)
    x = nodes[elements]
    wrong = np.linalg.det(x[:, 1:] - x[:, :1]) < 0.0
    elements[wrong] = elements[wrong][:, [0, 2, 1, 3]]
    return elements


def outer_facets(elements):
    """Faces that belong to one element only, outward."""
    faces = elements[:, LOCAL_FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]].astype(np.int32)


def facets_where(nodes, facets, condition):
    """Facets whose three corners satisfy a condition on coordinates."""
    return facets[condition(nodes[facets]).all(axis=1)]


def plain(nodes, elements, facets=None, node_sets=None, region=None):
    region = np.full(len(elements), Region.LEFT_CEREBRUM, np.uint8) if region is None else region
    return TetMesh(nodes, elements, region, facets or {}, node_sets or {})


def ids(mask):
    return np.flatnonzero(mask).astype(np.int32)


def column(n, height=0.1, width=0.03, across=None):
    """A bar on the ground: base fixed, sides slip (named falx and tentorium), top free (skull in the cap)."""
    across = n // 3 if across is None else across
    nodes, elements = box((across, across, n), (width, width, height))
    outer = outer_facets(elements)
    on = lambda axis, value: facets_where(nodes, outer, lambda x: np.isclose(x[..., axis], value))  # noqa: E731
    facets = {
        "falx": np.concatenate([on(0, 0.0), on(0, width)]),
        "tentorium": np.concatenate([on(1, 0.0), on(1, width)]),
        "skull": on(2, height),
    }
    return plain(nodes, elements, facets, {"brainstem": ids(nodes[:, 2] == 0.0)})


def split_box(counts=(4, 4, 4), size=(0.08, 0.08, 0.08), depth=1.0):
    """A box cut by a sheet at half its width, from the top down to `1 - depth` of its height, where the sides stay joined.

    Base fixed; the outer boundary is the skull.
    """
    nodes, elements = box(counts, size)
    outer = outer_facets(elements)
    middle = np.isclose(nodes[:, 0], size[0] / 2)
    edge = size[2] * (1.0 - depth)
    doubled = middle & (nodes[:, 2] > edge + 1e-12) if depth < 1.0 else middle
    right = nodes[elements].mean(axis=1)[:, 0] > size[0] / 2
    copy = np.arange(len(nodes))
    copy[doubled] = len(nodes) + np.arange(doubled.sum())
    right_outer = nodes[outer].mean(axis=1)[:, 0] > size[0] / 2
    elements[right] = copy[elements[right]]
    outer[right_outer] = copy[outer[right_outer]]
    nodes = np.concatenate([nodes, nodes[doubled]])
    faces = elements[:, LOCAL_FACES].reshape(-1, 3)
    on_sheet = np.isclose(nodes[faces][..., 0], size[0] / 2).all(axis=1)
    on_sheet &= (nodes[faces][..., 2] >= edge - 1e-12).all(axis=1)
    facets = {"skull": outer, "falx": faces[on_sheet].astype(np.int32)}
    rim = np.isclose(nodes[:, 0], size[0] / 2) & np.isclose(nodes[:, 2], edge) & (depth < 1.0)
    node_sets = {"brainstem": ids(nodes[:, 2] == 0.0), "falx_rim": ids(rim)}
    return plain(nodes, elements, facets, node_sets)


def head(n=8, radius=0.07, sheet=True):
    """A ball with a tumour, a fixed patch below, and a falx cut from the top down to its middle."""
    mesh = split_box((n, n, n), (2.0, 2.0, 2.0), depth=0.5) if sheet else None
    if mesh is None:
        nodes, elements = box((n, n, n), (2.0, 2.0, 2.0))
        mesh = plain(nodes, elements, {"skull": outer_facets(elements)})
    cube = mesh.nodes - 1.0
    largest, length = np.abs(cube).max(axis=1), np.linalg.norm(cube, axis=1)
    nodes = radius * cube * (largest / np.where(length > 0.0, length, 1.0))[:, None]
    elements = positive(nodes, mesh.elements)
    centre = nodes[elements].mean(axis=1)
    region = np.where(centre[:, 0] < 0.0, Region.LEFT_CEREBRUM, Region.RIGHT_CEREBRUM).astype(np.uint8)
    region[np.linalg.norm(centre - radius * np.array([-0.42, 0.25, 0.1]), axis=1) < 0.32 * radius] = Region.TUMOR
    node_sets = {"brainstem": ids(nodes[:, 2] < -0.8 * radius), **{k: v for k, v in mesh.node_sets.items() if k != "brainstem"}}
    return TetMesh(nodes, elements, region, mesh.facets, node_sets)


def patient(mesh, name="test"):
    tissue = np.where(mesh.region == Region.TUMOR, Tissue.TUMOR, Tissue.WHITE).astype(np.uint8)
    image = ImageReference(name, "0" * 64, (1, 1, 1), np.eye(4))
    return PatientModel(mesh, tissue, Surface(mesh.nodes, mesh.facets["skull"]), image, {}, (), "ab" * 32)


def brain(mesh):
    """Table 1 on a mesh: white matter and tumour."""
    return material_of(np.where(mesh.region == Region.TUMOR, Tissue.TUMOR, Tissue.WHITE).astype(np.uint8))
