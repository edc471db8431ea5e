"""`brainshift replay`: publish a recorded bag."""

from __future__ import annotations

from brainshift_ros.cli.tools import tool_command

command = tool_command("replay")
