"""Sets a session of poses up for fitting: what is predicted of it, its residuals and their noise.

Errors of poses and stamps themselves: jitter between neighbours, and grids of polls.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.effect import PoseSetting, PoseTerm, PoseView, Role, frames_of
from anser_ros.apps.poses.sequence import OpticalPath, PoseSequence, PoseSession
from anser_ros.arrays import AnyArray, Array, Booleans, Integers
from anser_ros.calibration.readings import FOLDS
from anser_ros.diagnosis.engine import BlockSums, JointState, block_sums, joined

FILTER_STEP = 0.05
"""Share of a filter's time constant by which it is changed for differences, above its grid."""


@dataclass(frozen=True)
class PoseNoise:
    """States how far a sensor's poses are off without any effect, one standard deviation."""

    position_m: float  # of each coordinate
    orientation_rad: float
    stamp_s: float = 0.0  # of the stamps against each other: moves a pose along its own velocity

    def whitened(self, values: Array, velocity: Array) -> Array:
        """Return values (n, 6, ...) in units of their spread; velocity (n, 6) as in `PoseView`."""
        scale = np.repeat([1 / self.position_m, 1 / self.orientation_rad], 3)
        shape = (1, 6) + (1,) * (values.ndim - 2)
        return self.without_stamps(values * scale.reshape(shape), velocity)

    def without_stamps(self, values: Array, velocity: Array) -> Array:
        """Return values (n, 6, ...) of unit spread without what errors of stamps add."""
        if self.stamp_s == 0.0:
            return values
        scale = np.repeat([1 / self.position_m, 1 / self.orientation_rad], 3)
        along = velocity * scale * self.stamp_s
        size = np.linalg.norm(along, axis=1)
        unit = along / np.maximum(size, 1e-12)[:, None]
        less = 1 - 1 / np.sqrt(1 + size**2)
        part = np.einsum('ni,ni...->n...', unit, values)
        return np.asarray(values - np.einsum('n,ni,n...->ni...', less, unit, part))


@dataclass(frozen=True)
class PoseProblem:
    """Holds everything that a fit starts from; what is one of each sensor stands in tuples."""

    sensors: tuple[PoseSequence, ...]  # poses in the order of time; repeats are left out
    path: OpticalPath  # of the reference
    setting: PoseSetting
    blocks: tuple[Integers, ...]  # (n,), number of the time block that each pose is in
    places: tuple[Integers, ...]  # (n,), number of the block of space
    weight: tuple[Array, ...]  # (n,), square root of what a pose counts; zero leaves it out
    noise: tuple[PoseNoise, ...]

    def rows(self, keep: Sequence[AnyArray]) -> 'PoseProblem':
        """Return the poses of each sensor that are named by index or mask."""
        rows: dict[str, Any] = {
            key: tuple(v[k] for v, k in zip(getattr(self, key), keep, strict=True))
            for key in ('blocks', 'places', 'weight')
        }
        sensors = tuple(s.rows(k) for s, k in zip(self.sensors, keep, strict=True))
        return replace(self, sensors=sensors, **rows)

    def sensor(self, index: int) -> 'PoseProblem':
        """Return the problem with one of its sensors alone."""
        keys = ('sensors', 'blocks', 'places', 'weight', 'noise')
        one: dict[str, Any] = {key: getattr(self, key)[index : index + 1] for key in keys}
        return replace(self, **one)

    def in_blocks(self, wanted: Integers) -> 'PoseProblem':
        """Return the problem with only the poses in some blocks of time."""
        return self.rows([np.isin(blocks, wanted) for blocks in self.blocks])

    def state(self, terms: Sequence[PoseTerm]) -> 'PoseState':
        """Return all poses predicted with some active effects, and what they are missed by."""
        parts = []
        for i, sensor in enumerate(self.sensors):
            view, residual, known = predicted(self.path, sensor, terms)
            weight = np.where(known, self.weight[i], 0.0)
            parts.append(PosePart(view, residual, weight, self.noise[i], self.blocks[i],
                                  self.places[i]))  # fmt: skip
        return PoseState(self, tuple(terms), tuple(parts))


