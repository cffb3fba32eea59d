"""Judges a pose by those before it, and by what the coils of a rigid body say of each other.

A single residual that passes the gate proves little when most of its neighbours in time do not: a
few wrong poses pass by chance. So after withheld poses a pose needs consistent ones before it.
Points that were recorded one by one, further apart than `STREAM_GAP_S`, have no motion that could
contradict them; but a model that most of the last ones contradict is wrong for the others too.

A body's pose predicts the place of each of its coils, and each coil has its own pose. A coil whose
two differ by more than their errors, the survey's and that of its gain is in another place, or is
another coil. If it took part in the body's solve, the difference has the *difference* of the two
covariances (Hausman, Econometrica 1978), which the coil's own bounds from above; else their sum.
"""

import math
from collections import deque
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from anser_ros.arrays import Array
from anser_ros.kernel_cache import inlined, kernel
from anser_ros.physics.rotations import fill_tangent
from anser_ros.settings import ToolSettings
from anser_ros.stamps import NANO

STREAM_GAP_S = 0.5
"""Frames further apart than this, s, are single points and no stream."""
RECORD_S = 1.0
"""How far back refusals count, s; after a distortion has ended a tool waits as long."""
MOST_REFUSED = 0.5
"""Share (0 to 1) of refused frames from which on a pass is more likely chance than not."""
LAST_POINTS = 12
"""Single points whose refusals count. Fewer, and two bad ones withhold good ones; more, and a
source that was moved gives poses for longer."""
START_FRAMES = 3
"""Fewest consecutive frames, the last included, that confirm a pose: two wrong ones may agree."""
ALTERNATES_S, FEWEST_JUMPS = 2.0, 3
"""So many jumps within this time, s, to another pose that fits as well, or back, are no motion
and no chance (once is a damaged record): two worlds take turns, as where a block is late."""
ENDED_S = 0.8
"""Time, s, after the last jump from which on they have ended: such jumps are hardly further apart,
and poses are to be back within a second."""
DETOUR = 3.0
"""Length of a way by that of the straight one from which on what is between is a jump."""
LONGEST_RUN_S = 0.25
"""Longest run asked for, s: 12 frames at 50 Hz pass by chance once in 5e5 where a third do."""
SIGMAS = 3.0
"""Allowance for the poses' own errors, in units of `Place.sigma_m`, beside the bounds."""


ARM_M = 0.1
"""Distance from a tool's place, m, at which its ends keep to the bounds of its motion too: a hand
turns a tool by 20 rad/s at most, by 60 degrees from one frame to the next at 20 Hz. Smaller, and
poses that turn over look like movements; larger, and quick turns of a short tool lose frames."""


class Place(NamedTuple):
    """States where something was, and how well that is known: stamp, place, its sigma, m.

    ``position`` is the position, m, and what turns about it at a distance of `ARM_M`, so that the
    distance of two places is the root mean square of how far both ends have moved.
    """

    stamp_ns: int
    position: Sequence[float]
    sigma_m: float


def motion_contradiction(before: list[Place], now: Place, tools: ToolSettings) -> str:
    """State how a place contradicts the places before it, oldest first; empty if it does not.

    Of the last two places and this one: for an acceleration of at most a, the place is no further
    than ``a dt (dt + dt_before) / 2`` from where the mean velocity before leads.
    """
    if not before:
        return ''
    last = before[-1]
    dt = (now.stamp_ns - last.stamp_ns) * NANO
    away = math.dist(now.position, last.position)
    error = SIGMAS * math.hypot(now.sigma_m, last.sigma_m)
    if away > tools.max_speed_m_s * dt + error:
        return f'{1e3 * away:.3g} mm in {1e3 * dt:.3g} ms is a speed of {away / dt:.3g} m/s'
    if len(before) < 2:
        return ''
    first = before[-2]
    dt_before = (last.stamp_ns - first.stamp_ns) * NANO
    steps = dt / dt_before
    led = [b + steps * (b - a) for a, b in zip(first.position, last.position, strict=True)]
    bent = math.dist(now.position, led)
    error = SIGMAS * math.hypot(now.sigma_m, (1.0 + steps) * last.sigma_m, steps * first.sigma_m)
    time = 0.5 * dt * (dt + dt_before)
    if bent > tools.max_acceleration_m_s2 * time + error:
        return f'an acceleration of {bent / time:.3g} m/s^2'
    return ''


