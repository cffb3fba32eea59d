"""Makes one session of tracked and optical poses, from files of any known form.

Times of receipt (the host's counter) are taken as they stand. A device's own counter is put on the
host's axis by the smallest delay, after a restart again. If a form has no host's time, it begins
at zero, and after a restart it continues from its last value.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import ParameterError
from anser_ros.poses.forms import ORDERS, RawRows, read_form
from anser_ros.poses.sequence import REFERENCE, PoseSequence, PoseSession, sequence_of
from anser_ros.sessions.units import LENGTH_M

Array = NDArray[np.float64]

BETWEEN_FILES_S = 10.0
"""Pause, s, between recordings without a host's time that are put one after the other. A pose is
not interpolated over a tenth of it."""
MOST_RESTARTS = 5
"""Falls of a device's counter in one recording up to which they are restarts; of more, rows are in
another order."""
LATEST_S = 9e9
"""Latest time, s: stamps in ns have no room for more in 63 bits."""
STAMPS = ('host', 'device')
"""Which of a file's times become stamps; the other is taken where a file lacks the one."""


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
    the files give them.

    Raises `ParameterError` when a file has no known form, an option no known value, numbers of
    files differ, or names fit no sensor or become the same.

    Raises `PlausibilityError` when quaternions are not of unit length.
    """
    for value, known in ((stamps, STAMPS), (unit, LENGTH_M), (quaternion, ORDERS)):
        if value is not None and value not in known:
            raise ParameterError(f'must be one of {", ".join(known)}, got {value!r}')
    if reference and len(reference) != len(tracked):
        raise ParameterError(
            f'{len(tracked)} files of tracked poses and {len(reference)} of the reference; '
            'they belong together one by one'
        )
    pieces: list[tuple[str, Array, Array, Array]] = []
    lost: list[str] = []
    free = 0.0  # where the next recording without a host's time begins, s
    for number, path in enumerate(tracked):
        rows, unread = read_form(path)
        groups, files = _named(rows, None, unit, quaternion), [(path, unread)]
        if reference:
            rows, unread = read_form(reference[number])
            groups |= _named(rows, REFERENCE, None, None)
            files.append((reference[number], unread))
        lost += [
            f'lines of {p} that are no poses, and are left out: {unread}'
            for p, unread in files
            if unread
        ]
        times = {label: _times(table, stamps) for label, table in groups.items()}
        for label, (time, _) in times.items():
            if not np.isfinite(time).any():
                raise ParameterError(f'{path}: {label}: no pose has a time')
        own = [time for time, is_host in times.values() if not is_host]
        for label, table in groups.items():
            time, is_host = times[label]
            begin = 0.0 if is_host else _begin(label, times) - free
            pieces.append((label, time - begin, table[:, 2:5], table[:, 5:]))
        if own:
            free = max(float(np.nanmax(p[1])) for p in pieces) + BETWEEN_FILES_S
    session = _session(str(tracked[0]), _renamed(pieces, names or {}))
    return replace(session, lost='; '.join(lost))


def _renamed(
    pieces: Sequence[tuple[str, Array, Array, Array]], names: Mapping[str, str]
) -> list[tuple[str, Array, Array, Array]]:
    found = list(dict.fromkeys(piece[0] for piece in pieces if piece[0] != REFERENCE))
    unknown = sorted(set(names) - set(found))
    if unknown:
        raise ParameterError(f'no sensor {", ".join(unknown)}; there are: {", ".join(found)}')
    called = [names.get(name, name) for name in found]
    if len(set(called)) < len(called) or REFERENCE in called:
        raise ParameterError(f'sensors must differ in name, and from optical: {", ".join(called)}')
    return [(names.get(piece[0], piece[0]), *piece[1:]) for piece in pieces]


def _begin(label: str, times: Mapping[str, tuple[Array, bool]]) -> float:
    """Where a device's own time begins: two devices that count for themselves start together."""
    same = [t for key, (t, _) in times.items() if (key == REFERENCE) == (label == REFERENCE)]
    return min(float(np.nanmin(t)) for t in same)


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
        order, is_inverse = ORDERS[quaternion or one.form]
        table[:, 2:5] *= LENGTH_M[unit or one.unit]
        table[:, 5:] = table[:, 5:][:, list(order)]
        if is_inverse:
            table[:, 5:8] *= -1.0
        found[label] = table
    return found


def _times(table: Array, stamps: str) -> tuple[Array, bool]:
    """Times of a group of rows, s, and whether they are on the host's axis."""
    host, device = table[:, 0], table[:, 1].copy()
    if not np.isfinite(host).any():
        return _continued(device), False
    if stamps == 'host' or not np.isfinite(device).any():
        return host, True
    order = np.argsort(host, kind='stable')  # lines may be in another order than they came
    count = _restarts(device[order])
    for number in np.unique(count):
        rows_of_it = order[count == number]
        late = host[rows_of_it] - device[rows_of_it]
        if np.isfinite(late).any():
            device[rows_of_it] += np.nanmin(late)
    return device, True


def _restarts(counter: Array) -> NDArray[np.int64]:
    """How often a counter has restarted before each of its values: it falls by more than a second.

    Where there are many falls, rows are in no order, and no counter restarts.
    """
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


def _session(path: str, pieces: Sequence[tuple[str, Array, Array, Array]]) -> PoseSession:
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
