"""Finds in which order, sense and unit poses were written, where they do not fit as they stand."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses import start
from anser_ros.apps.poses.effect import PoseTerm, Role, effect_with
from anser_ros.apps.poses.problem import PoseProblem
from anser_ros.apps.poses.sequence import REFERENCE, PoseSequence, PoseSession
from anser_ros.arrays import Array
from anser_ros.errors import DiagnosisError, PlausibilityError
from anser_ros.field.model import EffectRecord
from anser_ros.sessions.plausibility import check_positions
from anser_ros.wire.table_names import LENGTH_M

POOR_M = 8e-3
"""Median misfit of hand-eye, m and tenths of rad together, from which other readings are tried:
distorted trackers are off by less, and the inverse of a quaternion makes 25 mm and more."""
RIGHT_MISFIT_SHARE = 0.5
"""Share (0 to 1) of the misfit as it stands below which another reading is the right one: the
right one of a distorted tracker leaves a third of a wrong one (`POOR_M`)."""
TURNS_SHARE, TURNED_SHARE = 0.8, 0.7
"""Shares of the misfit of turns alone, and of hand-eye, below which quaternions are in another
order although places fit: recordings that were read wrongly left 0.57 to 0.69 and 0.43 to 0.51."""
FEW_POSES = 150  # poses of a sensor that a reading is judged by, a fit each: a median needs few
HOPELESS_M = 25e-3
"""Median misfit, m, at which a session is refused: a wrong reading makes as much (`POOR_M`)."""
CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])  # of x y z w: the inverse turn
UNITS = {
    **LENGTH_M, 'km': 1e3, 'inch taken for mm': 25.4, 'mm taken for inch': 1 / 25.4,
}  # fmt: skip
"""What a unit of the numbers is in m when they are taken for m, or for what is said."""
NEAR_UNIT = 0.12  # relative error of a scale that a unit explains; lever arms make as much
SAME_SCALE = (0.75, 1.35)  # scales that need no unit: no two units are nearer than 2.5


@dataclass(frozen=True)
class PoseReading:
    """Describes one way to read a stream's numbers, in the terms of `docs/interfaces.md`."""

    stream: str = 'tracked'
    quaternion: str = 'xyzw'
    handedness: str = 'right'
    unit: str = 'm'

    @property
    def is_plain(self) -> bool:
        """Return whether the numbers are what they say."""
        return (self.quaternion, self.handedness, self.unit) == ('xyzw', 'right', 'm')

    def record(self, before: float, after: float, ratio: float) -> EffectRecord:
        """Return the reading as an effect.

        ``before`` and ``after``: misfits, m, without and with it; ``ratio``: extent of the tracked
        positions over that of the optical ones, as both are written.
        """
        effect = effect_with(Role.READING)
        evidence = {'misfit_as_written_m': before, 'misfit_so_read_m': after,
                    'extent_ratio': ratio, **effect.words}  # fmt: skip
        return EffectRecord(effect.name, dict(vars(self)), {}, evidence)

    def applied(self, session: PoseSession) -> PoseSession:
        """Return the session with its numbers read in this convention."""
        if self.stream == REFERENCE:
            assert session.reference is not None
            return replace(session, reference=self.of_sequence(session.reference))
        return replace(
            session, sensors={n: self.of_sequence(s) for n, s in session.sensors.items()}
        )

    def of_sequence(self, poses: PoseSequence) -> PoseSequence:
        """Return the poses of one stream, read in this convention."""
        turn, place = poses.quaternion, poses.position * UNITS.get(self.unit, 1.0)
        if self.quaternion.startswith('wxyz'):
            turn = turn[:, [1, 2, 3, 0]]
        if self.quaternion.endswith('conjugate'):
            turn = turn * CONJUGATE
        if self.handedness == 'left':  # the z axis points the other way
            place = place * np.array([1.0, 1.0, -1.0])
            turn = turn * np.array([-1.0, -1.0, 1.0, 1.0])
        return replace(poses, position=place, quaternion=turn)


