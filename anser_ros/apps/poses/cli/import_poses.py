"""Turn files of tracked and optical poses, in the forms that trackers write, into a bag."""

import argparse
from pathlib import Path

from anser_ros.apps.poses.forms import ORDERS
from anser_ros.apps.poses.importing import STAMPS, import_poses, write_pose_session
from anser_ros.cli.output import Result, Tell, add_json, add_list, check_new_file
from anser_ros.errors import ParameterError
from anser_ros.wire.setup_values import read_name
from anser_ros.wire.table_names import LENGTH_M

SCHEMA = 'anser_import_poses/1'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        'example: anser import_poses examples/data/pivot.csv --out session.mcap; '
        'with a reference: anser import_poses EM.tsv --reference OT.tsv --out session.mcap'
    )
    parser.add_argument(
        'tracked', nargs='+', type=Path,
        help='files of tracked poses: ToolTracker .tsv, lines of "Key: numbers", TUM or CSV',
    )  # fmt: skip
    parser.add_argument(
        '--reference', nargs='+', type=Path, default=[],
        help='files of the optical reference, as many and in the same order',
    )  # fmt: skip
    parser.add_argument(
        '--out', required=True, type=Path,
        help='the .mcap file to write, its folder made if missing',
    )  # fmt: skip
    add_form_options(parser)
    add_list(
        parser, '--name', metavar='FOUND=NEW',
        help='another name for a sensor than that of its file or port; may be repeated',
    )  # fmt: skip
    add_json(parser, 'what was written as JSON')


def add_form_options(parser: argparse.ArgumentParser, when: str = '') -> None:
    """Declare the options that say how files of poses are written."""
    parser.add_argument(
        '--stamps', choices=STAMPS, default='host',
        help=f'{when}which of their times becomes the stamp',
    )  # fmt: skip
    parser.add_argument(
        '--unit', choices=list(LENGTH_M), help=f'{when}unit of the tracked positions'
    )
    parser.add_argument(
        '--quaternion', choices=list(ORDERS),
        help=f'{when}how the tracked quaternions are written',
    )  # fmt: skip
    for option, whose in (('--shift', 'tracked'), ('--shift-reference', "reference's")):
        words = f'{when}seconds that are added to the {whose} stamps of a host'
        parser.add_argument(option, type=float, default=0.0, metavar='S', help=words)


def parse_name(text: str) -> tuple[str, str]:
    """Return a sensor's name as it is found, and the one that it shall have."""
    found, _, new = text.partition('=')
    if not found or not new:
        raise ParameterError(f'--name takes FOUND=NEW, got {text!r}')
    return found, read_name(new, '--name')


def work(args: argparse.Namespace, tell: Tell) -> Result:
    """Write the bag."""
    names = dict(parse_name(text) for text in args.name)
    check_new_file(args.out)
    session = import_poses(
        args.tracked, args.reference, stamps=args.stamps, unit=args.unit,
        quaternion=args.quaternion, names=names, shift_s=(args.shift, args.shift_reference),
    )  # fmt: skip
    tell(f'writing {args.out}')
    write_pose_session(args.out, session)
    rows = {
        poses.name: {
            'poses': poses.size, 'missing': poses.missing.size, 'out_of_order': poses.unordered,
        }
        for poses in session.streams.values()
    }  # fmt: skip
    shown = [
        f'{name}: {one["poses"]} poses, {one["missing"]} missing, '
        f'{one["out_of_order"]} out of order'
        for name, one in rows.items()
    ]
    document = {
        'schema': SCHEMA, 'file': str(args.out), 'sequences': rows, 'lost': session.lost,
    }  # fmt: skip
    return Result(document, (), (*shown, *filter(None, [session.lost])), (args.out,))
