"""Runs the work of a command whose outcome is a `Result`, and shows that."""

import argparse
from collections.abc import Callable

from anser_ros.cli.output import Result, say
from anser_ros.cli.progress import Tell, progress_of


def carry_out(
    command: str, stage: str, work: Callable[[argparse.Namespace, Tell], Result],
    args: argparse.Namespace,
) -> int:  # fmt: skip
    """Work under a bar of progress, show the result, and return the exit code."""
    with progress_of(stage) as tell:
        result = work(args, tell)
    say(command, result, as_json=args.json)
    return 0
