"""Small meshes, atlases and fields that the tests of location, inverse model and field share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from skfem import MeshTet

from brainshift_ros.atlas.entry import AtlasEntry, WeightGroup
from brainshift_ros.field.displacement import DisplacementField
from brainshift_ros.image.volume import Region
from brainshift_ros.mesh.tetmesh import TetMesh

#: Semi-axes of the little brain, metres.
SEMI_AXES = np.array([0.05, 0.06, 0.045])


def tet_mesh(nodes, elements):
    elements = np.array(elements, dtype=np.int32)
    corners = nodes[elements]
    turned = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0
    elements[turned] = elements[turned][:, [0, 1, 3, 2]]
    return TetMesh(np.ascontiguousarray(nodes), elements, np.full(len(elements), Region.LEFT_CEREBRUM, np.uint8))


def box_mesh(counts, low, high):
    axes = (np.linspace(a, b, n + 1) for a, b, n in zip(low, high, counts, strict=True))
    mesh = MeshTet.init_tensor(*axes)
    return tet_mesh(mesh.p.T, mesh.t.T)


def split_box(n=4, half=0.04):
    """A box whose nodes on the plane x = 0 are doubled: the two halves touch without being joined."""
    left = box_mesh((n, n, n), (-half, -half, -half), (0.0, half, half))
    right = box_mesh((n, n, n), (0.0, -half, -half), (half, half, half))
    nodes = np.concatenate([left.nodes, right.nodes])
    return tet_mesh(nodes, np.concatenate([left.elements, right.elements + len(left.nodes)])), len(left.nodes)


def ellipsoid_mesh(n=10, semi_axes=SEMI_AXES):
    """A cube's mesh pulled onto an ellipsoid; its cells at the cube's corners are flat but positive."""
    cube = MeshTet.init_tensor(*[np.linspace(-1.0, 1.0, n + 1)] * 3)
    x = cube.p.T
    # A smooth map from cube to ball, so that no cell folds.
    a, b, c = (x**2).T
    ball = x * np.sqrt(
        np.stack([1 - b / 2 - c / 2 + b * c / 3, 1 - c / 2 - a / 2 + a * c / 3, 1 - a / 2 - b / 2 + a * b / 3], 1)
    )
    return tet_mesh(ball * semi_axes, cube.t.T)


@dataclass(frozen=True)
class MemoryAtlas:
    """An atlas in memory, with the interface of the atlas file."""

    mesh: TetMesh
    E: np.ndarray
    entries: tuple[AtlasEntry, ...]
    groups: tuple[WeightGroup, ...]
    path: Path = Path("memory")
    atlas_id: str = "a1" * 32
    patient_id: str = "b2" * 32
    reads: list = field(default_factory=list)

    def rows(self, node_ids):
        self.reads.append(("rows", len(node_ids)))
        return self.E[np.asarray(node_ids)]

    def columns(self, ids):
        self.reads.append(("columns", len(ids)))
        return self.E[:, :, np.asarray(ids)]


def sag(nodes, direction, size, power):
    """A smooth sag along `direction`: zero at the lowest point, `size` metres at the highest."""
    height = -(nodes @ direction)
    share = (height - height.min()) / np.ptp(height)
    return size * share[:, None] ** power * np.asarray(direction)


def sagging_atlas(mesh, entries=40, seed=0):
    """Sags of 6 to 14 mm along directions around -y."""
    rng = np.random.default_rng(seed)
    columns, parameters = [], []
    for _ in range(entries):
        direction = np.array([rng.normal(0.0, 0.25), -1.0, rng.normal(0.0, 0.25)])
        direction /= np.linalg.norm(direction)
        level = rng.uniform(0.2, 0.9)
        columns.append(sag(mesh.nodes, direction, rng.uniform(0.006, 0.014), 1.0 + level))
        parameters.append(AtlasEntry("gravity", tuple(direction), level, 0, False))
    E = np.stack(columns, axis=-1).astype(np.float32)
    return MemoryAtlas(mesh, E, tuple(parameters), (WeightGroup("gravity", tuple(range(entries))),))


def top_nodes(mesh, count, seed=0, above=0.5, semi_axes=SEMI_AXES):
    """Some nodes of the ellipsoid's surface around its +y end."""
    radius = np.linalg.norm(mesh.nodes / semi_axes, axis=1)
    candidates = np.flatnonzero((radius > 1.0 - 1e-9) & (mesh.nodes[:, 1] > above * semi_axes[1]))
    return np.random.default_rng(seed).choice(candidates, count, replace=False)


def smooth_field(mesh, size=0.008):
    """A field with all components and gradients, at most about `size`."""
    x, y, z = (mesh.nodes / SEMI_AXES).T
    u = size * np.stack([0.5 * np.exp(-((y - 0.4) ** 2)) + 0.1 * z, -0.4 * (1 + y), 0.3 * x + 0.1 * np.sin(2 * y)], axis=1)
    std = 0.1 * np.linalg.norm(u, axis=1)
    return DisplacementField(mesh, u, std, {"patient_id": "b2" * 32, "valid": True})
