"""Lets `anser evaluate` follow metal that `anser known_metal` has learnt, by the tools alone."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from anser_ros.apps.lab.metal_follower import models_of
from anser_ros.errors import ParameterError
from anser_ros.sessions.follower import FrameModels
from anser_ros.sessions.prepared import PreparedSession


def add_options(parser: argparse.ArgumentParser) -> None:
    """Declare the option."""
    parser.add_argument(
        '--known-metal', type=Path, metavar='FILE',
        help='metal that anser known_metal has learnt: let the model follow it by the tools, '
        'without references',
    )  # fmt: skip


def models(
    args: argparse.Namespace, others: Sequence[str]
) -> Callable[[PreparedSession], FrameModels] | None:
    """Return what gives the model of each frame, None where the option is not given.

    Raises `ParameterError` when it is given beside other options that give a model.
    """
    if args.known_metal is None:
        return None
    if others:
        raise ParameterError(
            f'--known-metal follows metal by the tools alone; leave out {", ".join(others)}'
        )
    return models_of(args.known_metal)
