"""The poses that live trackers published during a recording, against its optical ones."""

import os
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.correction import Correction
from anser_ros.errors import BagError
from anser_ros.sessions.session import LONGEST_OPTICAL_GAP_S, NANO, Session
from anser_ros.wire.bag import POSE_TYPE, MessageDecoder, Salvage, iter_messages, stamp_ns
from anser_ros.wire.setup import topic_of

Array = NDArray[np.float64]


def published_poses(
    path: str | os.PathLike[str], topics: Sequence[str]
) -> dict[str, tuple[NDArray[np.int64], Array]]:
    """Stamps (n,), ns, and positions (n, 3), m, of each PoseStamped topic of a bag."""
    rows: dict[str, list[tuple[int, float, float, float]]] = {topic: [] for topic in topics}
    decoder = MessageDecoder()
    for raw in iter_messages(path, Salvage()):
        if raw.topic in rows and raw.type_name == POSE_TYPE:
            message = decoder.decode(raw)
            place = message.pose.position
            rows[raw.topic].append((stamp_ns(message), place.x, place.y, place.z))
    result = {}
    for topic, values in rows.items():
        stamps = np.array([row[0] for row in values], dtype=np.int64)
        result[topic] = (stamps, np.array([row[1:] for row in values]).reshape(-1, 3))
    return result


def position_errors(
    session: Session, chains: Mapping[str, str], correction: Correction
) -> dict[str, Array]:
    """Distance of every published pose from the optical one, m, over all sensors, by chain.

    Parameters
    ----------
    session : Session
        The recording, with the optical poses.
    chains : mapping
        Namespace of each chain's topics, by the chain's name.
    correction : Correction
        What is known of the clock, the optical frame and the sensors' places: the same truth for
        every chain.

    Raises
    ------
    BagError
        When the recording has no optical poses.
    """
    topics = {
        name: {
            f'{namespace}/{topic_of(sensor)}/pose': (tool, column)
            for tool in session.tools
            for column, sensor in enumerate(tool.sensors.name)
        }
        for name, namespace in chains.items()
    }
    received = published_poses(
        session.path, [topic for group in topics.values() for topic in group]
    )
    errors: dict[str, Array] = {}
    for name, group in topics.items():
        parts = []
        for topic, (tool, column) in group.items():
            if tool.track is None:
                raise BagError(f'{session.path}: no optical poses of {tool.body}')
            stamps, positions = received[topic]
            time = np.asarray((stamps - session.start_ns) * NANO, dtype=np.float64)
            track = correction.optical(tool.track)
            position, rotation, valid = track.at(time, LONGEST_OPTICAL_GAP_S)
            centres, _ = correction.sensors(tool.sensors).placed(position, rotation)
            parts.append(np.linalg.norm(positions - centres[:, column], axis=1)[valid])
        errors[name] = np.concatenate(parts)
    return errors