def predicted(
    path: OpticalPath, sensor: PoseSequence, terms: Sequence[PoseTerm]
) -> tuple[PoseView, Array, Booleans]:
    """Return view, residual (n, 6) measured less predicted, and where the reference is known."""
    time, position, rotation = sensor.time, sensor.position, sensor.rotation
    frames = frames_of(terms, sensor.name)
    frame, lever = frames.rotation, frames.lever
    for term in terms:
        path = term.effect.filter(term, path) if term.acts_on(sensor.name) else path
        time = term.effect.clock(term, sensor.name, time)
        position = term.effect.corrected(term, sensor.name, position, rotation)
    optical, turn, velocity, known = path.at(time)
    for term in terms:
        optical = term.effect.seen(term, optical)
    body = frame @ turn
    arm = body @ lever
    predicted = optical @ frame.T + arm + frames.translation
    moving = np.empty((time.size, 6))
    moving[:, 3:] = velocity[:, 3:] @ frame.T
    moving[:, :3] = velocity[:, :3] @ frame.T + np.cross(moving[:, 3:], arm)
    predicted_turn = body @ frames.mount
    view = PoseView(
        sensor.name, sensor.time, sensor.position, sensor.rotation, optical, turn, frame, lever,
        predicted, predicted_turn, moving,
    )  # fmt: skip
    residual = np.empty((time.size, 6))
    residual[:, :3] = position - predicted
    difference = rotation @ predicted_turn.transpose(0, 2, 1)
    if time.size:
        residual[:, 3:] = Rotation.from_matrix(difference).as_rotvec()
    return view, residual, known


@dataclass(frozen=True, eq=False)
class PosePart:
    """Holds one sensor's prediction and residual."""

    view: PoseView
    residual: Array  # (n, 6), measured less predicted: m, and rad along the tracker's axes
    weight: Array  # (n,), square root of what a pose counts
    noise: PoseNoise
    blocks: Integers  # (n,)
    places: Integers  # (n,)

    @cached_property
    def white(self) -> Array:
        """Return residuals in units of their spread, weighted, shape (n, 6)."""
        return self.weight[:, None] * self.noise.whitened(self.residual, self.view.velocity)

    @property
    def used(self) -> Booleans:
        """Return a mask (n,) of the poses that have a weight."""
        return self.weight > 0

    @property
    def count(self) -> int:
        """Return the number of values that have a weight, six a pose."""
        return 6 * int(np.count_nonzero(self.used))


@dataclass(frozen=True, eq=False)
class Sensing(PosePart):
    """Holds what one sensor shows once the frames and effects are fitted."""

    out: Booleans  # (n,), poses that have a reference and stand out
    stamp_gain: float  # minus twice the log likelihood that an error of the stamps takes off


@dataclass(frozen=True, eq=False)
class PoseResiduals:
    """Holds a session and what its fit leaves, by which some effects are seen without a fit."""

    session: PoseSession
    setting: PoseSetting
    sensors: tuple[Sensing, ...]


