"""Judges whether a recording can be what its units, clocks and poses say, before it is used.

Every check refuses on evidence only, and names it; what the data cannot decide passes.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import PlausibilityError
from anser_ros.field.measurements import Measurements
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.sessions.conventions import check_conventions
from anser_ros.sessions.drawing import NominalBoard
from anser_ros.sessions.units import LENGTH_UNITS, unit_words
from anser_ros.sessions.volume import tracked_volume
from anser_ros.wire.pose_topics import optical_stem
from anser_ros.wire.setup import Setup, topic_of

Array = NDArray[np.float64]

FAR = 10.0
"""Distance of the median optical position from the board, in distances of the tracked volume's
farthest corner, beyond which no tool is held. Optics may see a tool that is carried about the
room, a few such distances away; a smaller factor would refuse that, a larger one let inches by."""
FROZEN_S = 1.0
"""Time, s, for which poses must be the same bit for bit before an optical tracker counts as
frozen. Cameras that answer more often than they look repeat a pose for a tenth of a second."""
MOVED = 0.1
"""Relative change of a tool's fluxes that shows it has moved while its poses stood still: a
centimetre at a hand's breadth. Noise changes them by a ten-thousandth, metal that comes near a
tool at rest by a few hundredths."""
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

    ``refused`` is what the reader refused, ``topic: reason``, and how often. What was left out or
    refused is returned in words; empty when nothing was.

    Raises
    ------
    PlausibilityError
        With the evidence, in one line.
    """
    nominal, kept, words = NominalBoard.of(setup), [], []
    for tool in tools:
        words += _check_refused(path, tool, refused)
        _check_clocks(path, tool)
        thawed, remarks = _thawed(path, tool)
        words += remarks
        check_conventions(path, setup, nominal, thawed)
        _check_distance(path, setup, thawed)
        kept.append(thawed)
    return tuple(kept), '; '.join(words)


def check_points(tracked: Array, true: Array) -> None:
    """Check the points (M, 3), m, that an error map shall be learnt from; not rows with NaN.

    Raises
    ------
    PlausibilityError
        When their extents fit no tracked volume or not each other, or one of them is a point.
    """
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
    """Check that the positions (n, 3) of a tracker can be in m; ``what`` says whose they are.

    Raises
    ------
    PlausibilityError
        When most of them extend over more than a room, or lie where a unit explains it.
    """
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
    position, rotation, has_pose = live.at(tool.time)
    thawed = replace(tool, track=live, position=position, rotation=rotation, has_pose=has_pose)
    return thawed, [f'{evidence}; these poses are left out']


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


def _check_distance(path: str, setup: Setup, tool: Measurements) -> None:
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
