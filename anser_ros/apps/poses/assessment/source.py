"""Takes poses to assess from a topic of a bag, a body tracked from fluxes, or a file of poses."""

import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.importing import import_poses, read_pose_session
from anser_ros.apps.poses.sequence import PoseSequence, PoseSession, sequence_of
from anser_ros.arrays import Array
from anser_ros.errors import AnserError, BagError
from anser_ros.pose_states import OK
from anser_ros.sessions.plausibility import check_positions
from anser_ros.sessions.session import load_session
from anser_ros.sessions.starting_model import model_for
from anser_ros.sessions.tracked_session import track_session
from anser_ros.stamps import NANO
from anser_ros.wire.bag import MessageDecoder, Salvage, iter_messages, published_poses
from anser_ros.wire.recorded import ENDING, OPTICAL, POSE_TYPE, optical_topic
from anser_ros.wire.setup import Setup, parse_setup, topic_of

BAGS = ('.mcap', '.db3', '.zstd', '.bag')  # endings; a folder is a bag too
TOOL = 'tool'
"""What the body of a file of poses is called that names none."""


@dataclass(frozen=True)
class PoseSource:
    """States which poses are meant; what is not said is found where there is only one."""

    topic: str = ''  # of the poses in a bag (`geometry_msgs/PoseStamped`)
    body: str = ''  # of a session of fluxes, or of the setup document that a bag of poses has
    sensor: str = ''  # of a file of poses, or of a bag, that has several
    # with which a session of fluxes is tracked (a file, or ``nominal``); empty: poses are read
    model: str = ''
    optical: str = ''  # topic of the reference, where there are several
    # (3,), or None, place on the body, m, whose poses are meant instead of the body's own
    tip: Array | None = None


@dataclass(frozen=True)
class AssessedPoses:
    """Holds the poses of one body, and what else is known of them."""

    name: str  # of the body, sensor or topic
    poses: PoseSequence  # in the tracker's frame
    session: PoseSession  # the same with the reference, where the recording has one
    setup: Setup | None = None  # the document of a session of fluxes


def is_bag(path: Path) -> bool:
    """Return whether a recording is a bag and no file of poses."""
    return path.is_dir() or path.suffix in BAGS


def read_poses(
    path: str | os.PathLike[str],
    wanted: PoseSource,
    progress: Callable[[float], None] | None = None,
) -> AssessedPoses:
    """Read or track the poses of one body.

    Raises `BagError` when a recording has no such poses, or several and none is named,
    `PlausibilityError` when the positions cannot be in metres, and as `import_poses` and
    `track_session`.
    """
    source = Path(path)
    if wanted.model:
        found = _tracked(path, wanted, progress)
    elif is_bag(source):
        found = _recorded(path, wanted)
    else:
        session = import_poses([source])
        sensor = _only(str(path), 'sensor', wanted.sensor, list(session.sensors))
        # A file of one sensor is named after itself, and the tool is the same in the next file.
        name = wanted.body or (sensor if len(session.sensors) > 1 else TOOL)
        poses = replace(session.sensors[sensor], name=name)
        found = AssessedPoses(name, poses, replace(session, sensors={name: poses}))
    check_positions(f'{path}: {found.name}', found.poses.position)
    return found if wanted.tip is None else _carried(found, wanted.tip)


def _carried(found: AssessedPoses, tip: Array) -> AssessedPoses:
    """The poses of a place on the body."""
    poses = replace(found.poses, position=found.poses.position + found.poses.rotation @ tip)
    session = replace(found.session, sensors={found.poses.name: poses})
    return replace(found, poses=poses, session=session)


