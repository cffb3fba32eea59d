"""Reads sessions of poses: files as trackers write them, and bags by topic; writes bags."""

import csv
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from anser_ros.apps.poses.sequence import REFERENCE, PoseSequence, PoseSession, sequence_of
from anser_ros.arrays import Array, Integers
from anser_ros.errors import BagError, ParameterError
from anser_ros.sessions.plausibility import LENGTH_M
from anser_ros.stamps import NANO
from anser_ros.wire.bag import Salvage, published_poses
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.recorded import (
    BODY,
    ENDING,
    OPTICAL,
    TRACKED,
    optical_topic,
    pose_setup,
    tracked_topic,
)

ORDERS = {
    'xyzw': ((0, 1, 2, 3), 1.0),
    'wxyz': ((1, 2, 3, 0), 1.0),
    'xyzw_inverse': ((0, 1, 2, 3), -1.0),
    'wxyz_inverse': ((1, 2, 3, 0), -1.0),
}
"""Where x, y, z and w stand in a written quaternion, and the sense in which it turns."""
AURORA_HZ, POLARIS_HZ = 320.0, 60.0
"""Counts a second of the frame counters of NDI's Aurora (field periods) and Polaris (images)."""
COUNTERS = {'AuroraFrame': AURORA_HZ, 'PolarisFrame': POLARIS_HZ, 'DeviceTime': 1.0}
"""Keys of a device's own time, with its counts a second."""
HOST_TIMES = ('NetworkTime', 'Time')
"""Keys of the host's counter at receipt, ns."""
TUM_NUMBERS = 8  # in a line: the time, a position, a quaternion
TUM = re.compile(r'\s*[-+.\deE]+([\s,]+([-+.\deE]+|[-+]?nan|[-+]?inf)){7}', re.IGNORECASE)
"""A line of TUM's form; values that are no numbers stand where there was no pose."""
TITLE_LINES = 20  # lines that a program may write before its poses
PORT_COLUMNS = 13
"""Columns of a port in a ToolTracker file: name, frame, face, state, pose, error, markers."""
_KEY = re.compile(r'(\w+):\s*((?:[^\s:]+(?:\s+|$)(?!:))*?)(?=\s*\w+:|\s*$)')


@dataclass
class RawRows:
    """Holds rows of one sensor as they stand in a file, in the file's own units.

    Each row holds the time of receipt and the device's own time, s (NaN where the form lacks it),
    the position in the file's unit and the quaternion in the file's order; NaN for no pose.
    """

    rows: list[tuple[float, ...]] = field(default_factory=list)
    form: str = 'xyzw'  # how its quaternions are written, a key of `ORDERS`
    unit: str = 'mm'  # unit of its lengths, a key of `LENGTH_M`

    @property
    def table(self) -> Array:
        """Return the rows as an array, shape (n, 9)."""
        return np.array(self.rows, dtype=np.float64).reshape(-1, 9)


Found = tuple[dict[str, RawRows], int]
"""Rows by the sensor's name, and a number of lines."""


def read_form(path: Path) -> Found:
    """Read a file of any known form: its rows, and how many lines hold no pose and no marker.

    Lines before the first that has the form, such as a title, are left out. Raises
    `ParameterError` when no form fits, or the file has no row.
    """
    lines = path.read_text(encoding='utf-8-sig', errors='replace').splitlines()
    lines = [line for line in lines if line.strip() and not line.lstrip().startswith('#')]
    if not lines:
        raise ParameterError(f'{path}: no rows')
    first, reader = next(
        ((i, r) for i, line in enumerate(lines[:TITLE_LINES]) if (r := _reader(line))), (0, _table)
    )
    rows, read = reader(lines[first:], path)
    if not any(one.rows for one in rows.values()):
        raise ParameterError(f'{path}: no row that is a pose')
    return rows, len(lines) - read


def _reader(line: str) -> Callable[[Sequence[str], Path], Found] | None:
    """What reads the form that a line is of, or None; a table's header has names of columns."""
    if line.startswith('Tools\t'):
        return _tool_tracker
    if 'Position:' in line:
        return _keyed
    if TUM.match(line):
        return _tum
    return _table if {'qx', 'qw'} <= set(line.strip().split(',')) else None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float('nan')


