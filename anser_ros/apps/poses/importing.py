"""Reads sessions of poses, of files and of bags by topic; writes bags."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from anser_ros.apps.poses.forms import FARTHEST_M, ORDERS, read_form
from anser_ros.apps.poses.sequence import (
    FARTHEST,
    REFERENCE,
    PoseSequence,
    PoseSession,
    sequence_of,
    stamp_words,
)
from anser_ros.arrays import Array, Integers
from anser_ros.errors import BagError, ParameterError
from anser_ros.stamps import NANO, SECOND_NS, stamp_fault
from anser_ros.wire import recorded
from anser_ros.wire.bag import Salvage, published_poses
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.table_names import LENGTH_M
from anser_ros.wire.tables import Span, check_apart

Piece = tuple[str, Array, Array, Array]
"""Name of a stream, and of one of its recordings times, s, positions, m, and quaternions."""
BETWEEN_FILES_S = 10.0
"""Pause, s, between recordings without a host's time; nothing interpolates over a tenth of it."""
SET_S, CLOCKS_APART = 0.3, 3e-3
"""Time, s, and share of the time passed, by which clocks that nobody sets may move against each
other between recordings: these start late by some 40 ms, and quartz errs by a thousandth."""
MOST_RESTARTS = 5
"""Falls of a counter in a recording that may be restarts; with more, rows are in no order."""
STAMPS = ('host', 'device')  # which time becomes the stamp; the other where a file lacks the one


def import_poses(
    tracked: Sequence[Path],
    reference: Sequence[Path] = (),
    *,
    stamps: str = 'host',
    unit: str | None = None,
    quaternion: str | None = None,
    names: Mapping[str, str] | None = None,
    shift_s: tuple[float, float] = (0.0, 0.0),
) -> PoseSession:
    """Read files of tracked poses, and of the reference's, as one session.

    ``tracked`` and ``reference``: several of each are recordings one after the other, the n-th of
    both together; ``unit``: unit of the tracked positions where the form does not state it
    correctly (`LENGTH_M`); ``quaternion``: how the tracked quaternions are written where it is not
    as usual in their form (`ORDERS`); ``names``: what sensors shall be called, by the names that
    the files give them; ``shift_s``: added to the times of the tracked poses and of the reference,
    where a host's clock has given them. Raises `ParameterError` when a file has no known form, an
    option no known value, numbers of files differ, or names fit no sensor or become the same.
    Raises `PlausibilityError` when quaternions are not of unit length.
    """
    for value, known in ((stamps, STAMPS), (unit, LENGTH_M), (quaternion, ORDERS)):
        if value is not None and value not in known:
            raise ParameterError(f'must be one of {", ".join(known)}, got {value!r}')
    if not np.isfinite(shift_s).all():
        raise ParameterError('a shift must be finite')
    if reference and len(reference) != len(tracked):
        raise ParameterError(
            f'{len(tracked)} files of tracked poses and {len(reference)} of the reference; '
            'they belong together one by one'
        )
    recordings: list[dict[str, Array]] = []
    seen: list[Span] = []
    lost: list[str] = []
    for path, other in zip_longest(tracked, reference):
        groups = _named(path, None, unit, quaternion, lost)
        if other is not None:
            if REFERENCE in groups:  # a file that says nothing of its sensor
                groups['sensor_0'] = groups.pop(REFERENCE)
            groups |= _named(other, REFERENCE, None, None, lost)
        for label in groups.keys() - {REFERENCE}:
            check_apart(seen, label, path, groups[label][:, 0])
        recordings.append(groups)
    pieces = _placed(recordings, stamps, shift_s)
    called = _called([piece[0] for piece in pieces], names or {})
    lost += [
        f'{old} is called {new}'
        for old, new in called.items()
        if old not in (names or {}) and old != new
    ]
    renamed = [(called[piece[0]], *piece[1:]) for piece in pieces]
    session = _session(str(tracked[0]), renamed)
    return replace(session, lost='; '.join(filter(None, (*lost, session.lost))))