@dataclass(frozen=True)
class PoseState(JointState[PoseTerm, PosePart]):
    """Holds a problem of poses with a list of active terms."""

    problem: PoseProblem
    folds: ClassVar[int] = FOLDS

    @property
    def numbers(self) -> Integers:
        """Return the numbers of the blocks."""
        return np.unique(np.concatenate([part.blocks for part in self.parts]))

    @property
    def in_space(self) -> 'PoseState':
        """Return the state with blocks of space in place of those of time."""
        return replace(self, parts=tuple(replace(p, blocks=p.places) for p in self.parts))

    def part(self, sensor: str) -> PosePart:
        """Return the part of a sensor."""
        return next(part for part in self.parts if part.view.sensor == sensor)

    def moved(self, terms: Sequence[PoseTerm]) -> 'PoseState':
        """Return the state of the same problem with other terms."""
        return self.problem.state(terms)

    def rms(self, sensor: str | None = None) -> tuple[float, float]:
        """Return distance (m) and angle (rad), root mean square over the poses that count."""
        chosen = [p.residual[p.used] for p in self.parts if sensor in (None, p.view.sensor)]
        every = np.concatenate(chosen) if chosen else np.zeros((0, 6))
        if not len(every):
            return float('nan'), float('nan')
        squares = np.mean(every**2, axis=0)
        return float(np.sqrt(squares[:3].sum())), float(np.sqrt(squares[3:].sum()))

    def design(self, term: PoseTerm, probe: bool = False) -> list[Array | None]:
        """Return whitened columns of a term, one array (n, 6, q) a sensor."""
        return self._whitened(self._slopes(term))

    def sums_with(self, filter_slopes: bool = False, stamps_exact: bool = False) -> BlockSums:
        """Return normal equations by the slopes of filters, or as if the stamps were exact.

        Time constants of filters, which have no slopes of their own, count by differences, and
        positions alone tell times then, as nobody knows how a tracker takes means of orientations.
        With ``stamps_exact`` the normal equations are the scores' variance without such errors.
        """
        is_filtered = filter_slopes and any(term.role is Role.FILTER for term in self.terms)
        groups = []
        for term in self.terms:
            is_filter = is_filtered and term.role is Role.FILTER
            slopes = self._differences(term) if is_filter else self._slopes(term)
            if is_filtered and (is_filter or term.role.is_clock):
                for slope in slopes:
                    slope[:, 3:] = 0.0
            groups.append(self._whitened(slopes, stamps_exact))
        return block_sums(self.parts, joined(groups), self.numbers)

    def _slopes(self, term: PoseTerm) -> list[Array]:
        """Slopes (n, 6, q) of predicted less measured poses by a term's parameters."""
        found = [term.effect.slopes(term, part.view) for part in self.parts]
        return [
            np.zeros((*part.residual.shape, term.theta.size)) if slope is None else slope
            for part, slope in zip(self.parts, found, strict=True)
        ]

    def _differences(self, term: PoseTerm) -> list[Array]:
        """The same by a filter's time constant, (n, 6, 1)."""
        step = FILTER_STEP * term.theta
        more, less = (
            self.moved([t.with_theta(t.theta + way * step) if t is term else t
                        for t in self.terms]).parts
            for way in (1, -1)
        )  # fmt: skip
        return [
            (b.residual - a.residual)[:, :, None] / (2 * step[0])
            for a, b in zip(more, less, strict=True)
        ]

    def _whitened(self, slopes: Sequence[Array], stamps_exact: bool = False) -> list[Array | None]:
        out: list[Array | None] = []
        for part, slope in zip(self.parts, slopes, strict=True):
            columns = part.noise.whitened(slope, part.view.velocity)
            if stamps_exact:
                columns = part.noise.without_stamps(columns, part.view.velocity)
            out.append(columns * part.weight[:, None, None])
        return out


FINEST_S = 2e-3  # finest step of a poll, s: at 0.5 m/s a finer one moves poses by 0.3 mm rms
ON_STEP = 0.95  # share of the stamps that lie on a grid for it to be one
RATE_SHARE = 0.9
"""Share of the intervals of one step from which it may be the tracker's own rate and no poll's."""
FEWEST_BEATS, ON_BEAT = 4, 0.7
"""Distances between the intervals that are not one step, and the share of them that differ by one
interval at most, from which they are two clocks' beat; poses lost at random make it once in
1000."""
SHARED = 0.05
"""Share of poses under the stamp before from which a grid is a poll's: a tracker repeats none."""


def stamp_step(time: Array) -> float:
    """Return the step, s, that all intervals between stamps are multiples of, or zero."""
    every = np.diff(time)
    steps = every[every > FINEST_S / 2]
    if steps.size < 20:
        return 0.0
    is_shared = np.mean(every == 0) > SHARED
    kinds = np.unique(np.round(steps, 5))
    if kinds.size < 2:
        # One interval alone is a rate and not a grid, unless it holds several poses.
        step = float(np.median(steps))
        return step if is_shared or _is_beat(every, step) else 0.0
    # Intervals differ by whole steps, and are some steps themselves.
    apart = np.diff(kinds)
    apart = apart[apart > FINEST_S]
    base = float(np.percentile(steps, 2))
    trials = [*apart[:1].tolist(), *(base / divisor for divisor in range(1, 9))]
    for trial in trials:
        step = float(trial)
        if step < FINEST_S:
            continue
        counts = np.round(steps / step)
        step = float(np.sum(steps * counts) / np.sum(counts**2))
        counts = np.round(steps / step)
        off = np.abs(steps - counts * step)
        if np.mean((off < 0.02 * step + 2e-6) & (counts > 0)) > ON_STEP:
            is_rate = np.mean(np.round(every / step) == 1) > RATE_SHARE
            return 0.0 if is_rate and not is_shared and not _is_beat(every, step) else step
    return 0.0


def _is_beat(every: Array, step: float) -> bool:
    """Whether intervals of no step, or of two, come as regularly as those of two clocks do.

    A tracker and its poll are out of step by a little more with each pose, and the next interval
    of another length comes when that is a whole step again. Longer intervals are pauses.
    """
    apart = np.diff(np.flatnonzero(np.isin(np.round(every / step), (0, 2))))
    return apart.size >= FEWEST_BEATS and bool(
        np.mean(np.abs(apart - np.median(apart)) <= 1) > ON_BEAT
    )