def is_detour(before: Place, away: Place, after: Place) -> bool:
    """Return whether a place lies nowhere near the way from the one before to the one after it."""
    by = math.dist(before.position, away.position) + math.dist(away.position, after.position)
    errors = away.sigma_m + max(before.sigma_m, after.sigma_m)
    return by > DETOUR * math.dist(before.position, after.position) + 2.0 * SIGMAS * errors


class Continuity:
    """Judges one sensor's or body's poses through time."""

    def __init__(self) -> None:
        self._points: deque[bool] = deque(maxlen=LAST_POINTS)
        self.forget()

    @property
    def refused_share(self) -> float:
        """Return the share of the last second's frames that were refused in spite of signals."""
        return self._refused / max(len(self._record), 1)

    @property
    def alternates(self) -> str:
        """Return that two worlds take turns; empty where they do not."""
        jumps = self._jumps
        if len(jumps) < FEWEST_JUMPS or self._last_ns - jumps[-1] > ENDED_S / NANO:
            return ''
        times = f'{len(jumps)} times within {ALTERNATES_S:g} s'
        return f'the readings jump to another pose and back, {times}: a fault of the line'

    def forget(self) -> None:
        """Forget all frames that were judged so far, but for which single points were refused."""
        self._jumps: deque[int] = deque()
        self._away: Place | None = None
        self._track: list[Place] = []
        self._run: list[Place] = []
        self._frames = self._began_ns = self._last_ns = self._refused = 0
        self._record: deque[tuple[int, bool]] = deque()

    def judge(self, stamp_ns: int, place: Place | None, refused: bool, tools: ToolSettings) -> str:
        """Return why the next frame's pose is not confirmed; empty where it is, or there is none.

        ``place`` is that of a pose that fits its own readings; ``refused`` says whether there is
        none that is good although there are signals.
        """
        other, place = (place, None) if refused else (None, place)
        last_ns = self._last_ns
        alone = not last_ns or not 0 < stamp_ns - last_ns <= STREAM_GAP_S / NANO
        if alone:
            self.forget()
            if place is not None or refused:
                self._points.append(place is None)
        if other is not None and self._track and self._track[-1].stamp_ns == last_ns:
            self._away = other
        elif place is not None and self._away is not None and self._track:
            if is_detour(self._track[-1], self._away, place):
                self._jumps.append(stamp_ns)
            self._away = None
        while self._jumps and stamp_ns - self._jumps[0] > ALTERNATES_S / NANO:
            self._jumps.popleft()
        self._last_ns = stamp_ns
        self._note(stamp_ns, place is None and refused, place is not None or refused)
        if place is None:
            self._run, self._frames = [], 0
            return ''
        contradiction = motion_contradiction(self._track, place, tools)
        old = not self._track or stamp_ns - self._track[-1].stamp_ns > RECORD_S / NANO
        if not (old or contradiction or self._refused > MOST_REFUSED * len(self._record)):
            self._track, self._frames = [self._track[-1], place], 0
            return ''
        if not self._frames or motion_contradiction(self._run, place, tools):
            self._run, self._frames, self._began_ns = [], 0, stamp_ns
            if contradiction and not old:
                self._jumps.append(stamp_ns)
        self._run, self._frames = [*self._run[-1:], place], self._frames + 1
        # The run must be as long as refusals were lately, up to a bound.
        needed_s = min(self.refused_share * RECORD_S, LONGEST_RUN_S)
        is_long = (stamp_ns - self._began_ns) * NANO >= needed_s
        if alone or (is_long and self._frames >= START_FRAMES):
            self._track = list(self._run)
            return self._against_points() if alone else ''
        if contradiction and not old:
            return contradiction
        return (
            f'{100 * self.refused_share:.0f} % of the frames of the last second were refused, '
            f'and {self._frames} good frames in a row are too few'
        )

    def _against_points(self) -> str:
        """Return that most of the last single points were refused; empty where they were not."""
        refused, count = sum(self._points), len(self._points)
        against = refused > MOST_REFUSED * count
        return f'{refused} of the last {count} points were refused' if against else ''

    def _note(self, stamp_ns: int, refused: bool, counts: bool) -> None:
        record = self._record
        while record and stamp_ns - record[0][0] > RECORD_S / NANO:
            self._refused -= record.popleft()[1]
        if counts:
            record.append((stamp_ns, refused))
            self._refused += refused