def _called(found: Sequence[str], names: Mapping[str, str]) -> dict[str, str]:
    """What sensors are called: as they shall be, or as a topic can be."""
    sensors = [name for name in dict.fromkeys(found) if name != REFERENCE]
    unknown = sorted(set(names) - set(sensors))
    if unknown:
        raise ParameterError(f'no sensor {", ".join(unknown)}; there are: {", ".join(sensors)}')
    called = {name: names.get(name) or recorded.legal_name(name) for name in sensors}
    new = list(called.values())
    if len(set(new)) < len(new) or REFERENCE in new:
        raise ParameterError(f'sensors must differ in name, and from optical: {", ".join(new)}')
    return {**called, REFERENCE: REFERENCE}


def _placed(
    recordings: Sequence[Mapping[str, Array]], stamps: str, shift_s: tuple[float, float]
) -> list[Piece]:
    """All recordings on one axis of time. Two devices that count for themselves start together,
    and their counters go on in the next recording if both have moved on alike since the last.
    """
    times: list[dict[str, tuple[Array, bool]]] = [{} for _ in recordings]
    for label in dict.fromkeys(label for groups in recordings for label in groups):
        own = [k for k, groups in enumerate(recordings) if label in groups]
        found = _times([recordings[k][label] for k in own], stamps)
        for k, one in zip(own, found, strict=True):
            times[k][label] = one
    pieces: list[Piece] = []
    free = 0.0  # where the next recording without a host's time begins, s
    zero: dict[bool, float] = {}
    last: dict[bool, float] = {}
    for groups, known in zip(recordings, times, strict=True):
        begin: dict[bool, float] = {}  # by whether it is the reference
        for label, (time, is_host) in known.items():
            if not is_host:
                key = label == REFERENCE
                begin[key] = min(begin.get(key, np.inf), float(np.nanmin(time)))
        runs_on = len(begin) == len(last) == 2 and _runs_on(
            last[False] - last[True], begin[False] - begin[True], begin[True] - last[True]
        )
        if not runs_on:
            zero = {key: value - free for key, value in begin.items()}
        last = begin
        for label, table in groups.items():
            time, is_host = known[label]
            is_reference = label == REFERENCE
            shift = -shift_s[is_reference] if is_host else zero[is_reference]
            pieces.append((label, time - shift, table[:, 2:5], table[:, 5:]))
        if begin:
            free = max(float(np.nanmax(p[1])) for p in pieces) + BETWEEN_FILES_S
    return pieces


def _runs_on(before: float, after: float, elapsed: float) -> bool:
    """Whether two counters, apart so much before and after a time, s, have not been set since."""
    return elapsed > 0 and abs(after - before) < SET_S + CLOCKS_APART * elapsed


def _named(
    path: Path, name: str | None, unit: str | None, quaternion: str | None, lost: list[str]
) -> dict[str, Array]:
    """Each group of a file's rows (n, 9) under its name, with positions in m and quaternions
    x y z w; what is left out is added to what is lost.
    """
    rows, unread = read_form(path, unit)
    if unread:
        lost.append(f'lines of {path} that are no poses, and are left out: {unread}')
    if name is not None:  # of an optical file only the tool with most poses is the reference
        most = max(rows.values(), key=lambda one: np.isfinite(one.table[:, 2:]).all(1).sum())
        rows = {name: most}
    found = {}
    for label, one in rows.items():
        table = one.table
        if one.assumed_hz:
            lost.append(f'{label}: no time; {one.assumed_hz:g} frames a second are assumed')
        if not np.isfinite(table[:, :2]).any():
            raise ParameterError(f'{path}: {label}: no pose has a time')
        order, sense = ORDERS[quaternion or one.form]
        away = np.linalg.norm(table[:, 2:5], axis=1)
        middle = np.median(away[away < FARTHEST]) if (away < FARTHEST).any() else 0.0
        if middle > FARTHEST_M and not (unit or one.unit):
            words = f'positions of {middle:.4g} state no unit'
            raise ParameterError(f'{path}: {label}: {words}: --unit mm?')
        if middle > FARTHEST_M and one.unit == 'm' and not unit:
            lost.append(f'{label}: positions of {middle:.4g} m: --unit mm?')
        table[:, 2:5] *= LENGTH_M[unit or one.unit or 'm']
        table[:, 5:] = table[:, 5:][:, list(order)] * [sense, sense, sense, 1.0]
        found[label] = table
    return found


