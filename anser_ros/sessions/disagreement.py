"""Says in words how poses and the reference that they are compared with disagree as a whole.

Errors say how far; here is what all of them have in common: another frame, another mounting of the
body, or poses that were written in another way. It is said, and nothing is corrected.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from anser_ros.arrays import Array, Integers
from anser_ros.effects.effect import all_effects
from anser_ros.field.model import EffectRecord
from anser_ros.physics.constants import DEGREES
from anser_ros.physics.rotations import nearest_rotation, rotation_angles
from anser_ros.pose_states import OK
from anser_ros.sessions.plausibility import OTHER_READINGS
from anser_ros.settings import Accuracy
from anser_ros.tracking.estimate import PoseEstimate

FEWEST_POSES = 10
"""Poses without which nothing is said: few have a shift in common by chance."""
APART = 3.0
"""Sigmas of a pose and the reference beyond which all poses stand aside: no noise makes that."""
EXPLAINED = 0.5
"""Share of the error that may be left by what explains it: four fifths of its power are gone."""
GROSS_M, GROSS_RAD = 5e-3, np.radians(5.0)
"""Median errors that no tracker of this kind has: something was stated wrongly."""
LARGE_PART = 0.1
"""Share of poses grossly off from which on a part of the recording stands otherwise: fewer are
reflections of an optical tracker's markers."""
ARM_M = 0.1
"""Distance, m, at which a turn is compared with a shift: the size of a hand, or a tool."""

MOST_FRAMES_LATE = 12
"""Frames by which the reference may be early or late: half a second of a camera's, or some rows
that a table lost."""

Poses = tuple[Array, Array]
"""Positions (F, 3), m, and rotations (F, 3, 3) to fg."""


class Disagreement(NamedTuple):
    """Says in a line how a body's poses and the reference's disagree as a whole."""

    words: str
    is_gross: bool = False  # by more than any tracker of this kind is wrong
    is_stated: bool = False  # and explained by what is beyond the range of every effect


def disagreement(
    name: str, estimates: Sequence[PoseEstimate], true: Poses, accuracy: Accuracy
) -> tuple[Disagreement, ...]:
    """Return how a body's F poses and the reference's disagree, where all do alike, or grossly.

    The reference's are NaN where there is none, and as accurate as is stated.
    """
    ok = np.array([estimate.state == OK for estimate in estimates])
    rows = np.flatnonzero(ok & np.isfinite(true[0]).all(axis=1))
    if len(rows) < FEWEST_POSES:
        return ()
    poses = [estimates[i] for i in rows.tolist()]
    given = np.array([p.position for p in poses]), np.array([p.rotation for p in poses])
    here = true[0][rows], true[1][rows]
    power = np.array([p.covariance.diagonal() for p in poses]).reshape(-1, 2, 3).sum(axis=2)
    own = 3.0 * np.square([accuracy.optical_position_m, accuracy.optical_rotation_rad])
    sigma = np.median(np.sqrt(power + own), axis=0)
    apart = _apart(given, here)
    size, limit = _size(apart), np.maximum(2.0 * APART * sigma, [GROSS_M, GROSS_RAD])
    is_gross = bool((np.median(apart, axis=0) > limit).any())
    count = int((apart > limit).any(axis=1).sum())
    off = f'{name}: the reference is {_words(*size)} rms off the poses'
    if not is_gross and count > LARGE_PART * len(apart):
        part = f'{count} of {len(apart)} by more than {_words(*limit)}'
        words = f'{off}, {part}: part of the recording was stated otherwise, or moved'
        return (Disagreement(words),)
    found = [*_frames(given, here)]
    if is_gross:
        found += [(r.placed(*here), f'read as {r.words}', None) for r in OTHER_READINGS]
        found += _late(np.array([p.stamp_ns for p in poses]), rows, true)
    each = [(_size(_apart(given, other)), words, changed) for other, words, changed in found]
    left, words, changed = min(each, key=lambda one: one[0] @ [1.0, ARM_M])
    if (left < limit).all():
        is_less = is_gross or ((left < EXPLAINED * size) & (size > APART * sigma)).any()
        words, told = f'{off}; {words}, {_words(*left)} are left', changed or {}
        able = [e for e in all_effects().values() if told.keys() & e.plausible.keys()]
        is_effect = bool(told) and all(e.possible(EffectRecord(e.name, told)) for e in able)
        return (Disagreement(words, is_gross, is_gross and not is_effect),) if is_less else ()
    words = f'{off}; no frame, mounting, unit or order of axes explains that, nor a delay'
    return (Disagreement(words, is_gross),) if is_gross else ()


Explained = tuple[Poses, str, dict[str, Any] | None]
"""The reference's poses read otherwise, in words, and the effects' parameters that do so; None
where there is no such effect."""


def _frames(given: Poses, true: Poses) -> Iterator[Explained]:
    """The reference's poses in another frame, and as those of a body mounted otherwise."""
    (place, turn), (position, rotation) = given, true
    back, off = np.swapaxes(rotation, 1, 2), place - position
    frame, mount = (nearest_rotation(m.mean(axis=0)) for m in (turn @ back, back @ turn))
    arm = np.einsum('fij,fj->i', back, off) / len(place)
    words = _words(np.linalg.norm(off.mean(axis=0)), rotation_angles(frame))
    there = (position - position.mean(axis=0)) @ frame.T + place.mean(axis=0)
    changed = {'rotation_deg': DEGREES * rotation_angles(frame)}
    yield (there, frame @ rotation), f'in a frame that is {words} beside fg', changed
    words = _words(np.linalg.norm(arm), rotation_angles(mount))
    there = position + rotation @ arm
    yield (there, rotation @ mount), f'on a body mounted {words} otherwise', {'offset_m': arm}


def _late(stamp_ns: Integers, rows: Integers, true: Poses) -> Iterator[Explained]:
    """The reference's poses of frames before and after these rows, NaN where there is none."""
    step_s = 1e-9 * float(np.median(np.diff(stamp_ns) / np.diff(rows)))
    for late in (n for n in range(-MOST_FRAMES_LATE, MOST_FRAMES_LATE + 1) if n):
        there = np.clip(rows + late, 0, len(true[0]) - 1)
        place = np.where((there == rows + late)[:, None], true[0][there], np.nan)
        if np.isfinite(place[:, 0]).mean() > 0.5:
            words = f'read as stamped {abs(late) * step_s:.3g} s {"late" if late > 0 else "early"}'
            yield (place, true[1][there]), words, {'offset_s': -late * step_s}


def _apart(given: Poses, true: Poses) -> Array:
    """Distances, m, and angles, rad, between poses, (F, 2)."""
    (place, turn), (position, rotation) = given, true
    angle = rotation_angles(np.swapaxes(rotation, 1, 2) @ turn)
    return np.stack([np.linalg.norm(place - position, axis=1), angle], axis=1)


def _size(apart: Array) -> Array:
    return np.asarray(np.sqrt(np.nanmean(apart**2, axis=0)))


def _words(metres: Any, radians: Any) -> str:
    return f'{1e3 * metres:.2f} mm and {DEGREES * radians:.2f} deg'
