"""The option ``--set NAME=VALUE``, which states a value before the setup document does."""

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
    """The values that the command line states; raises `ParameterError` as `parse_entries`."""
    return parse_entries(args.stated)
