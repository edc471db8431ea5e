"""Node `atlas_loader`: checks the atlas file, and announces it and the brain's surface; latched."""

from __future__ import annotations

from pathlib import Path

from brainshift_ros.atlas.file import AtlasFile, open_atlas
from brainshift_ros.errors import InputError
from brainshift_ros.files import Signature, signature_of
from brainshift_ros.graph import ATLAS_INFO, ATLAS_SURFACE
from brainshift_ros.nodes.base import BrainshiftNode
from brainshift_ros.nodes.health import Level
from brainshift_ros.wire.markers import surface_marker
from brainshift_ros.wire.texts import AtlasInfo, encode_text

CONDITION = "atlas file"


class AtlasLoaderNode(BrainshiftNode):
    """Opens the atlas at the start, and again whenever the file changes."""

    def __init__(self) -> None:
        super().__init__("atlas_loader")
        self._path = self.parameter("atlas_file", "", "path of the atlas file (HDF5) that `brainshift atlas` made")
        self._tried: Signature | None = None
        if not self._path:
            self.guarded(CONDITION, self._refuse_unset)
            return
        self.report(CONDITION, Level.WARN, f"loading {self._path}")
        self._load()

    def tick(self) -> None:
        """Look whether the file has changed since it was last tried."""
        if self._path and signature_of(self._path) != self._tried:
            self._load()

    def _load(self) -> None:
        self._tried = signature_of(self._path)
        self.work(CONDITION, lambda: open_atlas(self._path), self._announce)

    def _announce(self, atlas: AtlasFile) -> None:
        with atlas:
            info = AtlasInfo.model_validate({**atlas.info(), "path": str(Path(self._path).resolve())})
            surface = surface_marker(atlas.mesh.nodes, atlas.mesh.facets["skull"], self.now_ns())
        self.give(ATLAS_SURFACE, surface)
        self.give(ATLAS_INFO, encode_text(info))
        self.report(CONDITION, Level.OK, f"atlas {info.atlas_id[:12]} is announced")

    def _refuse_unset(self) -> None:
        raise InputError(
            "atlas_file", "is not set", "start the node with -p atlas_file:=PATH, or `brainshift run --atlas PATH`"
        )