def _tool_tracker(lines: Sequence[str], path: Path) -> Found:
    """NDI ToolTracker: a group of columns a port; scalar first; states in words."""
    rows: dict[str, RawRows] = {}
    read = 0
    for line in lines:
        cells = line.split('\t')
        if cells[0] == 'Tools':  # once more where the program was started again
            read += 1
            continue
        read += len(cells) >= PORT_COLUMNS
        for start in range(1, len(cells), PORT_COLUMNS):
            port = cells[start : start + PORT_COLUMNS]
            if len(port) < PORT_COLUMNS - 1:
                continue
            label = re.sub(r'\W+', '_', port[0].split(':')[0].strip().lower())
            rate = POLARIS_HZ if 'OT' in port[0] else AURORA_HZ
            one = rows.setdefault(label, RawRows(form='wxyz'))
            numbers = [_number(cell) for cell in port[4:11]]
            good = port[3].strip() in ('OK', 'Partially Out of Volume')
            pose = (*numbers[4:7], *numbers[:4]) if good else (float('nan'),) * 7
            one.rows.append((float('nan'), _number(port[1]) / rate, *pose))
    return rows, read


def _keyed(lines: Sequence[str], path: Path) -> Found:
    """Lines such as ``SensorID: 0 Position: x y z Orientation: a b c d Time: ns``."""
    rows: dict[str, RawRows] = {}
    for line in lines:
        parts = {key: text.split() for key, text in _KEY.findall(line)}
        if len(parts.get('Position', ())) != 3 or len(parts.get('Orientation', ())) != 4:
            continue
        label = f'sensor_{parts["SensorID"][0]}' if 'SensorID' in parts else REFERENCE
        # Ascension's driver is the one that writes a quality and the time of the day.
        form = 'wxyz_inverse' if 'Quality' in parts else 'xyzw'
        one = rows.setdefault(label, RawRows(form=form))
        host = next((_number(parts[key][0]) for key in HOST_TIMES if parts.get(key)), np.nan)
        device = next(
            (_number(parts[key][0]) / rate for key, rate in COUNTERS.items() if parts.get(key)),
            np.nan,
        )
        numbers = [_number(cell) for cell in (*parts['Position'], *parts['Orientation'])]
        if 'State' in parts and parts['State'][:1] not in (['OK'], ['Partially']):
            numbers = [float('nan')] * 7
        one.rows.append((1e-9 * float(host), float(device), *numbers))
    if not rows:
        raise ParameterError(f'{path}: no line with a position and an orientation')
    return rows, sum(len(one.rows) for one in rows.values())


def _tum(lines: Sequence[str], path: Path) -> Found:
    """TUM: s, m, scalar last."""
    one = RawRows(unit='m')
    for line in lines:
        numbers = [_number(cell) for cell in re.split(r'[\s,]+', line.strip())]
        if len(numbers) < TUM_NUMBERS:
            raise ParameterError(f'{path}: a line of {len(numbers)} numbers, TUM has 8')
        one.rows.append((numbers[0], float('nan'), *numbers[1:8]))
    return {path.stem: one}, len(lines)


def _table(lines: Sequence[str], path: Path) -> Found:
    """CSV: ``stamp_ns`` or ``time_s``, positions with their unit, quaternions, ``sensor``."""
    reader = csv.DictReader(lines)
    names = reader.fieldnames or []
    unit = next((u for u in LENGTH_M if {f'{axis}_{u}' for axis in 'xyz'} <= set(names)), None)
    clock = next((c for c in ('stamp_ns', 'time_s') if c in names), None)
    turn = ('qx', 'qy', 'qz', 'qw')
    if unit is None or clock is None or not set(turn) <= set(names):
        raise ParameterError(
            f'{path}: no known form; a CSV needs the columns stamp_ns or time_s, x_m, y_m, z_m '
            f'(or _mm), qx, qy, qz, qw'
        )
    rows: dict[str, RawRows] = {}
    for row in reader:
        one = rows.setdefault(str(row.get('sensor') or path.stem), RawRows(unit=unit))
        stamp = _number(row[clock] or '') * (1e-9 if clock == 'stamp_ns' else 1.0)
        pose = (_number(row[key] or '') for key in (*(f'{axis}_{unit}' for axis in 'xyz'), *turn))
        one.rows.append((stamp, float('nan'), *pose))
    return rows, len(lines)


