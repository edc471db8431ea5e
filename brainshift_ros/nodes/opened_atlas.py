"""The announced atlas as node `inverse` holds it: open, located, and known again if its file changes."""

from __future__ import annotations

from dataclasses import dataclass

from brainshift_ros.atlas.file import AtlasFile, open_atlas
from brainshift_ros.errors import InputError
from brainshift_ros.files import Signature, signature_of
from brainshift_ros.inverse.span import AtlasSpan, atlas_span
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.wire.texts import AtlasInfo


@dataclass(frozen=True)
class OpenedAtlas:
    """The atlas in use, with what every estimate needs of it, and what it takes to notice that the file has changed since."""

    info: AtlasInfo
    file: AtlasFile
    locator: PointLocator
    span: AtlasSpan
    signature: Signature | None

    def check_unchanged(self) -> None:
        """Refuse to go on with a file that is not the one that was opened.

        Raises
        ------
        InputError
            The file has been replaced, changed or removed.
        """
        if signature_of(self.info.path) != self.signature:
            problem = "has changed since it was announced"
            raise InputError(self.info.path, problem, "wait for atlas_loader to announce it again; nothing stale is published")


def open_announced(info: AtlasInfo) -> OpenedAtlas:
    """Open the atlas that `info` announces.

    Raises
    ------
    InputError
        The file cannot be read, or holds another atlas than was announced.
    """
    signature = signature_of(info.path)
    atlas = open_atlas(info.path)
    if atlas.atlas_id != info.atlas_id:
        problem = f"holds atlas {atlas.atlas_id[:12]}, but {info.atlas_id[:12]} was announced"
        raise InputError(info.path, problem, "wait for atlas_loader to announce the file as it is now, or restart it")
    return OpenedAtlas(info, atlas, PointLocator(atlas.mesh), atlas_span(atlas), signature)
