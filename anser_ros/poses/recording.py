"""Reads sessions of poses from bags, by topic, and writes them."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import BagError
from anser_ros.poses.sequence import REFERENCE, PoseSequence, PoseSession, sequence_of
from anser_ros.stamps import NANO, stamp_of
from anser_ros.wire.bag import POSE_TYPE, MessageDecoder, Salvage, iter_messages
from anser_ros.wire.pose_topics import (
    BODY,
    ENDING,
    OPTICAL,
    TRACKED,
    optical_topic,
    pose_setup,
    tracked_topic,
)
from anser_ros.wire.quaternion import pose_numbers
from anser_ros.wire.session_writer import SessionWriter

Array = NDArray[np.float64]


def read_pose_session(
    path: str | os.PathLike[str],
    tracked: Mapping[str, str] | None = None,
    optical: str | None = None,
) -> PoseSession:
    """Read a bag of tracked and optical poses.

    ``tracked``: topic of each sensor by the sensor's name; by default all
    ``/tracked/<sensor>/pose``; ``optical``: topic of the reference; by default the only
    ``/optical/<body>/pose``.

    Raises `BagError` when the bag can't be read, or has no tracked poses, or several references.
    Raises `PlausibilityError` when quaternions are not of unit length.
    """
    name, salvage, decoder = os.fspath(path), Salvage(), MessageDecoder()
    stamps: dict[str, list[int]] = {}
    rows: dict[str, list[tuple[float, ...]]] = {}
    for raw in iter_messages(path, salvage):
        if raw.type_name == POSE_TYPE:
            message = decoder.decode(raw)
            stamps.setdefault(raw.topic, []).append(stamp_of(message))
            rows.setdefault(raw.topic, []).append(pose_numbers(message.pose))
    chosen = tracked or {
        topic[len(TRACKED) : -len(ENDING)]: topic
        for topic in sorted(rows)
        if topic.startswith(TRACKED) and topic.endswith(ENDING)
    }
    reference = optical or _only_optical(name, list(rows))
    for topic in (*chosen.values(), *([reference] if reference else [])):
        if topic not in rows:
            known = ', '.join(sorted(rows)) or 'none'
            raise BagError(f'{name}: no poses on {topic}; topics of poses: {known}')
    if not chosen:
        raise BagError(
            f'{name}: no tracked poses, which are expected on {TRACKED}<sensor>{ENDING}'
        )
    start = min(min(stamps[topic]) for topic in (*chosen.values(), *filter(None, [reference])))

    def sequence(label: str, topic: str) -> PoseSequence:
        table = np.array(rows[topic], dtype=np.float64).reshape(-1, 7)
        time = np.array([stamp - start for stamp in stamps[topic]]) * NANO
        return sequence_of(label, time, table[:, :3], table[:, 3:])

    return PoseSession(
        name,
        start,
        {label: sequence(label, topic) for label, topic in chosen.items()},
        sequence(REFERENCE, reference) if reference else None,
        salvage.lost,
    )


def _only_optical(path: str, topics: list[str]) -> str | None:
    found = [t for t in topics if t.startswith(OPTICAL) and t.endswith(ENDING)]
    if len(found) > 1:
        raise BagError(f'{path}: several references, name one: {", ".join(sorted(found))}')
    return found[0] if found else None


def write_pose_session(path: Path, session: PoseSession) -> None:
    """Write a session of poses as a bag; where a device had no pose, values are NaN.

    Raises `BagError` when the file exists already.
    """
    sequences = [(tracked_topic(n), s) for n, s in session.sensors.items()]
    if session.reference is not None:
        sequences.append((optical_topic(BODY), session.reference))
    messages: list[tuple[int, str, list[float], list[float]]] = []
    for topic, poses in sequences:
        stamp = session.start_ns + np.round(poses.time / NANO).astype(np.int64)
        messages += zip(
            stamp.tolist(),
            [topic] * poses.size,
            poses.position.tolist(),
            poses.quaternion.tolist(),
            strict=True,
        )
        for late in (session.start_ns + np.round(poses.missing / NANO).astype(np.int64)).tolist():
            messages.append((late, topic, [np.nan] * 3, [np.nan] * 4))
    messages.sort(key=lambda message: message[0])
    with SessionWriter(path, frame_id='tracker') as writer:
        setup = pose_setup(session.sensors, BODY)
        writer.write_setup(setup, messages[0][0] if messages else session.start_ns)
        for stamp_of, topic, position, quaternion in messages:
            writer.write_pose(topic, stamp_of, position, quaternion)
