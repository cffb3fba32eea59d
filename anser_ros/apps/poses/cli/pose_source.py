"""Adds options to commands that assess a body's poses, and takes poses of the live graph."""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from anser_ros.apps.poses.assessment.source import AssessedPoses, PoseSource
from anser_ros.apps.poses.sequence import PoseSession, sequence_of
from anser_ros.cli.main import check_packages
from anser_ros.errors import BagError, ParameterError
from anser_ros.sessions.plausibility import check_positions
from anser_ros.wire.setup_values import read_tips
from anser_ros.wire.text_files import read_text

PATIENCE_S = 20.0
"""Time, s, that the look at the graph may take beyond what it was asked for: ROS has to start."""
LONGEST_LOOK_S = 3600.0
"""Longest time that a command listens to live poses, s: an hour, more is a recording's work."""


def add_source_options(parser: argparse.ArgumentParser, *, tip: bool = True) -> None:
    """Declare which poses of a recording are meant."""
    parser.add_argument(
        '--topic', default='', metavar='TOPIC',
        help='topic of the poses (PoseStamped), if the bag has several',
    )  # fmt: skip
    parser.add_argument(
        '--model', default='', metavar='MODEL',
        help="track the bag's fluxes with this model (or 'nominal') instead of reading poses",
    )  # fmt: skip
    parser.add_argument('--body', default='', help='which tool, if there are several')
    parser.add_argument('--sensor', default='', help='which sensor, of several in a bag or file')
    if tip:
        parser.add_argument(
            '--tip', type=Path, metavar='FILE',
            help='use the poses of the tip: tips.yaml of pivot, or a setup document with the tip',
        )  # fmt: skip


def source_of(args: argparse.Namespace) -> PoseSource:
    """Return which poses the options mean.

    Raises `ParameterError` when a file of tips has several and no body is named.
    """
    place = None
    if getattr(args, 'tip', None) is not None:
        tips = read_tips(read_text(args.tip))
        if args.body not in tips and (args.body or len(tips) != 1):
            raise ParameterError(f'{args.tip}: name the body, one of {", ".join(tips)}')
        place = np.array((tips[args.body] if args.body else next(iter(tips.values()))).position_m)
    return PoseSource(
        args.topic, args.body, args.sensor, args.model, getattr(args, 'optical', None) or '', place
    )


def live_poses(
    topic: str, seconds: float, progress: Callable[[str, float], None]
) -> AssessedPoses:
    """Return poses of a topic of the running graph, received for some seconds from the first one
    on. Raises `ParameterError` when the time is not one that can be waited, `BagError` when there
    is no pose on the topic, `MissingPackageError` when there is no ROS, `PlausibilityError` when
    the positions cannot be in metres.
    """
    if not 0.0 < seconds <= LONGEST_LOOK_S:
        raise ParameterError(f'--seconds must be in (0, {LONGEST_LOOK_S:g}], got {seconds:g}')
    check_packages('tracker')
    code = f'from anser_ros.apps.poses.nodes.pose_look import main; main({topic!r}, {seconds!r})'
    rows: list[list[float]] = []
    with subprocess.Popen(
        [sys.executable, '-c', code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as look:
        assert look.stdout is not None and look.stderr is not None
        try:
            for line in look.stdout:
                rows.append(json.loads(line))
                past = (rows[-1][0] - rows[0][0]) * 1e-9
                progress('pivot now, tilting to all sides', min(max(past / seconds, 0.0), 1.0))
            words = look.stderr.read().strip().splitlines()
            look.wait(PATIENCE_S)
        except BaseException:
            look.kill()
            raise
    if not rows:
        raise BagError(words[-1] if words else f'no pose on {topic}')
    stamps = np.array([int(row[0]) for row in rows], dtype=np.int64)
    table = np.array([row[1:] for row in rows])
    name = topic.removesuffix('/pose').lstrip('/')
    poses = sequence_of(name, (stamps - stamps[0]) * 1e-9, table[:, :3], table[:, 3:])
    check_positions(topic, poses.position)
    session = PoseSession(topic, int(stamps[0]), {name: poses}, None)
    return AssessedPoses(name, poses, session)