def _times(tables: Sequence[Array], stamps: str) -> list[tuple[Array, bool]]:
    """Times of a stream's recordings, s, and whether they are on the host's axis.

    A device's counter that runs on has one zero on that axis, whose drift is its clock's rate.
    """
    out: list[tuple[Array, bool]] = []
    zero, last = 0.0, None
    for table in tables:
        host, device = table[:, 0], table[:, 1].copy()
        if not np.isfinite(host).any():
            out.append((_continued(device), False))
            continue
        is_counted = stamps == 'device' and np.isfinite(device).any()
        out.append((device if is_counted else host, True))
        order = np.argsort(host, kind='stable')  # lines may be in another order than they came
        count = _restarts(device[order])
        for number in np.unique(count) if is_counted else ():
            rows = order[count == number]
            if not np.isfinite(late := host[rows] - device[rows]).any():
                continue
            apart, begin = float(np.nanmin(late)), float(np.nanmin(device[rows]))
            if last is None or not _runs_on(last[0], apart, begin - last[1]):
                zero = apart
            last = apart, begin
            device[rows] += zero
    return out


def _restarts(counter: Array) -> Integers:
    """How often a counter has fallen by more than a second before each of its values."""
    known = np.flatnonzero(np.isfinite(counter))
    falls = np.zeros(counter.size, dtype=np.int64)
    falls[known[1:]] = np.diff(counter[known]) < -1.0
    if falls.sum() > MOST_RESTARTS:
        return np.zeros_like(falls)
    return np.asarray(np.cumsum(falls))


def _continued(counter: Array) -> Array:
    """A counter that goes on from its last value where it restarts."""
    count, out, last = _restarts(counter), counter.copy(), 0.0
    for number in np.unique(count)[1:]:
        before = counter[count == number - 1]
        rows = count == number
        last += np.nanmax(before) - np.nanmin(counter[rows])
        out[rows] += last
    return out


def _session(path: str, pieces: Sequence[Piece]) -> PoseSession:
    start = min(float(np.nanmin(time)) for _, time, _, _ in pieces)
    end = max(float(np.nanmax(time)) for _, time, _, _ in pieces)
    if fault := stamp_fault(int(start * SECOND_NS), int(end * SECOND_NS)):
        raise ParameterError(f'{path}: {fault}')
    sequences: dict[str, PoseSequence] = {}
    for label in dict.fromkeys(piece[0] for piece in pieces):
        chosen = [piece for piece in pieces if piece[0] == label]
        time, position, turn = (np.concatenate([p[i] for p in chosen]) for i in (1, 2, 3))
        known = np.isfinite(time)
        sequences[label] = sequence_of(label, time[known] - start, position[known], turn[known])
    # A file of optical poses alone is somebody's tracker too.
    reference = sequences.pop(REFERENCE, None) if len(sequences) > 1 else None
    if not any(poses.size for poses in sequences.values()):
        raise ParameterError(f'{path}: no complete pose with a time')
    # A bag's stamp of zero means none.
    start_ns = max(round(start * 1e9), 1_000_000_000)
    return _judged(PoseSession(path, start_ns, sequences, reference))


