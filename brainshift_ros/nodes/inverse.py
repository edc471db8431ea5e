"""Executable `inverse`."""

from __future__ import annotations

from brainshift_ros.nodes.starting import run_node


def main() -> None:
    """Run the node until it is told to stop."""
    run_node("brainshift_ros.nodes.inverse_node", "InverseNode")


if __name__ == "__main__":
    main()
