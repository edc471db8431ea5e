"""Node `inverse`: from the announced atlas and homologous points to a displacement field of the whole brain."""

from __future__ import annotations

import concurrent.futures
import itertools
from dataclasses import dataclass
from typing import Any

from rclpy.task import Future

from brainshift_ros.graph import ATLAS_INFO, ATLAS_RETRACTION, HOMOLOGOUS_POINTS
from brainshift_ros.inverse.methods import METHODS
from brainshift_ros.inverse.options import InverseOptions
from brainshift_ros.nodes.base import BrainshiftNode
from brainshift_ros.nodes.inverse_case import InverseCase, Published
from brainshift_ros.nodes.warping import ImageWarper, WarpedFile
from brainshift_ros.wire.retraction import decode_columns
from brainshift_ros.wire.texts import AtlasInfo, decode_text
from brainshift_ros.wire.vectors import decode_measurement


@dataclass(frozen=True)
class Warp:
    """A warp that runs or has run: of which field, and its future, which every call for that field awaits."""

    published: Published
    finished: Future[concurrent.futures.Future[WarpedFile]]


class InverseNode(BrainshiftNode):
    """Feeds an :class:`InverseCase` from its topics, and warps the MR by what that has published."""

    def __init__(self) -> None:
        super().__init__("inverse")
        usual = InverseOptions()
        options = InverseOptions(
            method=self.parameter("method", usual.method, "how the weights are found", choices=METHODS),
            max_outside_mm=self.parameter(
                "max_outside_mm", usual.max_outside_mm, "mm; points farther outside the brain are dropped", (0.0, 50.0)
            ),
            outlier_sigmas=self.parameter(
                "outlier_sigmas",
                usual.outlier_sigmas,
                "a point with a larger residual, in robust sigmas, is dropped",
                (2.0, 100.0),
            ),
        )
        arrows = self.parameter("arrows", 300, "arrows in displacement_markers, at most", (1, 5000))
        image_file = self.parameter("image_file", "", "path of the MR (NIfTI) that ~/warp_image warps")
        output_dir = self.parameter("output_dir", "out/case", "folder that ~/warp_image writes to")
        self._case = InverseCase(self, options, arrows)
        self._warper = ImageWarper(image_file, output_dir)
        self._warping = self.create_worker()
        self._warps = itertools.count()
        self._warp: Warp | None = None
        self.take(ATLAS_INFO, lambda message: decode_text(AtlasInfo, message, ATLAS_INFO), self._case.announce)
        self.take(HOMOLOGOUS_POINTS, decode_measurement, self._case.measure)
        self.take(ATLAS_RETRACTION, decode_columns, self._case.retract)
        self.serve("warp_image", self._warp_image)

    async def _warp_image(self, _: Any, response: Any) -> Any:
        """Answer `~/warp_image` when the image is written; the executor serves everything else meanwhile."""
        published = self._case.published
        if published is None:
            response.success, response.message = False, "there is no valid displacement field to warp by"
            return response
        warp = self._warp
        if warp is None or warp.published is not published or warp.finished.done():
            warp = self._warp = self._start_warp(published)
        result = await warp.finished
        assert result is not None
        if error := result.exception():
            response.success, response.message = False, str(error)
            return response
        warped = result.result()
        newer = () if self._case.published is published and self._case.current else ("newer inputs have come since",)
        response.success, response.message = True, "; ".join([str(warped.path), *warped.warnings, *newer])
        return response

    def _start_warp(self, published: Published) -> Warp:
        case = self._case.number
        finished: Future[concurrent.futures.Future[WarpedFile]] = Future(executor=self.executor)

        def warp() -> WarpedFile:
            return self._warper.warp(published.estimate.field, wanted=lambda: self._case.number == case)

        # Each under a key of its own: a warp that waits must not be replaced, since someone waits for its answer.
        self._warping.submit(f"warp {next(self._warps)}", warp, finished.set_result)
        return Warp(published, finished)