NEAR_S, NEAR_STEPS = 0.3, 3.0
"""Poses that are nearer in time, s or usual intervals, differ by noise and not by place."""


def jitter(part: PosePart, used: Booleans, is_stamped: bool) -> tuple[Array, Array]:
    """Return squared noise (n,) of used poses beside near neighbours, and distances (n, 3).

    Squares are m^2, a coordinate; the distances, m, are those of the pose before, of the pose and
    of the one after it. Second differences of the residual across the velocity, so that neither a
    slow course nor an error of the stamps, where ``is_stamped``, is in it.
    """
    rows = np.flatnonzero(used)
    time, velocity = part.view.time[rows], part.view.velocity[rows, :3]
    residual = part.residual[rows, :3]
    if rows.size < 3:
        return np.zeros(0), np.zeros((0, 3))
    along = velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9)
    if is_stamped:
        # Neighbours move another way, and errors of their stamps lie along theirs. What is the
        # same everywhere would change with the direction that is taken out of it.
        residual = _across(residual - np.median(residual, axis=0), along)
    second = residual[1:-1] - 0.5 * (residual[:-2] + residual[2:])
    second = _across(second, along[1:-1])
    usual = float(np.median(np.diff(time)))
    near = time[2:] - time[:-2] < max(NEAR_S, NEAR_STEPS * usual)
    free = 3 - np.sum(along[1:-1] ** 2, axis=1)  # two, or three coordinates at rest
    square = np.sum(second**2, axis=1) / (1.5 * free)
    distance = np.linalg.norm(part.view.measured[rows], axis=1)
    about = np.stack([distance[:-2], distance[1:-1], distance[2:]], axis=1)
    return square[near], about[near]


RANGES = 3  # groups of a sensor's poses by their distance, as a data sheet has them


def noise_table(state: PoseState) -> list[dict[str, Any]]:
    """Return the noise of each sensor by its distance from the field generator, and by speed.

    Of a coordinate, between neighbours: in m for poses slower and faster than ``speed_m_s``, the
    median speed, and in rad; None where there are too few.
    """
    parts = [part for part in state.parts if part.used.any()]
    speeds = [np.linalg.norm(part.view.velocity[:, :3], axis=1) for part in parts]
    used = [speed[part.used] for speed, part in zip(speeds, parts, strict=True)]
    middle, rows = float(np.median(np.concatenate(used))), []
    for part, speed in zip(parts, speeds, strict=True):
        turned = replace(part, residual=np.roll(part.residual, 3, axis=1))
        far = np.linalg.norm(part.view.measured, axis=1)
        for low, high in pairwise(np.quantile(far[part.used], np.linspace(0, 1, 1 + RANGES))):
            near, row = part.used & (low <= far) & (far <= high), {}
            for key, one, chosen, is_stamped in (
                ('slow_m', part, speed <= middle, part.noise.stamp_s > 0),
                ('fast_m', part, speed > middle, part.noise.stamp_s > 0),
                ('turn_rad', turned, near, False),
            ):
                square = jitter(one, near & chosen, is_stamped)[0]
                row[key] = float(np.sqrt(np.mean(square))) if square.size else None
            place = {'from_m': float(low), 'to_m': float(high), 'speed_m_s': middle}
            rows.append({'sensor': part.view.sensor, **place, **row})
    return rows


def _across(vectors: Array, along: Array) -> Array:
    """Vectors (n, 3) without their part along unit vectors (n, 3)."""
    return np.asarray(vectors - np.sum(vectors * along, axis=1, keepdims=True) * along)


def floor_of(state: PoseState) -> float:
    """Return the distance that jitter alone makes, m, from differences between neighbours."""
    squares = []
    for part in state.parts:
        is_resting = not part.view.velocity.any()  # each recording has an error of its own
        groups = np.unique(part.blocks) if is_resting else (None,)
        rows = [part.used if k is None else part.used & (part.blocks == k) for k in groups]
        square = np.concatenate([jitter(part, r, False)[0] for r in rows])
        noise = part.noise
        along = noise.stamp_s * np.linalg.norm(part.view.velocity[part.used, :3], axis=1)
        if square.size and along.size:
            squares.append(3 * float(np.mean(square)) + float(np.mean(along**2)))
    return float(np.sqrt(np.mean(squares))) if squares else 0.0
