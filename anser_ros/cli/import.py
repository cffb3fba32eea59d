"""Make a session bag of tables (CSV, NumPy, MATLAB) or of another program's bag."""

import argparse
import json
import sys
from pathlib import Path

from anser_ros.cli.output import check_new_file, say_written
from anser_ros.cli.progress import progress_of
from anser_ros.errors import ParameterError
from anser_ros.sessions.bag_import import import_bag, parse_remaps
from anser_ros.sessions.table_import import import_tables
from anser_ros.wire.text_files import read_text

SCHEMA = 'anser_import_result/1'
DOCUMENTS = ('.yaml', '.yml')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        'example: anser import examples/data/tables.yaml --out session.mcap; with the bag of '
        'another program: anser import rosbag2_folder/ --remap /em/flux:=/anser/tool/flux '
        '--setup board.yaml --out session.mcap'
    )
    parser.add_argument(
        'source',
        type=Path,
        help='document (.yaml) that describes tables, or a bag: .db3, .mcap, or its folder',
    )
    parser.add_argument(
        '--out',
        required=True,
        type=Path,
        help='the .mcap file to write, which must not exist yet; its folder is made if missing',
    )
    parser.add_argument(
        '--remap',
        action='append',
        default=[],
        metavar='/FROM:=/TO',
        help='new name of a topic of the bag; may be repeated',
    )
    parser.add_argument('--setup', type=Path, help='setup document, in place of any in the bag')
    parser.add_argument('--json', action='store_true', help='print what was written as JSON')


def run(args: argparse.Namespace) -> int:
    """Run the command; the exit code."""
    check_new_file(args.out)
    is_document = args.source.suffix in DOCUMENTS
    if is_document and (args.remap or args.setup is not None):
        raise ParameterError('--remap and --setup are for bags; a document names its own setup')
    lost, left_out = '', {}
    with progress_of('importing') as tell:
        tell(f'reading {args.source}')
        if is_document:
            counts = import_tables(args.source, args.out)
        else:
            setup = None if args.setup is None else read_text(args.setup)
            bag = import_bag(args.source, args.out, parse_remaps(args.remap), setup)
            counts, lost, left_out = bag.messages, bag.lost, bag.left_out
    if lost:
        print(f'anser import: {args.source}: {lost}', file=sys.stderr)
    for topic, count in left_out.items():
        print(f'anser import: {count} messages of {topic} left out', file=sys.stderr)
    if args.json:
        document = {'schema': SCHEMA, 'messages': counts, 'left_out': left_out, 'lost': lost}
        print(json.dumps(document, indent=1))
    else:
        for topic, count in sorted(counts.items()):
            print(f'{topic}: {count} messages')
        say_written(args.out)
    return 0
