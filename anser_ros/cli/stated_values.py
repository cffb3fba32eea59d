"""Adds options that several commands share: values stated, bodies surveyed again."""

import argparse

from anser_ros.settings import SECTIONS, parse_entries


def add_stated_values(parser: argparse.ArgumentParser, *sections: str) -> None:
    """Declare the option; ``sections`` of `SECTIONS` are those that the command uses."""
    names = [name for section in sections for name in SECTIONS[section]]
    parser.add_argument(
        '--set',
        action='append',
        default=[],
        dest='stated',
        metavar='NAME=VALUE',
        help='state a value in place of the setup document and the default; may be repeated. '
        f'Names: {", ".join(names)}',
    )


def stated_values(args: argparse.Namespace) -> dict[str, float]:
    """Return the values that the command line states; raises `ParameterError` as
    `parse_entries`.
    """
    return parse_entries(args.stated)


def add_resurveyed(parser: argparse.ArgumentParser) -> None:
    """Declare the option ``--resurveyed BODY``, of commands that take a model to a session."""
    parser.add_argument(
        '--resurveyed',
        action='append',
        default=[],
        metavar='BODY',
        help='the sensors on BODY are those of the model, and were surveyed again: their '
        'channels are corrected as the model says, and their places and axes are those of '
        'the session; may be repeated',
    )