def read_rightly(session: PoseSession) -> tuple[PoseSession, EffectRecord | None]:
    """Return the session as it is meant, and the convention by which it is, if that is another.

    Raises `PlausibilityError` when hand-eye fits in no reading, or the reference itself is in
    another unit; `DiagnosisError` when there are too few poses.
    """
    if session.reference is None:
        return session, None
    if not session.reference.size:
        lost = session.reference.missing.size
        raise DiagnosisError(f'{session.path}: no pose of the reference, {lost} missing')
    check_positions(f'{session.path}: the reference', session.reference.position)
    ratio = _extent_ratio(session)
    unit = _unit(ratio)
    plain = PoseReading(unit=unit)
    as_written = plain.applied(session)
    clock = start.coarse_clock(_few(as_written))  # which no reading of the tracked poses changes
    cost = _cost(as_written, clock)
    record = None if plain.is_plain else plain.record(np.inf, cost, ratio)
    is_turned = cost < POOR_M and _is_turned(as_written, clock)
    if cost < POOR_M and not is_turned:
        return as_written, record
    trials = [
        (_cost(reading.applied(session), None if reading.stream == REFERENCE else clock), reading)
        for reading in _readings(unit)
    ]
    best, reading = min(trials, key=lambda pair: pair[0])
    if best < (TURNED_SHARE if is_turned else RIGHT_MISFIT_SHARE) * cost:
        return reading.applied(session), reading.record(cost, best, ratio)
    if cost > HOPELESS_M:
        reach = start.longest_recording(start.pose_problem(session))
        raise PlausibilityError(
            f'{session.path}: tracked and optical poses do not belong together: hand-eye is off '
            f'by {1e3 * cost:.0f} mm in the median at the best offset of their clocks, up to '
            f'{reach:.0f} s, and by {1e3 * best:.0f} mm when quaternions are read in another '
            'order or sense; are they of one body at the same time?'
        )
    return as_written, record


def reading_words(record: EffectRecord) -> str:
    """Return how a stream was read if it means something else than it says, with the evidence."""
    read, evidence = record.parameters, record.evidence
    words = []
    if read['unit'] != 'm':
        words.append(
            f'positions in {read["unit"]}, as they extend {evidence["extent_ratio"]:.3g} times as '
            "far as the reference's"
        )
    if read['quaternion'] != 'xyzw':
        words.append(f'quaternions as {read["quaternion"].replace("_", ", ")}')
    if read['handedness'] != 'right':
        words.append('left-handed')
    before = evidence['misfit_as_written_m']
    if np.isfinite(before):
        words.append(
            f'hand-eye is off by {1e3 * evidence["misfit_so_read_m"]:.1f} mm so, '
            f'and by {1e3 * before:.0f} mm as written'
        )
    stream = read['stream']
    return f'the {stream} poses are read in another convention than stated: {"; ".join(words)}'


def _readings(unit: str) -> Iterator[PoseReading]:
    orders = ('xyzw', 'wxyz', 'conjugate', 'wxyz_conjugate')
    every = product(('tracked', REFERENCE), orders, ('right', 'left'))
    for stream, quaternion, handedness in every:
        is_as_written = (quaternion, handedness) == ('xyzw', 'right')
        if not is_as_written and (stream == 'tracked' or unit == 'm'):
            yield PoseReading(stream, quaternion, handedness, unit)


def _few(session: PoseSession) -> PoseProblem:
    problem = start.pose_problem(session)
    step = max(1, max(poses.size for poses in problem.sensors) // FEW_POSES)
    return problem.rows([np.arange(0, poses.size, step) for poses in problem.sensors])


def _cost(session: PoseSession, clock: Sequence[PoseTerm] | None) -> float:
    problem = _few(session)
    return start.first_cost(start.first_fit(problem, clock or start.coarse_clock(problem), False))


def _is_turned(session: PoseSession, clock: Sequence[PoseTerm]) -> bool:
    """Whether turns fit better if those of the tracker are read in the other sense.

    Half of all orders and senses fit alike: a turn of quaternions makes them of each other, and
    the other half is their mirror image.
    """
    problem, misfits = start.pose_problem(session), []
    for poses in problem.sensors:
        _, turn, _, known = problem.path.at(start.times_by(clock, poses))
        optical = Rotation.from_matrix(turn[known]).as_quat()
        tracked = poses.quaternion[known]
        if len(tracked):
            misfits.append([start.turn_misfit(t, optical) for t in (tracked, tracked * CONJUGATE)])
    as_written, other = np.mean(misfits, axis=0) if misfits else (0.0, 0.0)
    return bool(other < TURNS_SHARE * as_written)


def _extent_ratio(session: PoseSession) -> float:
    """Extent of the tracked positions over that of the optical ones at the same times."""
    problem = start.pose_problem(session)
    if session.reference is not None and start.is_at_rest(session.reference):
        return 1.0  # of noise, which tells no unit
    ratios = []
    for poses in problem.sensors:
        place, _, _, known = problem.path.at(poses.time)
        ratios.append(_extent(poses.position[known]) / max(_extent(place[known]), 1e-9))
    return float(np.median(ratios))


def _unit(ratio: float) -> str:
    """The unit that such a ratio of extents means."""
    if SAME_SCALE[0] < ratio < SAME_SCALE[1]:
        return 'm'
    for unit, size in UNITS.items():
        if abs(np.log(ratio * size)) < np.log(1 + NEAR_UNIT):
            return unit
    return 'm'


def _extent(place: Array) -> float:
    """Robust extent of places: the median distance of each from the median place."""
    return float(np.median(np.linalg.norm(place - np.median(place, axis=0), axis=1)))
