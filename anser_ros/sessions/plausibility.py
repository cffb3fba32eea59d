"""Judges whether a recording can be what its units, clocks and poses say, before it is used.

First the conventions in which poses and fluxes were written, by the fluxes of the nominal board;
then refused poses, clocks, an optical tracker that stood still, and distances. Every check refuses
on evidence only, and names it; what the data cannot decide passes.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from anser_ros.arrays import Array, Booleans, Integers
from anser_ros.errors import PlausibilityError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.rotations import TURNED_RAD, rotation_angles, unturned
from anser_ros.refit.clouds import FieldFunction
from anser_ros.sessions.nominal_board import NominalBoard, tracked_volume
from anser_ros.wire.recorded import optical_stem
from anser_ros.wire.setup import Setup, topic_of

LENGTH_UNITS: Mapping[str, float] = {'millimetres': 1e3, 'centimetres': 1e2, 'inches': 1 / 0.0254}
"""Units of length that stand where metres belong: how many there are in a metre."""
FLUX_UNITS: Mapping[str, float] = {
    'nanotesla': 1e9, 'microtesla': 1e6, 'gauss': 1e4, 'millitesla': 1e3,
}  # fmt: skip
"""Units of flux density that stand where teslas belong: how many there are in a tesla."""
CLOSE = 3.0
"""Factor within which a ratio is that of a unit; of inches and centimetres the nearer is named."""


def unit_words(ratio: float, units: Mapping[str, float]) -> str:
    """Return the unit whose size a ratio, of what was written to what is expected, is nearest to.

    It is empty where none is near. Units are given as how many there are in the SI unit.
    """
    if not 0.0 < ratio < math.inf:
        return ''
    apart = {name: abs(math.log(ratio / size)) for name, size in units.items()}
    nearest = min(apart, key=lambda name: apart[name])
    return nearest if apart[nearest] < math.log(CLOSE) else ''


MOST_FRAMES = 40
"""Frames that are looked at, evenly over the recording: enough for shares, and quick."""
FEWEST_READINGS = 12
"""Readings (a coil in a frame) without which nothing is decided: fewer fit by chance."""
MISFIT = 0.3
"""Relative misfit of a reading up to which it fits. A nominal board predicts to a few hundredths;
a wrong axis misses by one and more."""
POOR, GOOD = 0.6, 0.8
"""Shares of readings that fit: below the first the poses are in doubt, above the second another
reading is right. Half a turn about an axis leaves a third of a triaxial coil's readings right."""
TOO_LARGE = 100.0
"""Factor over the nominal board's fluxes, or below them, from which a unit is in doubt; gains stay
far inside."""
SILENT, WEAK, OFTEN = 4.0, 0.01, 0.1
"""Root mean square of an emitter's fluxes in a frame, over the stated noise of a component (of one
reading in 3000 noise alone has more) and over the strongest emitter's, below both of which it is
dead, and share of the frames from which on it is said: readings in another unit are below the
first alone, a small coil far away below the second, one that turns only for a moment."""


@dataclass(frozen=True)
class Reading:
    """Describes one way to read the numbers of a pose, and says in words what they then are.

    ``order`` is where x, y, z and w stand, ``scale`` m in a unit of length, and ``axes`` which of
    the numbers, counted from one, are x, y and z: negative where they are reversed. A rotation
    that is inverse is from fg to the body; in another frame rotations have these axes too.
    """

    words: str
    order: tuple[int, int, int, int] = (0, 1, 2, 3)
    is_inverse: bool = False
    scale: float = 1.0
    axes: tuple[int, int, int] = (1, 2, 3)
    is_frame: bool = False

    def placed(self, position: Array, rotation: Array) -> tuple[Array, Array]:
        """Return positions (F, 3), m, and rotations (F, 3, 3) that are written so."""
        # Loaded here, as each start of a node would pay for it that has no poses to read.
        from scipy.spatial.transform import Rotation

        read = Rotation.from_quat(Rotation.from_matrix(rotation).as_quat()[:, list(self.order)])
        rotation = (read.inv() if self.is_inverse else read).as_matrix()
        turn = np.eye(3)[np.abs(self.axes) - 1] * np.sign(self.axes)[:, None]
        position = self.scale * position @ turn.T
        if not self.is_frame:
            return position, rotation
        # A left-handed tracker states rotations of a body that it has mirrored as well.
        back = turn.T if np.linalg.det(turn) < 0.0 else np.eye(3)
        return position, turn @ rotation @ back