SELDOM = 1e-6
"""Probability that a sound coil contradicts its body."""
GATE = float(chdtri(5, SELDOM))
"""Squared Mahalanobis distance from which on a coil contradicts its body: 36, six sigma."""


HARMFUL_M = 1e-3
"""An error of a pose that does harm, m, where the pose's own sigma does not say it."""
BODY_SIGMAS = 3.0
"""Sigmas that a pose may be off its body, of all three directions: once in 10^5 sound frames."""
SURVEYS = 6.0
"""The same in stated errors of the survey, if that is more: one of 1e7 coils is so far off."""


APART_M = 1e-3
"""Coils nearer to each other than this, m, are at one place of a tool, and no bend parts them."""
FAILS_ALONE, IS_BENT = 1e-2, 1e-4
"""Probability that a coil fails by itself (its gain, a turn, its plug), and that a tool is bent or
parts of it are plugged in for each other. So one coil against the rest is at fault, by 100 to 1;
several would have to fail alike, which is less likely than a bend, and of a bend either part may
be the one that moved: the coils of a body do not say which."""


def is_part(offsets: Array, against: Collection[int], others: Collection[int]) -> bool:
    """Return whether coils that contradict the others may be a part of the tool that is bent.

    ``offsets`` (S, 3), m, are all coils' in the body; ``against`` and ``others`` are some of them.
    """
    if not against or not others or FAILS_ALONE ** len(against) > IS_BENT:
        return False
    apart = offsets[list(against)][:, None] - offsets[list(others)]
    return bool(((apart**2).sum(axis=2) > APART_M**2).all())


@inlined
def _add_product(rows, covariance, total):  # type: ignore[no-untyped-def]
    """Add ``rows covariance rows^T`` of rows (m, n) to a matrix (m, m)."""
    for i in range(rows.shape[0]):
        for b in range(rows.shape[1]):
            part = 0.0
            for a in range(rows.shape[1]):
                part += rows[i, a] * covariance[a, b]
            for j in range(rows.shape[0]):
                total[i, j] += part * rows[j, b]


@inlined
def _squared_distance(covariance, apart):  # type: ignore[no-untyped-def]
    """Return ``apart^T covariance^-1 apart`` by Cholesky's factor, which is written over both."""
    total = 0.0
    for i in range(apart.shape[0]):
        for j in range(i + 1):
            for k in range(j):
                covariance[i, j] -= covariance[i, k] * covariance[j, k]
            if j < i:
                covariance[i, j] /= covariance[j, j]
                apart[i] -= covariance[i, j] * apart[j]
        covariance[i, i] = math.sqrt(covariance[i, i])
        apart[i] /= covariance[i, i]
        total += apart[i] ** 2
    return total


