"""Write the poses and fluxes of a bag as CSV, TUM or MATLAB files."""

import argparse
import json
import sys
from pathlib import Path

from anser_ros.cli.folders import make_folder
from anser_ros.cli.output import say_written
from anser_ros.cli.progress import progress_of
from anser_ros.sessions.bag_export import CSV, FORMATS, export_bag

SCHEMA = 'anser_export/1'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = 'example: anser export bags/moving.mcap --format tum --out poses/'
    parser.add_argument('bag', help='bag to read (.mcap file or bag folder)')
    parser.add_argument('--out', required=True, type=Path, help='folder, made if missing')
    parser.add_argument(
        '--format', choices=FORMATS, default=CSV,
        help='csv (default), tum (poses only, for evo) or mat (MATLAB)',
    )  # fmt: skip
    parser.add_argument('--json', action='store_true', help='print the written files as JSON')


def run(args: argparse.Namespace) -> int:
    """Run the command; the exit code."""
    make_folder(args.out)
    with progress_of('exporting') as tell:
        tell(f'reading {args.bag}')
        found = export_bag(args.bag, args.out, args.format)
    if found.lost:
        print(f'anser export: {args.bag}: {found.lost}', file=sys.stderr)
    if args.json:
        print(json.dumps({'schema': SCHEMA, 'rows': found.rows, 'lost': found.lost}, indent=1))
    else:
        say_written(*(args.out / name for name in found.rows))
    return 0
