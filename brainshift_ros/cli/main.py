"""Entry point of the `brainshift` command: one module a subcommand, imported only when it runs."""

from __future__ import annotations

import sys
from importlib import import_module

import click
from rich.console import Console

from brainshift_ros import __version__
from brainshift_ros.errors import InputError

#: Subcommand -> module that holds it as a click command named `command`, and its line in `brainshift --help`.
#: A module is imported only when its command runs, so that `--help` stays instant.
COMMANDS: dict[str, tuple[str, str]] = {
    "segment": ("brainshift_ros.cli.segment", "T1 MR -> labels and septa, to be looked at and corrected."),
    "compare": ("brainshift_ros.cli.compare", "Automatic labels and septa against a person's."),
    "patient": ("brainshift_ros.cli.patient", "T1 MR -> patient model (segmentation, septa, mesh, tissue)."),
    "atlas": ("brainshift_ros.cli.atlas", "Scene and patient -> atlas of deformations."),
    "track": ("brainshift_ros.cli.track", "Recorded scans -> homologous points, without ROS."),
    "solve": ("brainshift_ros.cli.solve", "Atlas and sparse points -> displacement field."),
    "warp": ("brainshift_ros.cli.warp", "Displacement field and image -> warped image, ITK transform."),
    "sample": ("brainshift_ros.cli.sample", "Displacement and standard deviation at any points."),
    "run": ("brainshift_ros.cli.run", "Start the node graph, without `ros2`."),
    "replay": ("brainshift_ros.cli.replay", "Publish a recorded bag."),
    "record": ("brainshift_ros.cli.record", "Record the graph's topics into a bag."),
    "experiment": ("brainshift_ros.cli.experiment", "A study of accuracy, speed or stability."),
    "demo": ("brainshift_ros.cli.demo", "The whole job once, on a real brain."),
}


class _LazyGroup(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = import_module(COMMANDS[cmd_name][0]).command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, help_line) for name, (_, help_line) in COMMANDS.items()])


@click.group(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__)
def brainshift() -> None:
    """Keep a preoperative MR in register with a brain that shifts during surgery (research software)."""


def main() -> None:
    """Run the command; bad input ends with one line on stderr and status 2, a full disk or the like with one and status 1."""
    try:
        brainshift(prog_name="brainshift")
    except InputError as error:
        Console(stderr=True).print(f"brainshift: {error}", style="red", markup=False, highlight=False, soft_wrap=True)
        sys.exit(2)
    except OSError as error:
        Console(stderr=True).print(f"brainshift: {error}", style="red", markup=False, highlight=False, soft_wrap=True)
        sys.exit(1)


if __name__ == "__main__":
    main()
