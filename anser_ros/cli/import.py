"""Make a session bag of tables (CSV, NumPy, MATLAB) or of another program's bag."""

import argparse
from pathlib import Path

from anser_ros.cli.output import Result, Tell, add_json, add_list, check_new_file
from anser_ros.errors import ParameterError
from anser_ros.sessions.import_export import import_bag, parse_remaps
from anser_ros.sessions.table_import import import_tables
from anser_ros.wire.text_files import read_text

SCHEMA = 'anser_import_result/1'
DOCUMENTS = ('.yaml', '.yml')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        'example: anser import examples/data/tables.yaml --out session.mcap; with the bag of '
        'another program: anser import rosbag2_folder/ --remap /em/flux:=/anser/tool/flux '
        '--setup board.yaml --out session.mcap'
    )
    words = 'document (.yaml) that describes tables, or a bag: .db3, .mcap, or its folder'
    parser.add_argument('source', type=Path, help=words)
    words = 'the .mcap file to write, which must not exist yet; its folder is made if missing'
    parser.add_argument('--out', required=True, type=Path, help=words)
    words = 'new name of a topic of the bag; may be repeated'
    add_list(parser, '--remap', metavar='/FROM:=/TO', help=words)
    parser.add_argument('--setup', type=Path, help='setup document, in place of any in the bag')
    add_json(parser, 'what was written as JSON')


def work(args: argparse.Namespace, tell: Tell) -> Result:
    """Write the bag."""
    check_new_file(args.out)
    is_document = args.source.suffix in DOCUMENTS
    if is_document and (args.remap or args.setup is not None):
        raise ParameterError('--remap and --setup are for bags; a document names its own setup')
    lost, left_out = '', {}
    tell(f'reading {args.source}')
    if is_document:
        counts, notes = import_tables(args.source, args.out)
    else:
        setup = None if args.setup is None else read_text(args.setup)
        bag = import_bag(args.source, args.out, parse_remaps(args.remap), setup)
        counts, lost, left_out = bag.messages, bag.lost, bag.left_out
        notes = [f'{count} messages of {topic} left out' for topic, count in left_out.items()]
    return Result(
        {'schema': SCHEMA, 'messages': counts, 'left_out': left_out, 'lost': lost},
        (*([f'{args.source}: {lost}'] if lost else []), *notes),
        tuple(f'{topic}: {count} messages' for topic, count in sorted(counts.items())),
        (args.out,),
    )
