"""Chart of :mod:`brainshift_ros.experiments.atlas_content`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from brainshift_ros.experiments.atlas_studies import values_of

#: Power of the components by part of the atlas and by where it is looked at, of several draws of points or once.
Spectra = Mapping[tuple[str, str], Sequence[NDArray[np.float64]]]

_PART_COLORS = {
    "gravity": "#2171b5",
    "mannitol": "#d94801",
    "gravity and mannitol": "#252525",
    "both, less their mean": "#41ab5d",
    "both, free cap": "#88419d",
}
_KIND_COLORS = {"as in the thesis": "#fd8d3c", "independent": "#6baed6"}
_SHOWN = 25


def chart(
    spectra: Spectra,
    rows: Sequence[Mapping[str, Any]],
    components: tuple[int, int],
    nonzero: tuple[int, int],
) -> Figure:
    """Draw what components leave out, how many weights are not zero, and mannitol's share against the truth's."""
    figure = Figure(figsize=(15, 4.8), layout="constrained")
    scree, weights, shares = figure.subplots(1, 3, width_ratios=(1.25, 1.0, 1.0))
    _scree(scree, spectra, components)
    _weights(weights, rows, nonzero)
    _shares(shares, [row for row in rows if row["truths"] == "independent"])
    return figure


def _scree(axes: Axes, spectra: Spectra, expected: tuple[int, int]) -> None:
    for (part, where), many in spectra.items():
        # Summed from the small end, so that the last components are not lost in round-off.
        left = np.array([np.append(np.cumsum(power[::-1])[::-1][1:], 0.0)[:_SHOWN] for power in many])
        count = np.arange(1, left.shape[1] + 1)
        style = "-" if len(many) > 1 else "--"
        axes.plot(count, 100.0 * np.median(left, axis=0), style, color=_PART_COLORS[part], label=f"{part}, {where}")
        if len(many) > 1:
            axes.fill_between(
                count, *(100.0 * end(axis=0) for end in (left.min, left.max)), color=_PART_COLORS[part], alpha=0.15
            )
    axes.axvspan(*expected, color="0.9", zorder=0, label="thesis: 99 % at the points")
    for percent in (5.0, 1.0, 0.1):
        axes.axhline(percent, color="0.5", linestyle=":", linewidth=0.9)
    axes.set_yscale("log")
    axes.set_ylim(1e-3, 100.0)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("principal components")
    axes.set_ylabel("power that they leave out, %")
    axes.set_title("components of the atlas (bands: points of 8 truths)", fontsize=10)
    axes.legend(fontsize=7)
    axes.grid(alpha=0.2)


def _weights(axes: Axes, rows: Sequence[Mapping[str, Any]], expected: tuple[int, int]) -> None:
    top = int(max(row["nonzero"] for row in rows))
    bins = np.arange(0.5, top + 1.5).tolist()
    for kind, color in _KIND_COLORS.items():
        counts = values_of(rows, "nonzero", truths=kind)
        axes.hist(counts, bins, histtype="stepfilled", color=color, alpha=0.5, label=f"truths {kind}")
        large = values_of(rows, "nonzero_1_percent", truths=kind)
        axes.hist(large, bins, histtype="step", color=color, linewidth=1.8, linestyle="--", label="of them over 1 % of the sum")
    axes.axvspan(expected[0] - 0.5, expected[1] + 0.5, color="0.9", zorder=0, label="thesis")
    axes.set_xlabel("non-zero weights of an estimate")
    axes.set_ylabel("estimates")
    axes.set_title("weights that are in use", fontsize=10)
    axes.legend(fontsize=8)


def _shares(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    for resected, marker, color in ((False, "o", "#2171b5"), (True, "s", "#d94801")):
        own = [row for row in rows if row["resected"] == resected]
        true, found = ([row[column] for row in own] for column in ("true_mannitol", "mannitol_share"))
        label = "resected" if resected else "not resected"
        axes.plot(true, found, marker, color=color, alpha=0.6, markersize=5, label=label)
    axes.set_ylim(-0.05, 1.05)
    axes.set_xlabel("the drug's load in the truth, beside all of gravity's")
    axes.set_ylabel("mannitol's share of the weights")
    axes.set_title("mechanisms, independent truths (0: no drug was given)", fontsize=10)
    axes.legend(fontsize=8)
    axes.grid(alpha=0.25)
