"""How replay and record end: they are commands, not nodes of the graph."""

from __future__ import annotations

import sys

import click

from brainshift_ros.errors import InputError
from brainshift_ros.nodes.stopping import leave


def run_tool(command: click.Command, name: str) -> None:
    """Run a command; bad input ends the process with one line on stderr and exit status 2."""
    try:
        command(prog_name=f"brainshift {name}")
    except InputError as error:
        print(f"brainshift: {error}", file=sys.stderr)
        leave(2)