def pose_topics(path: str | os.PathLike[str]) -> tuple[list[str], Setup | None, str]:
    """Return topics of poses in a bag, its setup document where it is one of a board, and which
    topics there are at all; poses of other types than PoseStamped count where there are none.
    """
    setup, salvage, decoder = None, Salvage(), MessageDecoder()
    for raw in iter_messages(path, salvage):
        if setup is None and raw.topic.endswith('/setup'):
            with suppress(AnserError):  # a document of another schema tells no bodies
                setup = parse_setup(decoder.decode(raw).data)
    plain = [topic for topic, kind in salvage.topics.items() if kind == POSE_TYPE]
    return sorted(plain or published_poses(path)), setup, salvage.topic_words()


def _recorded(path: str | os.PathLike[str], wanted: PoseSource) -> AssessedPoses:
    topics, setup, there = pose_topics(path)
    bodies = [] if setup is None else [b for b in setup.bodies if wanted.body in ('', b)]
    theirs = [t for t in topics for b in bodies if t.endswith(f'/{topic_of(b)}{ENDING}')]
    ours = [t for t in topics if not t.startswith(OPTICAL)]
    own = [topic for topic in theirs if topic in ours]
    if wanted.sensor and not wanted.topic:
        own = [t for t in ours if t.endswith(f'/{topic_of(wanted.sensor)}{ENDING}')]
        if not own:
            raise BagError(
                f'{os.fspath(path)}: no poses of {wanted.sensor}; topics of poses: '
                f'{", ".join(ours) or "none"}'
            )
    chosen = wanted.topic or _only(os.fspath(path), 'topic', '', own or ours, there)
    if wanted.body and not (wanted.topic or wanted.sensor) and not own:
        raise BagError(f'{os.fspath(path)}: no poses of {wanted.body}; with --model its fluxes '
                       'are tracked')  # fmt: skip
    named = chosen[: -len(ENDING)].lstrip('/') if chosen.endswith(ENDING) else chosen
    name = next((b for b in bodies if named.endswith(topic_of(b))), named)
    reference = optical_topic(name)
    session = read_pose_session(
        path, {name: chosen}, wanted.optical or (reference if reference in topics else None)
    )
    return AssessedPoses(name, session.sensors[name], session, setup)


def _only(path: str, kind: str, named: str, known: list[str], there: str = '') -> str:
    """The one that is named, or the only one."""
    if named:
        if named not in known:
            raise BagError(f'{path}: no {kind} {named}; there are: {", ".join(known) or "none"}')
        return named
    if len(known) != 1:
        words = f'several, name one with --{kind}: {", ".join(known)}' if known else (
            f'no poses; fluxes are tracked with --model; there are: {there}'
        )  # fmt: skip
        raise BagError(f'{path}: {words}')
    return known[0]


def _tracked(
    path: str | os.PathLike[str], wanted: PoseSource, progress: Callable[[float], None] | None
) -> AssessedPoses:
    """The poses in the state ok of a body, from its fluxes."""
    session = load_session(path)
    evaluation = track_session(
        session, model_for(wanted.model, session, snapshot=True), progress=progress
    )
    if not evaluation.bodies:
        raise BagError(f'{session.path}: no body has coils that determine a whole pose')
    name = _only(session.path, 'body', wanted.body, list(evaluation.bodies))
    good = [
        (e.stamp_ns, e.position, e.rotation)
        for e in evaluation.bodies[name].estimates
        if e.state == OK and e.rotation is not None
    ]
    if not good:
        raise BagError(f'{session.path}: no pose of {name} is in the state {OK}')
    stamps, places, turns = zip(*good, strict=True)
    time = (np.array(stamps) - session.start_ns) * NANO
    poses = sequence_of(
        name, time, np.array(places), Rotation.from_matrix(np.array(turns)).as_quat()
    )
    tool = next(t for t in session.tools if t.body == name)
    reference = None
    if tool.track is not None:
        track = tool.track
        reference = sequence_of('optical', track.time, track.position, track.quaternion)
    whole = PoseSession(session.path, session.start_ns, {name: poses}, reference, session.lost)
    return AssessedPoses(name, poses, whole, session.setup)
