"""The process that :mod:`brainshift_ros.segmentation.greedy` starts: one greedy command, files in, files out."""

from __future__ import annotations

import sys

from picsl_greedy import Greedy3D


def main(command: str) -> None:
    """Run one command line of greedy in the current folder."""
    Greedy3D().execute(command)


if __name__ == "__main__":
    main(sys.argv[1])
