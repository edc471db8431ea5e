"""Node `inverse`: from the announced atlas and homologous points to a displacement field of the whole brain."""

from __future__ import annotations

import concurrent.futures
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.task import Future

from brainshift_ros.atlas.file import AtlasFile, open_atlas
from brainshift_ros.errors import InputError
from brainshift_ros.files import Signature, signature_of
from brainshift_ros.graph import (
    ATLAS_INFO,
    ATLAS_RETRACTION,
    DISPLACEMENT_FIELD,
    DISPLACEMENT_MARKERS,
    HOMOLOGOUS_POINTS,
    SHIFT_ESTIMATE,
)
from brainshift_ros.inverse.estimate import ShiftEstimate, estimate_shift
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.nodes.base import BrainshiftNode
from brainshift_ros.nodes.health import Level
from brainshift_ros.nodes.warping import ImageWarper
from brainshift_ros.wire.markers import displacement_markers, no_markers
from brainshift_ros.wire.plain import NS_PER_S
from brainshift_ros.wire.retraction import decode_columns
from brainshift_ros.wire.texts import AtlasInfo, ShiftEstimateText, decode_text, encode_text
from brainshift_ros.wire.vectors import StampedPoints, decode_measurement, encode_field

ATLAS = "atlas"
ESTIMATE = "estimate"


@dataclass(frozen=True)
class OpenedAtlas:
    """The atlas in use, with what it takes to notice that the file has changed since."""

    info: AtlasInfo
    file: AtlasFile
    locator: PointLocator
    signature: Signature | None
    announced_ns: int


@dataclass(frozen=True)
class Request:
    """The inputs of one estimate; an estimate is published only while its request is still the newest."""

    atlas: OpenedAtlas
    measured: StampedPoints
    retraction: NDArray[np.float32] | None


def open_announced(info: AtlasInfo, announced_ns: int) -> OpenedAtlas:
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
    return OpenedAtlas(info, atlas, PointLocator(atlas.mesh), signature, announced_ns)


