"""The process that :mod:`brainshift_ros.mesh.tetwild` starts: arrays in, tetrahedra out."""

from __future__ import annotations

import sys

import numpy as np
import pytetwild


def main(given: str, made: str) -> None:
    """Mesh the surfaces in the npz file `given`; write `nodes` and `elements` to the npz file `made`. All in mm."""
    with np.load(given) as arrays:
        nodes, elements = pytetwild.tetrahedralize(
            arrays["vertices"],
            arrays["faces"],
            edge_length_abs=float(arrays["edge_length_abs"]),
            epsilon=float(arrays["epsilon"]),
            stop_energy=float(arrays["stop_energy"]),
            num_threads=int(arrays["threads"]),
            # The winding number that decides inside or outside means nothing beside open sheets.
            disable_filtering=True,
            bg_vertices=arrays["bg_vertices"],
            bg_tets=arrays["bg_tets"],
            bg_values=arrays["bg_values"],
        )
    np.savez(made, nodes=nodes, elements=elements)


if __name__ == "__main__":
    main(*sys.argv[1:])
