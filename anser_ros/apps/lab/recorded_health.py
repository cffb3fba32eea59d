"""What nodes published and reported in a recorded session: errors of poses, and states."""

import os
from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array
from anser_ros.errors import BagError
from anser_ros.field.measurements import Measurements
from anser_ros.physics.rotations import axis_angles, rotation_angles
from anser_ros.pose_states import FRAMES_IN, OK
from anser_ros.sessions.prepared import PreparedSession, with_truth
from anser_ros.sessions.session import Session
from anser_ros.stamps import NANO
from anser_ros.wire.bag import MessageDecoder, Salvage, iter_messages, published_poses
from anser_ros.wire.recorded import PoseStream
from anser_ros.wire.setup import topic_of


def live_errors(prepared: PreparedSession, namespace: str) -> tuple[Array, Array]:
    """Return errors (n,), m and rad, of all poses that the tracker of a namespace published.

    They are those of a coil's place and axis, and of a body's place and turn.
    The recording has optical poses, and is prepared with the tracker's model, whose corrections of
    the clock, the optical frame and the sensors are made. Raises `BagError` when the recording has
    no optical poses.
    """
    session = prepared.session
    names = [name for tool in session.tools for name in (*tool.sensors.name, tool.body)]
    topics = {name: f'{namespace}/{topic_of(name)}/pose' for name in names}
    received = published_poses(session.path, list(topics.values()))
    errors = []
    for tool in session.tools:
        true = with_truth(tool, prepared.correction)
        for column, name in (*enumerate(tool.sensors.name), (None, tool.body)):
            errors.append(_compared(session, true, received[topics[name]], column))
    position, orientation = map(np.concatenate, zip(*errors, strict=True))
    return position, orientation


def _compared(
    session: Session, tool: Measurements, poses: PoseStream, column: int | None
) -> tuple[Array, Array]:
    """Errors of one sensor (by its column), or of the body."""
    if tool.track is None:
        raise BagError(f'{session.path}: no optical poses of {tool.body}')
    time = np.asarray((poses.stamp_ns - session.start_ns) * NANO, dtype=np.float64)
    position, rotation, valid = tool.track.at(time)
    if not valid.any():
        return np.zeros(0), np.zeros(0)
    turned = Rotation.from_quat(poses.quaternion[valid]).as_matrix()
    if column is None:
        truth = position[valid]
        turn = rotation_angles(rotation[valid].transpose(0, 2, 1) @ turned)
    else:
        centres, axes = tool.sensors.placed(position[valid], rotation[valid])
        truth = centres[:, column]
        turn = axis_angles(turned[:, :, 2], axes[:, column])
    return np.linalg.norm(poses.position[valid] - truth, axis=1), turn


TOPIC = '/diagnostics'


def last_words(path: str | os.PathLike[str]) -> dict[str, Mapping[str, str]]:
    """Return the last values of every status by its name.

    A bag without diagnostics, or one that cannot be read yet, gives an empty mapping.
    """
    decoder = MessageDecoder()
    words: dict[str, Mapping[str, str]] = {}
    try:
        for raw in iter_messages(path, Salvage()):
            if raw.topic == TOPIC:
                for status in decoder.decode(raw).status:
                    words[status.name] = {item.key: item.value for item in status.values}
    except BagError:
        return {}
    return words


def ok_share(words: Mapping[str, Mapping[str, str]], tracker: str) -> float:
    """Return the share of poses in state ok among all that a tracker judged; 0 if it judged none.

    Frames that it never saw, because the machine was too slow for them, do not count. The statuses
    of its sensors and bodies, of `last_words`, are named ``NODE: SENSOR``.
    """
    ok = judged = 0
    for name, values in words.items():
        if name.startswith(f'{tracker}: '):
            counts = {key: int(n) for key, n in values.items() if key.startswith(FRAMES_IN)}
            ok += counts.get(f'{FRAMES_IN}{OK}', 0)
            judged += sum(counts.values())
    return ok / judged if judged else 0.0


def kept_share(session: Session) -> float:
    """Return the share of frames with tool readings, of those that their period lets expect."""
    shares = [0.0]
    for tool in session.tools:
        if tool.time.size > 1:
            period = float(np.median(np.diff(tool.time)))
            expected = 1 + round(float(tool.time[-1] - tool.time[0]) / period)
            shares.append(float(np.any(tool.valid, axis=1).sum()) / expected)
    return min(1.0, max(shares))