def _other_axes() -> Iterator[Reading]:
    """Exchanged and reversed axes: of positions alone, and of the whole frame."""
    for order in itertools.permutations((1, 2, 3)):
        for signs in itertools.product((1, -1), repeat=3):
            x, y, z = (sign * axis for sign, axis in zip(signs, order, strict=True))
            if (x, y, z) == (1, 2, 3):
                continue
            named = ', '.join(f'{"-" * (a < 0)}{"xyz"[abs(a) - 1]}' for a in (x, y, z))
            for is_frame, what in ((False, 'positions with'), (True, 'poses in a frame of')):
                yield Reading(f'{what} the axes {named}', axes=(x, y, z), is_frame=is_frame)


AS_WRITTEN = Reading('')
"""The poses as `docs/interfaces.md` has them: m, x y z w, body to fg."""
W_FIRST = (1, 2, 3, 0)
"""Where x, y, z and w stand in a quaternion that begins with w."""
OTHER_READINGS = (
    Reading('quaternions with w first', W_FIRST),
    Reading('rotations from fg to the body', is_inverse=True),
    Reading('quaternions with w first and rotations from fg to the body', W_FIRST, True),
    *(
        Reading(f'positions in {unit}{also}', order, scale=1 / size)
        for also, order in (('', AS_WRITTEN.order), (' and quaternions with w first', W_FIRST))
        for unit, size in {**LENGTH_UNITS, 'kilometres': 1e-3}.items()  # divided once too often
    ),
    *_other_axes(),
)
"""What people write instead; the first that fits is named."""
ALSO = {
    'quaternions with w first': "the probe's axis",
    'positions with the axes -x, -y, z': 'the order of the places',
}
"""What makes the same of typed places that are symmetric, all of one orientation, if reversed."""


def check_conventions(
    path: str, setup: Setup, nominal: NominalBoard, tool: Measurements
) -> list[str]:
    """Check units and order of a tool's poses, and unit and sign of its fluxes, by the drawing.

    Returns words on what the fluxes alone cannot be wrong by: all small, or all reversed. Raises
    `PlausibilityError` when the poses contradict the fluxes as they stand and fit them when read
    in another way, or the fluxes are larger than the board can make by the factor of a unit.
    """
    field = nominal.field
    if field is None:
        return []
    rows, columns = _chosen(tool)
    fit = partial(_fit, field, tool, rows, columns)
    share, gain = fit(AS_WRITTEN) if len(rows) >= FEWEST_READINGS else (np.nan, np.nan)
    if share > GOOD:
        size = np.linalg.norm(tool.flux[rows, columns], axis=1)
        return _check_flux(path, tool, size, size / gain, 'the drawn board makes at its poses')
    for reading in OTHER_READINGS if share < POOR else ():
        better, _ = fit(reading)
        if better > GOOD:
            is_typed = not np.ptp(tool.rotation[rows], axis=0).any()
            also = f'; or is {ALSO[reading.words]} reversed?' if reading.words in ALSO else ''
            span = float(np.linalg.norm(np.ptp(tool.position[rows], axis=0)))
            raise PlausibilityError(
                f'{path}: {"typed" if is_typed else "optical"} poses of {tool.body} '
                f'(positions span {span:.3g} m) explain {100 * share:.0f} % of the fluxes as '
                f'they stand, and {100 * better:.0f} % when read as '
                f'{reading.words}{also if is_typed else ""}'
            )
    _check_size(path, setup, field, tool)
    if share < POOR and fit(AS_WRITTEN, sign=-1.0)[0] > GOOD:
        return [
            f'all fluxes of {tool.body} are the reverse of what the drawn board makes at its '
            'poses: are all axes stated reversed, or the currents?'
        ]
    return []


