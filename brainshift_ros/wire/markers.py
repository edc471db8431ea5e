"""visualization_msgs for RViz and Foxglove: the brain's surface, and arrows of displacement with their scale in mm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainshift_ros.graph import ATLAS_SURFACE, DISPLACEMENT_MARKERS
from brainshift_ros.units import m_to_mm
from brainshift_ros.wire.plain import Plain, header

# Of visualization_msgs/msg/Marker.
_ARROW, _TEXT, _TRIANGLES, _ADD, _DELETE_ALL = 0, 9, 11, 0, 3

_NO_ROTATION = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
#: Matplotlib's viridis at nine equal steps; importing matplotlib would take longer than everything else that a node imports.
_VIRIDIS = np.array(
    [
        [0.267, 0.005, 0.329],
        [0.279, 0.175, 0.483],
        [0.230, 0.322, 0.546],
        [0.173, 0.449, 0.558],
        [0.128, 0.567, 0.551],
        [0.158, 0.684, 0.502],
        [0.369, 0.789, 0.383],
        [0.678, 0.864, 0.190],
        [0.993, 0.906, 0.144],
    ]
)

#: Of a field that newer inputs have outdated, and of the text that says so.
_OUTDATED = {"r": 0.6, "g": 0.6, "b": 0.6, "a": 0.35}
_NOTICE = {"r": 0.9, "g": 0.3, "b": 0.1, "a": 1.0}


def surface_marker(nodes: NDArray[np.floating], facets: NDArray[np.integer], stamp_ns: int) -> Plain:
    """Plain Marker: a translucent triangle surface, each facet with its own three corners, metres, patient frame."""
    return {
        "header": header(str(ATLAS_SURFACE.frame), stamp_ns),
        "ns": "surface",
        "id": 0,
        "type": _TRIANGLES,
        "action": _ADD,
        "pose": _NO_ROTATION,
        "scale": {"x": 1.0, "y": 1.0, "z": 1.0},
        "color": {"r": 0.85, "g": 0.7, "b": 0.65, "a": 0.4},
        "points": [_point(corner) for corner in nodes[facets].reshape(-1, 3)],
    }


def displacement_markers(
    nodes: NDArray[np.floating],
    facets: NDArray[np.integer],
    displacement: NDArray[np.floating],
    count: int,
    stamp_ns: int,
    *,
    current: bool = True,
) -> Plain:
    """Plain MarkerArray: arrows from surface nodes to where they are now, coloured by length, and the colour scale in mm.

    Parameters
    ----------
    nodes, displacement
        Shapes (N, 3), metres, patient frame.
    facets
        Shape (F, 3): the surface whose nodes carry arrows.
    count
        How many arrows at most; nodes are picked evenly over the surface.
    stamp_ns
        Time of the measurement.
    current
        False if newer inputs gave no valid field: everything turns grey, and a text says so.

    Notes
    -----
    The first marker deletes the arrows of an earlier field, which may have had more.
    """
    chosen = spread_out(nodes, np.unique(facets), count)
    length_mm = m_to_mm(np.linalg.norm(displacement[chosen], axis=1))
    largest_mm = float(length_mm.max(initial=0.0))
    shade = length_mm / largest_mm if largest_mm > 0.0 else length_mm
    common = {"header": header(str(DISPLACEMENT_MARKERS.frame), stamp_ns), "pose": _NO_ROTATION, "action": _ADD}
    starts, ends = nodes[chosen].tolist(), (nodes[chosen] + displacement[chosen]).tolist()
    arrows = [
        {
            **common,
            "ns": "displacement",
            "id": number,
            "type": _ARROW,
            "scale": {"x": 0.0008, "y": 0.002, "z": 0.0},  # shaft and head diameter, metres
            "color": colour,
            "points": [_point(start), _point(end)],
        }
        for number, (start, end, colour) in enumerate(zip(starts, ends, _colours(shade, current), strict=True))
    ]
    top_m = float(nodes[chosen, 2].max(initial=0.0)) + 0.02
    fractions = np.linspace(0.0, 1.0, 5)
    lines = [f"{fraction * largest_mm:.1f} mm" for fraction in fractions]
    texts = [("scale", line, colour) for line, colour in zip(lines, _colours(fractions, current), strict=True)]
    if not current:
        texts.append(("notice", "not of the newest measurement", _NOTICE))
    labels = [
        {
            **common,
            "ns": namespace,
            "id": number,
            "type": _TEXT,
            "pose": {**_NO_ROTATION, "position": _point([0.0, 0.0, top_m + 0.008 * number])},
            "scale": {"x": 0.0, "y": 0.0, "z": 0.006},  # height of the letters, metres
            "color": colour,
            "text": text,
        }
        for number, (namespace, text, colour) in enumerate(texts)
    ]
    return {"markers": [_delete_all(stamp_ns), *arrows, *labels]}


def no_markers(stamp_ns: int) -> Plain:
    """Plain MarkerArray that clears a display of every arrow and text of an earlier field."""
    return {"markers": [_delete_all(stamp_ns)]}


def spread_out(nodes: NDArray[np.floating], candidates: NDArray[np.integer], count: int) -> NDArray[np.integer]:
    """At most `count` of the candidates, one in each cell of a grid that is just coarse enough: even, and always the same."""
    if len(candidates) <= count:
        return candidates
    offset = nodes[candidates] - nodes[candidates].min(axis=0)
    # A closed surface of extent L passes through some 6 (L / cell)^2 cells; this starts finer than needed and grows.
    cell = float(offset.max()) / np.sqrt(count)
    while True:
        column, row, layer = np.floor(offset / cell).astype(np.int64).T
        side = int(max(column.max(), row.max(), layer.max())) + 1
        _, first = np.unique((layer * side + row) * side + column, return_index=True)
        if len(first) <= count:
            return candidates[np.sort(first)]
        cell *= 1.1


def _delete_all(stamp_ns: int) -> Plain:
    placed = {"header": header(str(DISPLACEMENT_MARKERS.frame), stamp_ns), "pose": _NO_ROTATION}
    return {**placed, "ns": "", "id": 0, "type": _ARROW, "action": _DELETE_ALL}


def _colours(fractions: NDArray[np.floating], current: bool) -> list[Plain]:
    """Viridis at each fraction from 0 to 1; translucent grey if not current."""
    if not current:
        return [_OUTDATED] * len(fractions)
    steps = np.linspace(0.0, 1.0, len(_VIRIDIS))
    rgb = np.stack([np.interp(fractions, steps, channel) for channel in _VIRIDIS.T], axis=1).tolist()
    return [{"r": r, "g": g, "b": b, "a": 1.0} for r, g, b in rgb]


def _point(xyz: NDArray[np.floating] | list[float]) -> Plain:
    return {"x": float(xyz[0]), "y": float(xyz[1]), "z": float(xyz[2])}