@kernel
def distances(  # type: ignore[no-untyped-def]
    position, rotation, covariance, offsets, axes, positions, directions, covariances, took_part,
    survey,
):  # fmt: skip
    """Return how far each coil's own pose is from its place in the body, (4, S).

    The rows are the squared Mahalanobis distance, the distance, m, the angle between the axes,
    rad, and whether one of the distances is more than errors make.

    ``position`` (3,), ``rotation`` (3, 3), ``covariance`` (6, 6): the body's. ``offsets``,
    ``axes`` (S, 3): the coils in the body. ``positions``, ``directions`` (S, 3), ``covariances``
    (S, 6, 6): what the coils say. ``took_part`` (S,): whether the body's pose made use of the
    coil. ``survey`` (3,): m, rad, relative gain, of which a third seems to be a change of the
    distance: a field falls with its third power.
    """
    found = np.empty((4, offsets.shape[0]))
    t, slopes, total = np.empty((2, 3)), np.zeros((2, 5, 6)), np.empty((5, 5))
    apart, arm, n, cross = np.empty(5), np.empty(3), np.empty(3), np.empty(3)
    for s in range(offsets.shape[0]):
        m, cosine, radial = directions[s], 0.0, survey[2] * positions[s, 2] / 3.0
        fill_tangent(m, t)
        for i in range(3):
            arm[i] = n[i] = 0.0
            for j in range(3):
                arm[i] += rotation[i, j] * offsets[s, j]
                n[i] += rotation[i, j] * axes[s, j]
            apart[i] = positions[s, i] - position[i] - arm[i]
            cosine += n[i] * m[i]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            cross[i] = n[j] * m[k] - n[k] * m[j]
            slopes[1, i, 3 + j], slopes[1, i, 3 + k] = arm[k], -arm[j]
            for way in range(2):
                slopes[way, i, i] = 1.0
                slopes[way, 3, 3 + i], slopes[way, 4, 3 + i] = t[0, i], t[1, i]
        sine = math.sqrt(cross[0] ** 2 + cross[1] ** 2 + cross[2] ** 2)
        angle = math.atan2(sine, cosine)
        for j in range(2):
            # The rotation vector from n to m lies across m; half a turn is about any such vector.
            along = t[j, 0] * cross[0] + t[j, 1] * cross[1] + t[j, 2] * cross[2]
            apart[3 + j] = (along / sine if sine > 1e-12 else 1.0 - j) * angle
        for i in range(5):
            for j in range(5):
                total[i, j] = 0.0
            total[i, i] = survey[0] ** 2 + radial**2 if i < 3 else survey[1] ** 2
        for way in range(1 if took_part[s] else 2):
            _add_product(slopes[way], covariances[s] if way == 0 else covariance, total)
        found[1, s] = math.sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2)
        found[0, s], found[2, s] = _squared_distance(total, apart), angle
        own = covariances[s]
        sigma_m = math.sqrt(own[0, 0] + own[1, 1] + own[2, 2])
        allowed_m = max(BODY_SIGMAS * sigma_m, HARMFUL_M, SURVEYS * survey[0])
        found[3, s] = not (found[0, s] <= GATE and found[1, s] <= allowed_m)
    return found


def strangers(
    offsets: Array, axes: Array, places: Sequence[Place], sigmas_m: Array, tools: ToolSettings
) -> Array:
    """Return by how much, m, coils contradict most of the others of their body, (S,); else 0.

    They are rigid although the body has no pose: the two ends of a coil, its place and a point on
    its axis at `ARM_M`, are at known distances from those of another, so that parallel coils
    along their axis are told from each other. ``offsets``, ``axes`` (S, 3) are the coils' in the
    body, ``places`` where they say that they are, ``sigmas_m`` (S,) those of the positions.
    """
    said = np.array([place.position for place in places]).reshape(-1, 2, 3).cumsum(axis=1)
    ends = np.stack([offsets, offsets + ARM_M * axes], axis=1)
    known, found = (
        np.linalg.norm(e[:, None, :, None] - e[None, :, None, :], axis=4) for e in (ends, said)
    )
    sigmas = np.stack([sigmas_m, [place.sigma_m for place in places]], axis=1)
    aside = tools.tool_coil_position_m
    survey = np.array([aside, math.hypot(aside, ARM_M * tools.tool_coil_axis_rad)])
    error = np.hypot(sigmas[:, None, :, None], sigmas[None, :, None, :])
    stated = np.hypot(survey[:, None], survey)
    allowed = np.maximum(np.maximum(BODY_SIGMAS * error, HARMFUL_M), SURVEYS * stated)
    off = abs(found - known)
    off = np.where(off > allowed, off, 0.0).max(axis=(2, 3))
    is_most = 2 * np.count_nonzero(off, axis=1) > len(offsets) - 1
    return np.asarray(np.where(is_most, off.max(axis=1), 0.0))


def reason(distance: float, away_m: float, turned_rad: float) -> str:
    """Return what is said of a coil that contradicts its body."""
    sigmas = math.sqrt(distance)
    return (
        f'{1e3 * away_m:.2g} mm and {math.degrees(turned_rad):.2g} deg from its place in the '
        f'body, {sigmas:.2g} sigma'
    )