Piece = tuple[str, Array, Array, Array]
"""Name of a stream, and of one of its recordings times, s, positions, m, and quaternions."""
BETWEEN_FILES_S = 10.0
"""Pause, s, between recordings without a host's time; nothing interpolates over a tenth of it."""
SET_S, CLOCKS_APART = 0.3, 3e-3
"""Time, s, and share of the time passed, by which clocks that nobody sets may move against each
other between recordings: these start late by some 40 ms, and quartz errs by a thousandth."""
MOST_RESTARTS = 5
"""Falls of a counter in a recording that may be restarts; with more, rows are in no order."""
LATEST_S = 9e9
"""Latest time, s: stamps in ns have no room for more in 63 bits."""
STAMPS = ('host', 'device')  # which time becomes the stamp; the other where a file lacks the one


def import_poses(
    tracked: Sequence[Path],
    reference: Sequence[Path] = (),
    *,
    stamps: str = 'host',
    unit: str | None = None,
    quaternion: str | None = None,
    names: Mapping[str, str] | None = None,
) -> PoseSession:
    """Read files of tracked poses, and of the reference's, as one session.

    ``tracked`` and ``reference``: several of each are recordings one after the other, the n-th of
    both together; ``unit``: unit of the tracked positions where the form does not state it
    correctly (`LENGTH_M`); ``quaternion``: how the tracked quaternions are written where it is not
    as usual in their form (`ORDERS`); ``names``: what sensors shall be called, by the names that
    the files give them. Raises `ParameterError` when a file has no known form, an option no known
    value, numbers of files differ, or names fit no sensor or become the same. Raises
    `PlausibilityError` when quaternions are not of unit length.
    """
    for value, known in ((stamps, STAMPS), (unit, LENGTH_M), (quaternion, ORDERS)):
        if value is not None and value not in known:
            raise ParameterError(f'must be one of {", ".join(known)}, got {value!r}')
    if reference and len(reference) != len(tracked):
        raise ParameterError(
            f'{len(tracked)} files of tracked poses and {len(reference)} of the reference; '
            'they belong together one by one'
        )
    recordings: list[dict[str, Array]] = []
    lost: list[str] = []
    for number, path in enumerate(tracked):
        rows, unread = read_form(path)
        groups, files = _named(rows, None, unit, quaternion), [(path, unread)]
        if reference:
            rows, unread = read_form(reference[number])
            groups |= _named(rows, REFERENCE, None, None)
            files.append((reference[number], unread))
        words = 'lines of {} that are no poses, and are left out: {}'
        lost += [words.format(*one) for one in files if one[1]]
        for label, table in groups.items():
            if not np.isfinite(table[:, :2]).any():
                raise ParameterError(f'{path}: {label}: no pose has a time')
        recordings.append(groups)
    pieces = _placed(recordings, stamps)
    session = _session(str(tracked[0]), _renamed(pieces, names or {}))
    return replace(session, lost='; '.join(lost))


def _renamed(pieces: Sequence[Piece], names: Mapping[str, str]) -> list[Piece]:
    found = list(dict.fromkeys(piece[0] for piece in pieces if piece[0] != REFERENCE))
    unknown = sorted(set(names) - set(found))
    if unknown:
        raise ParameterError(f'no sensor {", ".join(unknown)}; there are: {", ".join(found)}')
    called = [names.get(name, name) for name in found]
    if len(set(called)) < len(called) or REFERENCE in called:
        raise ParameterError(f'sensors must differ in name, and from optical: {", ".join(called)}')
    return [(names.get(piece[0], piece[0]), *piece[1:]) for piece in pieces]


