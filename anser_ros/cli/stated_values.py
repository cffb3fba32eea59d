"""Adds options that several commands share: where results go, values stated, bodies surveyed."""

import argparse
from pathlib import Path
from typing import Any

# Nothing that needs numpy is imported here: doctor reports where that is missing.


def add_out(parser: argparse.ArgumentParser, what: str = '', **options: Any) -> None:
    """Declare ``--out``, a folder for what is written; required unless stated otherwise."""
    words = f'folder for {what}, made if missing' if what else 'folder, made if missing'
    parser.add_argument('--out', type=Path, help=words, **{'required': True, **options})


def add_json(parser: argparse.ArgumentParser, what: str) -> None:
    """Declare ``--json``, of which ``what`` says what it prints."""
    parser.add_argument('--json', action='store_true', help=f'print {what}')


def add_list(parser: argparse.ArgumentParser, option: str, **options: Any) -> None:
    """Declare an option that may be repeated; its default is an empty list."""
    parser.add_argument(option, action='append', default=[], **options)


def add_stated_values(parser: argparse.ArgumentParser, *sections: str) -> None:
    """Declare ``--set``; ``sections`` of `SECTIONS` are those that the command uses."""
    from anser_ros.settings import SECTIONS

    names = ', '.join(name for section in sections for name in SECTIONS[section])
    words = 'state a value in place of the setup document and the default; may be repeated. '
    add_list(parser, '--set', dest='stated', metavar='NAME=VALUE', help=f'{words}Names: {names}')


def stated_values(args: argparse.Namespace) -> dict[str, float]:
    """Return the values that the command line states; raises as `parse_entries`."""
    from anser_ros.settings import parse_entries

    return parse_entries(args.stated)


def add_model(parser: argparse.ArgumentParser, **options: Any) -> None:
    """Declare ``--model``."""
    words = "model file, or 'nominal' for the setup's own geometry"
    parser.add_argument('--model', help=words, **options)


def add_session_options(parser: argparse.ArgumentParser) -> None:
    """Declare what a session is taken with: a model, a baseline, bodies surveyed again."""
    add_model(parser)
    parser.add_argument('--baseline', help='distortion-free recording of the same board')
    add_list(
        parser, '--resurveyed', metavar='BODY',
        help='the sensors on BODY are those of the model, and were surveyed again: their '
        'channels are corrected as the model says, and their places and axes are those of '
        'the session; may be repeated',
    )  # fmt: skip
    add_stated_values(parser, 'accuracy', 'refit', 'tools')