def _chosen(tool: Measurements) -> tuple[Integers, Integers]:
    """Frames and columns of readings with a pose, of some frames over the whole recording."""
    # Fluxes in a small unit are beyond what counts as valid: only flags and NaN exclude one.
    whole = np.isfinite(tool.flux).all(axis=2) & (tool.flags == 0) & tool.has_pose[:, None]
    frames = np.flatnonzero(whole.any(axis=1))
    frames = frames[:: max(1, -(-frames.size // MOST_FRAMES))]
    some = np.zeros(whole.shape[0], dtype=bool)
    some[frames] = True
    rows, columns = np.nonzero(whole & some[:, None])
    return rows, columns


def _fit(
    drawn: FieldFunction, tool: Measurements, rows: Integers, columns: Integers,
    reading: Reading, sign: float = 1.0,
) -> tuple[float, float]:  # fmt: skip
    """Share of readings (P,) that fit when poses are read so, and the fluxes' common factor."""
    flux = sign * tool.flux[rows, columns]
    frames, where = np.unique(rows, return_inverse=True)
    placed = reading.placed(tool.position[frames], tool.rotation[frames])
    centres, axes = tool.sensors.placed(*placed)
    predicted = np.einsum('pki,pi->pk', drawn(centres[where, columns]), axes[where, columns])
    size = np.einsum('pk,pk->p', predicted, predicted)
    ratio = np.einsum('pk,pk->p', predicted, flux) / np.maximum(size, 1e-300)
    # All channels may lag by the same phase; their sign is left as it is.
    lag = 0.5 * float(np.angle(np.sum((ratio / np.maximum(np.abs(ratio), 1e-300)) ** 2)))
    gain = float(np.median(np.abs(ratio)))
    miss = np.linalg.norm(flux - gain * np.exp(1j * lag) * predicted, axis=1)
    return float(np.mean(miss < MISFIT * np.linalg.norm(flux, axis=1))), gain


def _check_flux(
    path: str, tool: Measurements, size: Array, expected: Array | float, what: str
) -> list[str]:
    """Words where fluxes are smaller than what is expected by the factor of a unit; raise where
    they are larger.
    """
    gain = float(np.median(size / np.maximum(expected, 1e-300)))
    unit = unit_words(gain, FLUX_UNITS) or 'another unit than T'
    words = f'fluxes of {tool.body} are {np.median(size):.3g} T, {gain:.2g} times what {what}'
    if gain > TOO_LARGE:
        raise PlausibilityError(f'{path}: {words}: {unit}?')
    return [f'{words}: {unit}?'] if gain < 1.0 / TOO_LARGE else []


def check_unit(path: str, model: FieldModel, tool: Measurements, noise_t: float) -> None:
    """Raise `PlausibilityError` where a tool reads many times what a model has there, or nothing.

    Poses where it has no more than the noise, T, are far away, and tell nothing of a unit.
    """
    rows, columns = _chosen(tool)
    made = model.flux(*(part[rows, columns] for part in tool.placed()))
    size, expected = (np.linalg.norm(f, axis=1) for f in (tool.flux[rows, columns], made))
    near = expected > noise_t
    if np.count_nonzero(near) >= FEWEST_READINGS:
        what = 'the model makes at its poses'
        for words in _check_flux(path, tool, size[near], expected[near], what):
            raise PlausibilityError(f'{path}: {words}')


def _check_size(path: str, setup: Setup, drawn: FieldFunction, tool: Measurements) -> None:
    """Raise where fluxes are larger than the nominal board's in the tracked volume."""
    whole = np.isfinite(tool.flux).all(axis=2) & (tool.flags == 0)
    if not whole.any():
        return
    size = np.linalg.norm(tool.flux[whole], axis=1)
    there = np.linalg.norm(drawn(tracked_volume(setup).samples(4, 3)), axis=(1, 2))
    if np.median(size) > TOO_LARGE * float(there.max()):
        what = 'the drawn board makes in the tracked volume'
        _check_flux(path, tool, size, float(np.median(there)), what)


FAR = 10.0
"""Distance of optical positions, in the volume's farthest corner's, beyond which no tool is held.
Carried about the room it may be a few such away; inches are more."""
FROZEN_S = 1.0
"""Time, s, of equal poses that counts as frozen; cameras may repeat one for 0.1 s."""
MOVED = 0.1
"""Relative change of a tool's fluxes that shows it has moved, a centimetre at a hand's breadth;
metal that comes near a tool at rest changes them by a few hundredths."""
MOST_FROZEN = 0.5
"""Share of the time that optical poses may be frozen; what is left of more is no reference."""
WIDEST_POINTS_M = 10.0
"""Largest extent of a tracker's positions, m: a tracked volume is below 1, a room below 10."""
USUAL_EXTENT_M = 0.3
"""Usual extent of a tracker's positions, m, by which a unit is recognised."""


def plausible_tools(
    path: str, setup: Setup, tools: tuple[Measurements, ...], refused: Mapping[str, int]
) -> tuple[tuple[Measurements, ...], str]:
    """Check a recording's tools, and leave out the poses of an optical tracker that stood still.

    ``refused`` is what the reader refused, ``topic: reason``, and how often. What was left out,
    refused or mounted otherwise is returned in words; empty when nothing was. Raises
    `PlausibilityError` with the evidence, in one line.
    """
    nominal, kept, words = NominalBoard.of(setup), [], []
    if tools and not any(np.nan_to_num(tool.flux).any() for tool in tools):
        is_read = any(np.isfinite(tool.flux).any() for tool in tools)
        what = 'zero: an empty band?' if is_read else 'missing or not finite'
        raise PlausibilityError(f'{path}: all fluxes of all tools are {what}')
    dead = silent(setup, tools).items()
    words += [f'{name} gives nothing but noise{often}: is it dead?' for name, often in dead]
    words += [f'{n} of {what}' for what, n in refused.items() if not optical_stem(what)]
    for tool in tools:
        words += [*_check_refused(path, tool, refused), *_missing(setup, tool)]
        _check_clocks(path, tool)
        thawed, remarks = _thawed(path, tool)
        words += remarks
        words += check_conventions(path, setup, nominal, thawed)
        check_distance(path, setup, thawed)
        if times := ', '.join(f'{time:.4g}' for time in times_of_mounting(thawed)):
            words.append(
                f'{tool.body} turns about another axis, mounted otherwise, from {times} s on'
            )
        kept.append(thawed)
    return tuple(kept), '; '.join(words)


def silent(setup: Setup, tools: Sequence[Measurements]) -> dict[str, str]:
    """Return the emitters of which tools read no more than noise while others give more, with
    words on how often; empty for always. A missing reading is none, if there are others.
    """
    power = [np.where(np.isfinite(tool.flux), np.abs(tool.flux) ** 2, np.nan) for tool in tools]
    with np.errstate(invalid='ignore'):  # what nobody reads in a frame has no size
        means = [np.nansum(one, axis=1) / np.isfinite(one).sum(axis=1) for one in power]
    size = np.sqrt(np.concatenate([np.zeros((0, len(setup.emitter_names))), *means]))
    size[:, np.isnan(size).all(axis=0)] = 0.0
    strongest = np.nanmax(size, axis=1, keepdims=True, initial=0.0)
    dead = size < np.minimum(SILENT * setup.accuracy.flux_noise_t, WEAK * strongest)
    rows = zip(setup.emitter_names, dead.sum(axis=0), np.isfinite(size).sum(axis=0), strict=True)
    return {
        name: f' in {lost} of {count} frames' if lost < count else ''
        for name, lost, count in rows
        if lost > OFTEN * count
    }


def unread(setup: Setup, tool: Measurements) -> Booleans:
    """Return which of a tool's sensors (S,) read no more than noise while others give more."""
    power = np.sum(np.where(np.isfinite(tool.flux), np.abs(tool.flux), 0.0) ** 2, axis=(0, 2))
    size = np.sqrt(power / max(1, tool.flux[:, 0].size))
    return np.asarray(size <= min(SILENT * setup.accuracy.flux_noise_t, WEAK * size.max()))


def _missing(setup: Setup, tool: Measurements) -> list[str]:
    """Words for sensors without any reading, and for frames that lack those of others."""
    read, dead = np.isfinite(tool.flux), unread(setup, tool)
    rest = read[:, ~dead][:, :, read.any(axis=(0, 1))]
    lacking = int((~rest.all(axis=(1, 2))).sum())
    names = ', '.join(name for name, gone in zip(tool.sensors.name, dead, strict=True) if gone)
    words = [f'no reading of {names}'] if names else []
    if lacking:
        count = f'{lacking} of {len(read)} frames; these readings are not used'
        words.append(f'fluxes of {tool.body} are missing or not finite in {count}')
    return words


def check_points(tracked: Array, true: Array) -> None:
    """Check the points (M, 3), m, of an error map, but for NaN; raises `PlausibilityError`."""
    good = np.isfinite(tracked).all(axis=1) & np.isfinite(true).all(axis=1)
    if not good.any():
        return
    extents = {}
    for name, places in (('tracked', tracked[good]), ('true', true[good])):
        extents[name] = float(np.linalg.norm(np.ptp(places, axis=0)))
        if int(good.sum()) > 1 and extents[name] == 0.0:
            raise PlausibilityError(f'all {int(good.sum())} {name} positions are the same')
    widest = max(extents, key=lambda name: extents[name])
    least = min(extents.values())
    unit = unit_words(extents[widest] / least, LENGTH_UNITS) if least > 0.0 else ''
    if unit or extents[widest] > WIDEST_POINTS_M:
        unit = unit or _unit_of(extents[widest])
        raise PlausibilityError(
            f'tracked positions span {extents["tracked"]:.3g} m, '
            f'true ones {extents["true"]:.3g} m: {unit}?'
        )


def check_positions(what: str, places: Array) -> None:
    """Check that a tracker's positions (n, 3) can be in m; raises `PlausibilityError`."""
    if not len(places):
        return
    low, high = np.percentile(places, (5, 95), axis=0)
    span = float(np.linalg.norm(high - low))
    away = float(np.median(np.linalg.norm(places, axis=1)))
    strange = away > WIDEST_POINTS_M and unit_words(away / USUAL_EXTENT_M, LENGTH_UNITS)
    if span > WIDEST_POINTS_M or strange:
        raise PlausibilityError(
            f'{what}: positions span {span:.3g} m and lie {away:.3g} m from the origin: '
            f'{_unit_of(span if span > WIDEST_POINTS_M else away)}?'
        )


def _unit_of(extent: float) -> str:
    return unit_words(extent / USUAL_EXTENT_M, LENGTH_UNITS) or 'another unit than m'


def _check_refused(path: str, tool: Measurements, refused: Mapping[str, int]) -> list[str]:
    """Words for poses that the reader refused; all of them are too many."""
    words = []
    for what, count in refused.items():
        topic, _, reason = what.partition(': ')
        if optical_stem(topic) != topic_of(tool.body):
            continue
        if tool.track is None:
            raise PlausibilityError(
                f'{path}: all {count} optical poses of {tool.body} are refused: {reason}'
            )
        words.append(f'{count} optical poses of {tool.body} are refused: {reason}')
    return words


def _check_clocks(path: str, tool: Measurements) -> None:
    if tool.track is None or not tool.time.size:
        return
    first, last = float(tool.track.time[0]), float(tool.track.time[-1])
    begin, end = float(tool.time[0]), float(tool.time[-1])
    apart, where = (first - end, 'after the last') if first > end else (begin - last, 'before the')
    if apart > 0.0:
        raise PlausibilityError(
            f'{path}: the optical poses of {tool.body} are stamped {apart:.4g} s {where} '
            f'{"flux" if first > end else "first flux"}: are the two clocks set alike?'
        )


def _thawed(path: str, tool: Measurements) -> tuple[Measurements, list[str]]:
    """The tool without the poses that its optical tracker repeated while it moved."""
    track = tool.track
    if track is None or track.time.size < 2:
        return tool, []
    frozen, lasted_s, moved = np.zeros(track.time.size, dtype=bool), 0.0, 0.0
    for first, last in _still_runs(track):
        begin, end = float(track.time[first]), float(track.time[last])
        change = _change(tool, begin, end)
        if change > MOVED:
            frozen[first + 1 : last + 1] = True
            lasted_s, moved = lasted_s + end - begin, max(moved, change)
    if not frozen.any():
        return tool, []
    whole_s = float(track.time[-1] - track.time[0])
    evidence = (
        f'the optical poses of {tool.body} are the same bit for bit for {lasted_s:.1f} of '
        f'{whole_s:.1f} s while its fluxes change by {100 * moved:.0f} %'
    )
    if lasted_s > MOST_FROZEN * whole_s:
        raise PlausibilityError(f'{path}: {evidence}: was the optical tracker frozen?')
    live = PoseTrack(track.time[~frozen], track.position[~frozen], track.quaternion[~frozen])
    return tool.with_track(live), [f'{evidence}; these poses are left out']


def _still_runs(track: PoseTrack) -> list[tuple[int, int]]:
    """First and last pose of every run of equal poses that lasts long enough."""
    same = (np.diff(track.position, axis=0) == 0.0).all(axis=1)
    same &= (np.diff(track.quaternion, axis=0) == 0.0).all(axis=1)
    steps = np.diff(np.concatenate([[0], same.astype(np.int64), [0]]))
    pairs = zip(np.flatnonzero(steps == 1), np.flatnonzero(steps == -1), strict=True)
    return [(int(i), int(j)) for i, j in pairs if track.time[j] - track.time[i] >= FROZEN_S]


def _change(tool: Measurements, begin: float, end: float) -> float:
    """Relative change of the median sensor's fluxes within a time."""
    rows = (tool.time >= begin) & (tool.time <= end)
    changes = []
    for column in range(len(tool.sensors)):
        flux = tool.flux[rows & tool.valid[:, column], column]
        if len(flux) < 2:
            continue
        middle = np.median(flux.real, axis=0) + 1j * np.median(flux.imag, axis=0)
        away = np.linalg.norm(flux - middle, axis=1)
        # One frame in ten may be an outlier.
        changes.append(float(np.percentile(away, 90)) / max(float(np.linalg.norm(middle)), 1e-30))
    return float(np.median(changes)) if changes else 0.0


def check_distance(path: str, setup: Setup, tool: Measurements) -> None:
    """Raise `PlausibilityError` where a tool's optical poses are not near the board."""
    if tool.track is None:
        return
    volume = tracked_volume(setup)
    reach = float(np.linalg.norm(np.maximum(np.abs(volume.low), np.abs(volume.high))))
    distance = float(np.median(np.linalg.norm(tool.track.position, axis=1)))
    if distance > FAR * reach:
        span = float(np.linalg.norm(np.ptp(tool.track.position, axis=0)))
        unit = unit_words(distance / (0.5 * reach), LENGTH_UNITS) or 'another unit, or frame'
        raise PlausibilityError(
            f'{path}: optical positions of {tool.body} span {span:.3g} m and lie {distance:.3g} m '
            f'from the board, tools within {reach:.2g} m: {unit}?'
        )


FAR_RAD = 0.35
"""Turn, rad, about its axis of a body that a stage turns, and across it of one that was mounted
otherwise: a hand that turns a tool so far turns it across the axis too, and without a jump."""
FEWEST_MOUNTED = 10
"""Poses without which a mounting is none: any few have an axis in common."""


def times_of_mounting(tool: Measurements) -> list[float]:
    """Return times, s, from which on a body, or the source, was mounted otherwise.

    A stage turns a body about one axis, whose direction in fg stays the same; with another
    mounting another one does.
    """
    time, rotation = tool.time[tool.has_pose], tool.rotation[tool.has_pose]
    found, start = list[float](), 0
    while start < len(time):
        low, high = start + 1, len(time) + 1  # the part ends at the former, before the latter
        while high - low > 1:
            middle = (low + high) // 2
            is_one = _across(rotation[start:middle], rotation[start:middle]) < TURNED_RAD
            low, high = (middle, high) if is_one else (low, middle)
        part, later = rotation[start:low], rotation[low : low + 1]
        turned = rotation_angles(part[0].T @ part).max()
        if min(turned, _across(part, later)) < FAR_RAD or low - start < FEWEST_MOUNTED:
            return []
        found += [float(time[start])] * (start > 0)
        start = low
    return found


def _across(part: Array, rotation: Array) -> float:
    """How far some rotations are across the axis that others keep; infinite without either."""
    ways = unturned(part.mean(axis=0))[:1].T
    if not ways.size or not len(rotation):
        return np.inf
    return float(np.abs(rotation @ ways - (part @ ways).mean(axis=0)).max())
