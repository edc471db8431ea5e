"""`brainshift record`: record the graph's topics."""

from __future__ import annotations

from brainshift_ros.cli.tools import tool_command

command = tool_command("record")
