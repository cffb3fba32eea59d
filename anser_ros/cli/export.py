"""Write the poses and fluxes of a bag as CSV, TUM or MATLAB files."""

import argparse

from anser_ros.cli.output import Result, Tell, add_json, add_out, make_folder
from anser_ros.sessions.import_export import CSV, FORMATS, export_bag

SCHEMA = 'anser_export/1'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = 'example: anser export bags/moving.mcap --format tum --out poses/'
    parser.add_argument('bag', help='bag to read (.mcap file or bag folder)')
    add_out(parser)
    words = 'csv (default), tum (poses only, for evo) or mat (MATLAB)'
    parser.add_argument('--format', choices=FORMATS, default=CSV, help=words)
    add_json(parser, 'the written files as JSON')


def work(args: argparse.Namespace, tell: Tell) -> Result:
    make_folder(args.out)
    tell(f'reading {args.bag}')
    rows, lost = export_bag(args.bag, args.out, args.format)
    document = {'schema': SCHEMA, 'rows': rows, 'lost': lost}
    notes = (f'{args.bag}: {lost}',) if lost else ()
    return Result(document, notes, (), tuple(args.out / name for name in rows))