def _placed(recordings: Sequence[Mapping[str, Array]], stamps: str) -> list[Piece]:
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
            shift = 0.0 if is_host else zero[label == REFERENCE]
            pieces.append((label, time - shift, table[:, 2:5], table[:, 5:]))
        if begin:
            free = max(float(np.nanmax(p[1])) for p in pieces) + BETWEEN_FILES_S
    return pieces


def _runs_on(before: float, after: float, elapsed: float) -> bool:
    """Whether two counters, apart so much before and after a time, s, have not been set since."""
    return elapsed > 0 and abs(after - before) < SET_S + CLOCKS_APART * elapsed


def _named(
    rows: Mapping[str, RawRows], name: str | None, unit: str | None, quaternion: str | None
) -> dict[str, Array]:
    """Each group of rows (n, 9) under its name, with positions in m and quaternions x y z w."""
    if name is not None:  # of an optical file only the tool with most poses is the reference
        most = max(rows.values(), key=lambda one: np.isfinite(one.table[:, 2:]).all(1).sum())
        rows = {name: most}
    found = {}
    for label, one in rows.items():
        table = one.table
        order, sense = ORDERS[quaternion or one.form]
        table[:, 2:5] *= LENGTH_M[unit or one.unit]
        table[:, 5:] = table[:, 5:][:, list(order)]
        table[:, 5:8] *= sense
        found[label] = table
    return found


def _times(tables: Sequence[Array], stamps: str) -> list[tuple[Array, bool]]:
    """Times of a stream's recordings, s, and whether they are on the host's axis.

    A device's counter that runs on has one zero on that axis, whose drift is its clock's rate.
    """
    out, pieces = [], []
    for table in tables:
        host, device = table[:, 0], table[:, 1].copy()
        if not np.isfinite(host).any():
            out.append((_continued(device), False))
            continue
        if stamps == 'host' or not np.isfinite(device).any():
            out.append((host, True))
            continue
        out.append((device, True))
        order = np.argsort(host, kind='stable')  # lines may be in another order than they came
        count = _restarts(device[order])
        for number in np.unique(count):
            rows = order[count == number]
            late = host[rows] - device[rows]
            if np.isfinite(late).any():
                pieces.append(
                    (device, rows, float(np.nanmin(late)), float(np.nanmin(device[rows])))
                )
    zero, last = 0.0, None
    for device, rows, late, begin in pieces:
        if last is None or not _runs_on(last[0], late, begin - last[1]):
            zero = late
        last = late, begin
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
    if start < 0.0 or end > LATEST_S:
        raise ParameterError(
            f'{path}: times from {start:g} to {end:g} s cannot be stamps of a bag'
        )
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
    return PoseSession(path, start_ns, sequences, reference)


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
    streams = published_poses(path, salvage=salvage)
    chosen = tracked or {
        topic[len(TRACKED) : -len(ENDING)]: topic
        for topic in sorted(streams)
        if topic.startswith(TRACKED) and topic.endswith(ENDING)
    }
    optics = [t for t in streams if t.startswith(OPTICAL) and t.endswith(ENDING)]
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
            f'{name}: no tracked poses, which are expected on {TRACKED}<sensor>{ENDING}'
        )
    start = min(int(streams[topic].stamp_ns.min()) for topic in topics)

    def sequence(label: str, topic: str) -> PoseSequence:
        poses = streams[topic]
        time = np.asarray((poses.stamp_ns - start) * NANO)
        return sequence_of(label, time, poses.position, poses.quaternion)

    sensors = {label: sequence(label, topic) for label, topic in chosen.items()}
    found = sequence(REFERENCE, reference) if reference else None
    return PoseSession(name, start, sensors, found, salvage.lost)


def write_pose_session(path: Path, session: PoseSession) -> None:
    """Write a session of poses as a bag; where a device had no pose, values are NaN.

    Raises `BagError` when the file exists already.
    """
    sequences = [(tracked_topic(n), s) for n, s in session.sensors.items()]
    if session.reference is not None:
        sequences.append((optical_topic(BODY), session.reference))
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
        setup = pose_setup(session.sensors, BODY)
        writer.write_setup(setup, messages[0][0] if messages else session.start_ns)
        for stamp, topic, position, quaternion in messages:
            writer.write_pose(topic, stamp, position, quaternion)
