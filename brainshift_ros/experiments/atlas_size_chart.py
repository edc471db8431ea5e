"""Chart of :mod:`brainshift_ros.experiments.atlas_size`: orientations as in figure 21, errors as in figure 28."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brainshift_ros.atlas.orientations import directions_in_cone
from brainshift_ros.experiments.atlas_studies import polar
from brainshift_ros.experiments.inverse_truths import CONE_DEG, PLANNED

_STYLES: Mapping[str, tuple[str, str]] = {
    "left out in turn": ("#d94801", "o-"),
    "left out in turn, inner ones": ("#fd8d3c", "^--"),
    "independent": ("#2171b5", "s-"),
}
_PANELS = ("surface", "subsurface", "deep")


def chart(rows: Sequence[Mapping[str, Any]], errors: Mapping[str, Mapping[str, Mapping[int, Mapping[str, float]]]]) -> Figure:
    """Draw where each atlas's orientations lie, and below it mean and standard deviation of the error by size and group."""
    sizes = sorted({row["orientations"] for row in rows})
    figure = Figure(figsize=(15, 7.2), layout="constrained")
    above, below = np.asarray(figure.subfigures(2, 1, height_ratios=(1.0, 2.4)))
    for axes, size in zip(above.subplots(1, len(sizes), subplot_kw={"projection": "polar"}), sizes, strict=True):
        angle, azimuth = polar(directions_in_cone(PLANNED, np.radians(CONE_DEG), size))
        axes.plot(azimuth, angle, ".", color="#2171b5", markersize=4)
        axes.set(xticks=[], yticks=[], ylim=(0.0, CONE_DEG + 1.5))
        axes.set_title(str(size), fontsize=9)
    panels = below.subplots(1, len(_PANELS))
    for axes, group in zip(panels, _PANELS, strict=True):
        _errors(axes, errors, group, sizes)
    panels[0].set_ylabel("error of the estimate, mm")
    panels[0].legend(fontsize=8, title="truths", title_fontsize=8)
    figure.suptitle(
        f"head orientations in a cone of {CONE_DEG:g}° and error of the estimate: mean and standard deviation over truths",
        fontsize=11,
    )
    return figure


def _errors(
    axes: Axes,
    errors: Mapping[str, Mapping[str, Mapping[int, Mapping[str, float]]]],
    group: str,
    sizes: Sequence[int],
) -> None:
    for k, (kind, (color, style)) in enumerate(_STYLES.items()):
        own = errors[kind].get(group, {})
        at = np.array(list(own)) * (1.0 + 0.025 * (k - 1))
        mean, std = (np.array([found[key] for found in own.values()]) for key in ("mean", "std"))
        # Errors are never negative: neither are the bars.
        axes.errorbar(at, mean, (np.minimum(std, mean), std), fmt=style, color=color, capsize=3, markersize=5, label=kind)
    axes.set_xscale("log")
    axes.set_xticks(sizes, [str(size) for size in sizes])
    axes.minorticks_off()
    axes.set_ylim(0.0, None)
    axes.set_xlabel("head orientations in the atlas")
    axes.set_title(group, fontsize=10)
    axes.grid(alpha=0.25)