class InverseNode(BrainshiftNode):
    """Estimates as soon as both an atlas and points are there, in whatever order they arrive; the newest inputs win.

    Nothing of one case reaches the next: an empty cloud of points, or an atlas of another patient, takes back the points and
    all that was published from them.
    """

    def __init__(self) -> None:
        super().__init__("inverse")
        self._arrows = self.parameter("arrows", 300, "arrows in displacement_markers, at most", (1, 5000))
        image_file = self.parameter("image_file", "", "path of the MR (NIfTI) that ~/warp_image warps")
        output_dir = self.parameter("output_dir", "out/case", "folder that ~/warp_image writes to")
        self._warper = ImageWarper(image_file, output_dir)
        self._warping = self.create_worker()
        self._announced: AtlasInfo | None = None
        self._atlas: OpenedAtlas | None = None
        self._measured: StampedPoints | None = None
        self._retraction: NDArray[np.float32] | None = None
        self._request: Request | None = None
        self._valid: ShiftEstimate | None = None
        self.report(ESTIMATE, Level.OK, "waiting for an atlas and homologous points")
        self.take(ATLAS_INFO, lambda message: decode_text(AtlasInfo, message, ATLAS_INFO), self._on_atlas)
        self.take(HOMOLOGOUS_POINTS, decode_measurement, self._on_points)
        self.take(ATLAS_RETRACTION, decode_columns, self._on_retraction)
        self.serve("warp_image", self._warp_image)

    def _on_atlas(self, info: AtlasInfo) -> None:
        earlier, self._announced = self._announced, info
        if earlier is not None and earlier.atlas_id != info.atlas_id:
            self._retraction = None  # it was solved on the earlier atlas's mesh
        if earlier is not None and earlier.patient_id != info.patient_id:
            self._forget_case()  # the points were measured on the earlier patient
        self._atlas = self._request = self._valid = None
        announced_ns = self.now_ns()
        self.work(ATLAS, lambda: open_announced(info, announced_ns), self._on_opened)

    def _on_opened(self, atlas: OpenedAtlas) -> None:
        if atlas.info is not self._announced:
            return  # another one has been announced meanwhile
        self._atlas = atlas
        self.report(ATLAS, Level.OK, f"atlas {atlas.info.atlas_id[:12]} is open")
        self._estimate()

    def _on_points(self, measured: StampedPoints | None) -> None:
        if measured is None:
            self._forget_case()
        self._measured = measured
        self._estimate()

    def _forget_case(self) -> None:
        self._measured = self._request = self._valid = None
        self.withdraw(DISPLACEMENT_FIELD)
        self.withdraw(SHIFT_ESTIMATE)
        # A display keeps what it has got, so its arrows must be deleted, not only withheld from late joiners.
        self.give(DISPLACEMENT_MARKERS, no_markers(self.now_ns()))

    def _on_retraction(self, columns: NDArray[np.float32]) -> None:
        self._retraction = columns if len(columns) else None
        self._estimate()

    def _estimate(self) -> None:
        if self._atlas is None or self._measured is None:
            missing = "an atlas" if self._atlas is None else "homologous points"
            self.report(ESTIMATE, Level.OK, f"waiting for {missing}")
            return
        request = self._request = Request(self._atlas, self._measured, self._retraction)
        self.work(ESTIMATE, lambda: self._solve(request), lambda estimate: self._publish(request, estimate))

    @staticmethod
    def _solve(request: Request) -> ShiftEstimate:
        _check_unchanged(request.atlas)
        atlas, points = request.atlas, request.measured.points
        return estimate_shift(atlas.file, points, retraction=request.retraction, locator=atlas.locator)

    def _publish(self, request: Request, estimate: ShiftEstimate) -> None:
        if request is not self._request:
            return  # newer inputs have come, and their estimate is on its way
        _check_unchanged(request.atlas)
        stamp_ns = request.measured.stamp_ns
        text = self._text(request, estimate)
        if estimate.valid:
            field = encode_field(estimate.field, stamp_ns)
            mesh = estimate.field.mesh
            self.give(DISPLACEMENT_FIELD, field)
            self.give(SHIFT_ESTIMATE, text)
            markers = displacement_markers(
                mesh.nodes, mesh.facets["skull"], estimate.field.displacement, self._arrows, stamp_ns
            )
            self.give(DISPLACEMENT_MARKERS, markers)
            self._valid = estimate
        else:
            # The latched field stays what it was: a field that failed its gates must not reach a display.
            self.give(SHIFT_ESTIMATE, text)
        self.health.report({f"time_{stage}_s": f"{seconds:.3f}" for stage, seconds in estimate.times_s.items()})
        if not estimate.valid:
            self.report(ESTIMATE, Level.ERROR, f"{ESTIMATE}: refused: {'; '.join(estimate.reasons)}")
        elif estimate.warnings:
            self.report(ESTIMATE, Level.WARN, f"{ESTIMATE}: {'; '.join(estimate.warnings)}")
        else:
            self.report(ESTIMATE, Level.OK, "a displacement field is published")

    def _text(self, request: Request, estimate: ShiftEstimate) -> dict[str, Any]:
        now_ns = self.now_ns()
        content = {
            **estimate.to_json(),
            "ids": {
                "atlas": estimate.atlas_id,
                "patient": estimate.patient_id,
                "points": estimate.points_sha256,
                "retraction": estimate.retraction_sha256 or "",
            },
            "ages_s": {
                "atlas": (now_ns - request.atlas.announced_ns) / NS_PER_S,
                "points": (now_ns - request.measured.stamp_ns) / NS_PER_S,
            },
        }
        return encode_text(ShiftEstimateText.model_validate(content))

    async def _warp_image(self, _: Any, response: Any) -> Any:
        """Answer `~/warp_image` when the image is written; the executor serves everything else meanwhile."""
        estimate = self._valid
        if estimate is None:
            response.success, response.message = False, "there is no valid displacement field to warp by"
            return response
        finished: Future[concurrent.futures.Future[Path]] = Future(executor=self.executor)
        self._warping.submit("warp", lambda: self._warper.warp(estimate.field), finished.set_result)
        result = await finished
        assert result is not None
        error = result.exception()
        response.success = error is None
        response.message = str(error or result.result())
        return response

    def shut_down(self) -> None:
        """Also end the process that warps."""
        self._warper.stop()
        super().shut_down()


def _check_unchanged(atlas: OpenedAtlas) -> None:
    if signature_of(atlas.info.path) != atlas.signature:
        problem = "has changed since it was announced"
        raise InputError(atlas.info.path, problem, "wait for atlas_loader to announce it again; nothing stale is published")
