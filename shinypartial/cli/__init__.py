"""The command line `shinypartial`: one class a command. Imports every other room, inside the command that needs it."""

import contextlib
import os
import sys
from collections.abc import Iterator, Sequence

import tyro

from shinypartial.cli.datasets import Release, Subset, Validate
from shinypartial.cli.presenting import Chart, Leaderboard, Report
from shinypartial.cli.scenes import Generate
from shinypartial.cli.scoring import Compare, Evaluate, Oracle, Postprocess, Weights
from shinypartial.core.errors import EXIT_BAD_INPUT, run_command

Command = (
    Generate
    | Subset
    | Validate
    | Evaluate
    | Oracle
    | Postprocess
    | Compare
    | Weights
    | Report
    | Release
    | Leaderboard
    | Chart
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse and run; return 0, 2 for bad usage or bad input, 130 when interrupted."""

    def run() -> None:
        with _until_pipe_closes():
            command.run()

    with _until_pipe_closes():
        try:
            command: Command = tyro.cli(
                Command,  # type: ignore[arg-type]
                args=arguments,
                prog="shinypartial",
                description="Scenes, ground truth and scores for environments seen in partial reflections.",
            )
        except SystemExit as stop:
            return EXIT_BAD_INPUT if stop.code else 0
        return run_command(run)
    return 0


@contextlib.contextmanager
def _until_pipe_closes() -> Iterator[None]:
    """End without an error when the reader of standard output, such as `head`, has seen enough."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
