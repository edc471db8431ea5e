"""Commands that hand over to a tool in `nodes/`: the command line itself imports no ROS."""

from __future__ import annotations

import os
import sys

import click

from brainshift_ros.runner import TOOLS, require_ros, ros_environment


def tool_command(name: str) -> click.Command:
    """Command that becomes the tool; the tool declares the options, `--help` among them."""

    @click.command(name, context_settings={"ignore_unknown_options": True}, add_help_option=False)
    @click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
    def command(arguments: tuple[str, ...]) -> None:
        require_ros()
        sys.stdout.flush()
        # Replaced, not started: signals and exit status are then the tool's own.
        os.execve(sys.executable, [sys.executable, "-m", TOOLS[name], *arguments], ros_environment())

    return command
