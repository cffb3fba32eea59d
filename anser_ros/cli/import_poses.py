"""Turn files of tracked and optical poses, in the forms that trackers write, into a bag."""

import argparse
import json
from pathlib import Path

from anser_ros.cli.output import check_new_file, say_written
from anser_ros.cli.progress import progress_of
from anser_ros.errors import ParameterError
from anser_ros.poses.forms import ORDERS
from anser_ros.poses.importing import STAMPS, import_poses
from anser_ros.poses.recording import write_pose_session
from anser_ros.sessions.units import LENGTH_M
from anser_ros.wire.setup_values import read_name

SCHEMA = 'anser_import_poses/1'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = (
        'example: anser import_poses examples/data/pivot.csv --out session.mcap; '
        'with a reference: anser import_poses EM.tsv --reference OT.tsv --out session.mcap'
    )
    parser.add_argument(
        'tracked',
        nargs='+',
        type=Path,
        help='files of tracked poses: ToolTracker .tsv, lines of "Key: numbers", TUM or CSV',
    )
    parser.add_argument(
        '--reference',
        nargs='+',
        type=Path,
        default=[],
        help='files of the optical reference, as many and in the same order',
    )
    parser.add_argument(
        '--out',
        required=True,
        type=Path,
        help='the .mcap file to write, its folder made if missing',
    )
    parser.add_argument(
        '--stamps', choices=STAMPS, default='host', help='which of their times becomes the stamp'
    )
    parser.add_argument('--unit', choices=list(LENGTH_M), help='unit of the tracked positions')
    parser.add_argument(
        '--quaternion', choices=list(ORDERS), help='how the tracked quaternions are written'
    )
    parser.add_argument(
        '--name',
        action='append',
        default=[],
        metavar='FOUND=NEW',
        help='another name for a sensor than that of its file or port; may be repeated',
    )
    parser.add_argument('--json', action='store_true', help='print what was written as JSON')


def parse_name(text: str) -> tuple[str, str]:
    """Return a sensor's name as it is found, and the one that it shall have."""
    found, _, new = text.partition('=')
    if not found or not new:
        raise ParameterError(f'--name takes FOUND=NEW, got {text!r}')
    return found, read_name(new, '--name')


def run(args: argparse.Namespace) -> int:
    """Run the command; the exit code."""
    names = [parse_name(text) for text in args.name]
    check_new_file(args.out)
    with progress_of('reading') as tell:
        session = import_poses(
            args.tracked,
            args.reference,
            stamps=args.stamps,
            unit=args.unit,
            quaternion=args.quaternion,
            names=dict(names),
        )
        tell(f'writing {args.out}')
        write_pose_session(args.out, session)
    rows = {
        poses.name: {
            'poses': poses.size, 'missing': poses.missing.size, 'out_of_order': poses.unordered,
        }
        for poses in session.streams.values()
    }  # fmt: skip
    if args.json:
        document = {
            'schema': SCHEMA, 'file': str(args.out), 'sequences': rows, 'lost': session.lost,
        }  # fmt: skip
        print(json.dumps(document, indent=1))
        return 0
    for name, one in rows.items():
        print(
            f'{name}: {one["poses"]} poses, {one["missing"]} missing, '
            f'{one["out_of_order"]} out of order'
        )
    if session.lost:
        print(session.lost)
    say_written(args.out)
    return 0
