"""Compares the poses that live trackers published during a recording with its optical ones."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.errors import BagError
from anser_ros.field.measurements import Measurements
from anser_ros.physics.rotations import axis_angles, rotation_angles
from anser_ros.sessions.prepared import PreparedSession, with_truth
from anser_ros.sessions.session import Session
from anser_ros.stamps import NANO, stamp_of
from anser_ros.wire.recorded import PoseStream, pose_numbers
from anser_ros.wire.setup import topic_of

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LiveErrors:
    """Holds errors (n,), m and rad, of a coil's place and axis, or of a body's place and turn."""

    position: Array
    orientation: Array


def published_poses(
    path: str | os.PathLike[str], topics: Sequence[str] | None = None, salvage: Any = None
) -> dict[str, PoseStream]:
    """Return what each PoseStamped topic of a bag carries, of some topics or of all.

    ``salvage``: a `wire.bag.Salvage`, which takes what could not be read.
    """
    # Nodes that read no bag run where the packages that read bags are not installed.
    from anser_ros.wire.bag import POSE_TYPE, MessageDecoder, Salvage, iter_messages

    rows: dict[str, list[tuple[float, ...]]] = {topic: [] for topic in topics or ()}
    stamps: dict[str, list[int]] = {topic: [] for topic in topics or ()}
    decoder = MessageDecoder()
    for raw in iter_messages(path, salvage or Salvage()):
        if raw.type_name == POSE_TYPE and (topics is None or raw.topic in rows):
            message = decoder.decode(raw)
            stamps.setdefault(raw.topic, []).append(stamp_of(message))
            rows.setdefault(raw.topic, []).append(pose_numbers(message.pose))
    found = {}
    for topic, values in rows.items():
        table = np.array(values, dtype=np.float64).reshape(-1, 7)
        stamp = np.array(stamps[topic], dtype=np.int64)
        found[topic] = PoseStream(stamp, table[:, :3], table[:, 3:])
    return found


def live_errors(prepared: PreparedSession, namespace: str) -> dict[str, LiveErrors]:
    """Return errors of all that the tracker of a namespace published, by sensor and body.

    The recording has optical poses, and is prepared with the tracker's model, whose corrections of
    the clock, the optical frame and the sensors are made. Raises `BagError` when the recording has
    no optical poses.
    """
    session = prepared.session
    names = [name for tool in session.tools for name in (*tool.sensors.name, tool.body)]
    topics = {name: f'{namespace}/{topic_of(name)}/pose' for name in names}
    received = published_poses(session.path, list(topics.values()))
    errors = {}
    for tool in session.tools:
        true = with_truth(tool, prepared.correction)
        for column, name in enumerate(tool.sensors.name):
            errors[name] = _compared(session, true, received[topics[name]], column)
        errors[tool.body] = _compared(session, true, received[topics[tool.body]], None)
    return errors


def _compared(
    session: Session,
    tool: Measurements,
    poses: PoseStream,
    column: int | None,
) -> LiveErrors:
    """Errors of one sensor (by its column), or of the body."""
    if tool.track is None:
        raise BagError(f'{session.path}: no optical poses of {tool.body}')
    time = np.asarray((poses.stamp_ns - session.start_ns) * NANO, dtype=np.float64)
    position, rotation, valid = tool.track.at(time)
    turned = Rotation.from_quat(poses.quaternion[valid]).as_matrix() if valid.any() else None
    if turned is None:
        return LiveErrors(np.zeros(0), np.zeros(0))
    if column is None:
        truth = position[valid]
        turn = rotation_angles(rotation[valid].transpose(0, 2, 1) @ turned)
    else:
        centres, axes = tool.sensors.placed(position[valid], rotation[valid])
        truth = centres[:, column]
        turn = axis_angles(turned[:, :, 2], axes[:, column])
    distance = np.linalg.norm(poses.position[valid] - truth, axis=1)
    return LiveErrors(distance, turn)
