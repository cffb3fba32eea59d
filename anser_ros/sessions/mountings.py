"""Divides a recording in which a body or the source was mounted otherwise from some time on.

A stage turns a body about one axis: one direction of the body stays the same in fg. Where it is
suddenly far from that, something was mounted otherwise. How exactly a fixture holds a body is of
that mounting, so each is a session.
"""

from dataclasses import replace

import numpy as np

from anser_ros.arrays import Array
from anser_ros.calibration.readings import FEWEST_SCAN_FRAMES
from anser_ros.field.measurements import Measurements
from anser_ros.physics.rotations import TURNED_RAD, rotation_angles, unturned
from anser_ros.sessions.session import Session

FAR_RAD = 0.35
"""Turn, rad, about its axis of a body that a stage turns, and across it of one that was mounted
otherwise: a hand that turns a tool so far turns it across the axis too, and without a jump."""


def mountings(session: Session) -> tuple[Session, ...]:
    """Return the parts of a session in which all was mounted alike, by default the session."""
    starts = sorted({time for tool in session.tools for time in _changes(tool)})
    if not starts:
        return (session,)
    ends = zip([-np.inf, *starts], [*starts, np.inf], strict=True)
    return tuple(_part(session, f'{session.path}#{k}', *own) for k, own in enumerate(ends, 1))


def mounting_words(*sessions: Session) -> tuple[str, ...]:
    """Return a line for each session in which something was mounted otherwise: from when on."""
    words = 'a mounting of its own (the body turns about another axis) from'
    parts = ((one.path, mountings(one)[1:]) for one in sessions)
    starts = ((path, [f'{part.tools[0].time[0]:.0f}' for part in own]) for path, own in parts)
    return tuple(f'{path}: {words} {", ".join(own)} s on' for path, own in starts if own)


def _changes(tool: Measurements) -> list[float]:
    """Times, s, from which on a body that turns about one axis at a time turns about another."""
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
        if min(turned, _across(part, later)) < FAR_RAD or low - start < FEWEST_SCAN_FRAMES:
            return []
        found += [float(time[start])] * (start > 0)
        start = low
    return found


def _across(part: Array, rotation: Array) -> float:
    """Return how far any of some rotations to fg is across the axis of others; infinite of none.

    That axis is the direction of the body that the latter hardly turned.
    """
    ways = unturned(part.mean(axis=0))[:1].T
    if not ways.size or not len(rotation):
        return np.inf
    return float(np.abs(rotation @ ways - (part @ ways).mean(axis=0)).max())


def _part(session: Session, name: str, begin: float, end: float) -> Session:
    """The frames from a time to before another, s, under a name."""

    def own(measured: Measurements) -> Measurements:
        inside = (measured.time >= begin) & (measured.time < end)
        return replace(measured.frames(inside), session=name)

    reference = None if session.reference is None else own(session.reference)
    tools = tuple(map(own, session.tools))
    return replace(session, path=name, tools=tools, reference=reference)