def _judged(session: PoseSession) -> PoseSession:
    """The session with what its stamps show."""
    words = filter(None, (session.lost, stamp_words(session)))
    return replace(session, lost='; '.join(words))


def read_pose_session(
    path: str | os.PathLike[str],
    tracked: Mapping[str, str] | None = None,
    optical: str | None = None,
) -> PoseSession:
    """Read a bag of tracked and optical poses.

    ``tracked``: topic of each sensor by the sensor's name; by default all
    ``/tracked/<sensor>/pose``; ``optical``: topic of the reference; by default the only
    ``/optical/<body>/pose``. Raises `BagError` when the bag can't be read, or has no tracked
    poses, or several references. Raises `PlausibilityError` when quaternions are not of unit
    length.
    """
    name, salvage = os.fspath(path), Salvage()
    named = [*(tracked or {}).values(), *filter(None, [optical])]
    streams = published_poses(path, salvage=salvage)
    if not set(named) <= set(streams):  # poses of another type, of which there may be more
        streams |= {t: s for t, s in published_poses(path, named).items() if s.stamp_ns.size}
    chosen = tracked or {
        topic[len(recorded.TRACKED) : -len(recorded.ENDING)]: topic
        for topic in sorted(streams)
        if topic.startswith(recorded.TRACKED) and topic.endswith(recorded.ENDING)
    }
    optics = [t for t in streams if t.startswith(recorded.OPTICAL) and t.endswith(recorded.ENDING)]
    if not optical and len(optics) > 1:
        raise BagError(f'{name}: several references, name one: {", ".join(sorted(optics))}')
    reference = optical or next(iter(optics), None)
    topics = [*chosen.values(), *([reference] if reference else [])]
    for topic in topics:
        if topic not in streams:
            known = ', '.join(sorted(streams)) or 'none'
            raise BagError(f'{name}: no poses on {topic}; topics of poses: {known}')
    if not chosen:
        raise BagError(
            f'{name}: no tracked poses, which are expected on {recorded.TRACKED}<sensor>'
            f'{recorded.ENDING}; name them by --tracked NAME=TOPIC: {salvage.topic_words()}'
        )
    start = min(int(streams[topic].stamp_ns.min()) for topic in topics)

    def sequence(label: str, topic: str) -> PoseSequence:
        poses = streams[topic]
        time = np.asarray((poses.stamp_ns - start) * NANO)
        return sequence_of(label, time, poses.position, poses.quaternion)

    sensors = {label: sequence(label, topic) for label, topic in chosen.items()}
    found = sequence(REFERENCE, reference) if reference else None
    return _judged(PoseSession(name, start, sensors, found, salvage.lost))


def write_pose_session(path: Path, session: PoseSession) -> None:
    """Write a session of poses as a bag; where a device had no pose, values are NaN.

    Raises `BagError` when the file exists already.
    """
    sequences = [(recorded.tracked_topic(n), s) for n, s in session.sensors.items()]
    if session.reference is not None:
        sequences.append((recorded.optical_topic(recorded.BODY), session.reference))
    messages: list[tuple[int, str, list[float], list[float]]] = []
    for topic, poses in sequences:
        stamps, late = (
            (session.start_ns + np.round(time / NANO).astype(np.int64)).tolist()
            for time in (poses.time, poses.missing)
        )
        rows = zip(stamps, poses.position.tolist(), poses.quaternion.tolist(), strict=True)
        messages += [(stamp, topic, *row) for stamp, *row in rows]
        messages += [(stamp, topic, [np.nan] * 3, [np.nan] * 4) for stamp in late]
    messages.sort(key=lambda message: message[0])
    with SessionWriter(path, frame_id='tracker') as writer:
        setup = recorded.pose_setup(session.sensors, recorded.BODY)
        writer.write_setup(setup, messages[0][0] if messages else session.start_ns)
        for stamp, topic, position, quaternion in messages:
            writer.write_pose(topic, stamp, position, quaternion)
