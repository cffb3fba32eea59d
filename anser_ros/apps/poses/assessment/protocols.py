"""Assesses by protocols, one each: from the poses of recordings to figures with intervals."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from anser_ros.apps.poses.assessment import distances, intervals
from anser_ros.apps.poses.assessment.rest import (
    AllanCurve,
    PauseRule,
    StillPoint,
    assess_rest,
    metal_shifts,
    point_of,
    still_points,
)
from anser_ros.apps.poses.assessment.source import AssessedPoses
from anser_ros.apps.poses.hand_eye import HandEye, fit_hand_eye
from anser_ros.apps.poses.problem import predicted
from anser_ros.apps.poses.sequence import PoseSequence
from anser_ros.arrays import Array
from anser_ros.errors import FitError, ParameterError

GROUPS = 5  # groups of speeds, with equal numbers of poses: a row of the table each
FEWEST_MOVING_POSES = 100
"""Fewer leave a group less than 20, whose 95th percentile would be one pose."""
SLOWEST_M_S = 0.02
"""Median speed of a rest at most, where a jitter of 0.1 mm is 5 ms of latency."""


@dataclass(frozen=True)
class SpeedGroup:
    """Holds poses of similar speed."""

    speed_low_m_s: float
    speed_high_m_s: float
    speed_mean_m_s: float
    n: int
    error_rms_m: intervals.IntervalEstimate  # with the clocks' offset taken out
    error_live_rms_m: (
        intervals.IntervalEstimate
    )  # of poses that are taken for those of their stamps
    latency_s: intervals.IntervalEstimate  # against the reference, the common offset included


def assess_motion(
    found: HandEye, sensor: str, rng: np.random.Generator
) -> tuple[dict[str, intervals.IntervalEstimate], tuple[SpeedGroup, ...]]:
    """Return figures of a moving sensor whose frames and clocks are known, and the same by speed.

    A late pose is where the tool was, back along its velocity: the error along the velocity over
    the speed is the latency that remains beside the common offset. Raises `FitError` when there
    are too few poses, or the tool hardly moved.
    """
    part = found.fit.state.part(sensor)
    used = part.used
    if np.count_nonzero(used) < FEWEST_MOVING_POSES:
        raise FitError(
            f'{np.count_nonzero(used)} poses with a reference; {FEWEST_MOVING_POSES} are needed'
        )
    rest, velocity = part.residual[used, :3], part.view.velocity[used, :3]
    speed = np.linalg.norm(velocity, axis=1)
    if float(np.median(speed)) < SLOWEST_M_S or found.offset_s is None:
        raise FitError(
            f'the median speed of the tool was {1e3 * np.median(speed):.0f} mm/s; move it at '
            f'{1e3 * SLOWEST_M_S:.0f} mm/s or more, at several speeds'
        )
    offset, sigma = found.offset_s
    error = np.linalg.norm(rest, axis=1)
    error_live = np.linalg.norm(rest - offset * velocity, axis=1)
    clusters = intervals.blocks_of_time(part.view.time[used])
    edges = np.quantile(speed, np.linspace(0, 1, GROUPS + 1))
    groups = []
    for k in range(GROUPS):
        inside = (speed >= edges[k]) & ((speed < edges[k + 1]) | (k == GROUPS - 1))
        weights = intervals.cluster_weights(clusters[inside], rng)
        count = int(np.unique(clusters[inside]).size)
        late = _latency(rest[inside], velocity[inside], weights, offset, sigma)
        groups.append(
            SpeedGroup(
                float(edges[k]), float(edges[k + 1]), float(speed[inside].mean()),
                int(inside.sum()), intervals.summarised(error[inside], weights, count)['RMS'],
                intervals.summarised(error_live[inside], weights, count)['RMS'], late,
            )
        )  # fmt: skip
    weights = intervals.cluster_weights(clusters, rng)
    whole = intervals.summarised(error, weights, intervals.BLOCKS)
    estimates = {
        'dynamic_error_rms_m': whole['RMS'],
        'dynamic_error_prc95_m': whole['P95'],
        'dynamic_error_live_rms_m': intervals.summarised(error_live, weights, intervals.BLOCKS)[
            'RMS'
        ],
        'latency_s': _latency(rest, velocity, weights, offset, sigma),
        'speed_prc95_m_s': intervals.IntervalEstimate(float(np.percentile(speed, 95))),
    }
    return estimates, tuple(groups)


def _latency(
    rest: Array, velocity: Array, weights: Array, offset: float, sigma: float
) -> intervals.IntervalEstimate:
    """The offset and what is left beside it, s, with the offset's own uncertainty."""
    along, square = np.sum(rest * velocity, axis=1), np.sum(velocity**2, axis=1)
    value = offset - float(along.sum() / max(square.sum(), 1e-300))
    drawn = offset - (weights @ along) / np.maximum(weights @ square, 1e-300)
    low, high = np.quantile(drawn, [0.5 - intervals.LEVEL / 2, 0.5 + intervals.LEVEL / 2])
    wide = 1.96 * sigma
    return intervals.IntervalEstimate(
        value,
        value - float(np.hypot(value - low, wide)),
        value + float(np.hypot(high - value, wide)),
    )


EVEN_ENOUGH = 0.9
"""Share of poses in the longest evenly spaced stretch below which it is said that poses lack."""
STUCK_M = 1e-12
"""Jitter, m, that only the rounding of numbers has."""


@dataclass(frozen=True)
class ProtocolOptions:
    """Holds what a protocol is given besides its recordings."""

    pause: PauseRule = field(default_factory=PauseRule)  # what is a point
    # rows and columns of a board that is not one of the protocol's
    grid: tuple[int, int] | None = None
    # of the board's holes, and of the ring's
    spacing_m: float = distances.SPACING_M
    step_deg: float = distances.RING_STEP_DEG
    order: str = distances.ORDERS[0]  # one of `ORDERS`: how a board was gone over
    axis: Array | None = None  # (3,), or None, direction of a sensor without roll
    # (n, 3), or None, places of a phantom's points, m; None: the recording's optical reference
    truth: Array | None = None


class _Given(NamedTuple):
    """What a protocol is carried out on."""

    recordings: Sequence[AssessedPoses]
    options: ProtocolOptions
    rng: np.random.Generator

    @property
    def points(self) -> list[StillPoint]:
        """Pauses of the recording, or one of each where there are several."""
        return points_of(self.recordings, self.options.pause)


@dataclass(frozen=True)
class Assessment:
    """Holds what a protocol found."""

    protocol: str
    body: str
    recordings: tuple[str, ...]
    start_ns: int  # stamp at which the first recording begins
    estimates: dict[str, intervals.IntervalEstimate]  # figures by name; units are in the names
    # errors of a kind, under MITK's names where it has them
    groups: dict[str, distances.ErrorGroup] = field(default_factory=dict)
    points: tuple[StillPoint, ...] = ()
    allan: dict[str, AllanCurve] = field(default_factory=dict)
    speeds: tuple[SpeedGroup, ...] = ()
    notes: tuple[str, ...] = ()  # what a reader must know of the figures


PROTOCOLS = {
    'rest': 'a tool left alone: jitter, drift, Allan deviation',
    'grid': "Hummel's board: 5, 15, 30 cm and accumulated distances",
    'rotation': "Hummel's ring: turns from hole to hole",
    'metal': "Hummel's rods: shift of a tool at rest; the first recording is without metal",
    'single-point': 'ASTM F2554: readings of one location while the tool tilts about it',
    'point-to-point': 'ASTM F2554: distances between the points of a phantom',
    'dynamic': 'a moving tool against a moving reference: error and latency by speed',
}
"""Every protocol with what it takes."""
WATCHED = {
    'rest': ('position_jitter_rms_m', 'orientation_jitter_rms_rad'),
    'grid': ('grid_matching_fre_m', '/Mean'),
    'rotation': ('/Mean',),
    'metal': ('position_shift',),
    'single-point': ('/RMS',),
    'point-to-point': ('/RMS',),
    'dynamic': ('dynamic_error_rms_m', 'latency_s'),
}
"""Figures, or beginnings or endings of their names, that have control limits: the more, the wider
all limits must be for sessions in order to pass."""
ONE = ('rest', 'single-point', 'dynamic')
"""Protocols of a single recording."""


def assess(
    protocol: str,
    recordings: Sequence[AssessedPoses],
    options: ProtocolOptions,
    rng: np.random.Generator,
) -> Assessment:
    """Assess recordings by a protocol.

    Raises `ParameterError` when the protocol takes another number of recordings, or lacks an
    option, `FitError` when the recordings are not what it takes.
    """
    first = recordings[0]
    if protocol in ONE and len(recordings) > 1:
        raise ParameterError(f'{protocol} takes one recording, got {len(recordings)}')
    if protocol == 'metal' and len(recordings) < 2:
        raise ParameterError('metal takes the recording without metal first, then those with it')
    empty = Assessment(
        protocol, first.name, tuple(r.session.path for r in recordings), first.session.start_ns, {}
    )
    makers = {
        'rest': _rest, 'grid': _grid, 'rotation': _rotation, 'metal': _metal,
        'single-point': _single_point, 'point-to-point': _point_to_point, 'dynamic': _dynamic,
    }  # fmt: skip
    try:
        return makers[protocol](empty, _Given(recordings, options, rng))
    except FitError as error:
        raise FitError(f'{first.session.path}: {error}') from error


def points_of(recordings: Sequence[AssessedPoses], rule: PauseRule) -> list[StillPoint]:
    """Return the points of recordings: the pauses of one, or one of each where there are several.

    Raises `FitError` when no pause is found.
    """
    if len(recordings) > 1:
        found = []
        for one in recordings:
            pauses = still_points(one.poses, rule)
            longest = max(pauses, key=lambda p: p.n, default=None)
            found.append(longest or point_of(one.poses))
        return found
    pauses = still_points(recordings[0].poses, rule)
    if not pauses:
        raise FitError(
            f'no pause of {rule.least_s:g} s was found; rest longer on each point, set '
            '--pause-s, or give one recording per point'
        )
    return pauses


def _rest(empty: Assessment, given: _Given) -> Assessment:
    estimates, allan, even_share = assess_rest(given.recordings[0].poses)
    notes = []
    if even_share < EVEN_ENOUGH:
        notes.append(
            'poses are missing: the Allan deviation is that of the longest stretch without a '
            f'gap, {even_share:.0%} of the poses'
        )
    if estimates['position_jitter_rms_m'].value < STUCK_M:
        notes.append('the position never changes at all: is the sensor stuck?')
    return replace(empty, estimates=estimates, allan=allan, notes=tuple(notes))


def _grid(empty: Assessment, given: _Given) -> Assessment:
    points = given.points
    grid = distances.Grid.of(len(points), given.options.grid, given.options.spacing_m)
    place = distances.grid_points(points, grid, given.options.order)
    estimates = {
        'grid_matching_fre_m': intervals.IntervalEstimate(distances.matching_error(place, grid)),
        'point_jitter_rms_m': _jitter(points),
    }
    notes: tuple[str, ...] = ()
    if distances.have_common_errors(place, grid):
        notes = (
            'neighbouring lines of holes seem to have the same error, as in a distorted field: '
            'intervals come from thirds of the board, and are wide',
        )
    groups = distances.distance_errors(place, grid, given.rng)
    return replace(empty, estimates=estimates, groups=groups, points=tuple(points), notes=notes)


def _jitter(points: Sequence[StillPoint]) -> intervals.IntervalEstimate:
    return intervals.IntervalEstimate(float(np.sqrt(np.mean([p.jitter_m**2 for p in points]))))


def _rotation(empty: Assessment, given: _Given) -> Assessment:
    points = given.points
    group = distances.rotation_errors(
        points, given.options.step_deg, given.options.axis, given.rng
    )
    place = np.array([p.position for p in points])
    estimates = {
        # The ring turns the sensor about a place that hardly moves: how far it seems to.
        'position_spread_rms_m': intervals.IntervalEstimate(
            float(np.sqrt(np.mean(np.sum((place - place.mean(axis=0)) ** 2, axis=1))))
        ),
        'point_jitter_rms_m': _jitter(points),
    }
    return replace(
        empty, estimates=estimates, groups={distances.ROTATION: group}, points=tuple(points)
    )


def _metal(empty: Assessment, given: _Given) -> Assessment:
    base, *others = given.recordings
    shifts = metal_shifts(base.poses, [one.poses for one in others])
    notes = tuple(f'{k} is {one.session.path}' for k, one in enumerate(others, start=1))
    return replace(empty, estimates=shifts, notes=notes)


def _single_point(empty: Assessment, given: _Given) -> Assessment:
    group, estimates = distances.single_point(given.recordings[0].poses, given.rng)
    return replace(empty, estimates=estimates, groups={'single point deviations': group})


def _point_to_point(empty: Assessment, given: _Given) -> Assessment:
    true, notes = given.options.truth, []
    if true is None:
        first = given.recordings[0]
        if len(given.recordings) > 1 or first.session.reference is None:
            raise ParameterError(
                'point-to-point needs the true points: --truth FILE.csv, or one recording with '
                'an optical reference'
            )
        found = fit_hand_eye(first.session)
        # As they are meant, where units or quaternions say something else.
        poses = found.session.sensors[first.poses.name]
        points = points_of([replace(first, poses=poses)], given.options.pause)
        true = _optical_points(found, poses, points)
        notes.append(
            'the truth is the optical reference, whose own error is included in the figures'
        )
    else:
        points = given.points
    group, estimates = distances.point_to_point(points, true, given.rng)
    alone = distances.standing_alone(np.array([p.position for p in points]), true)
    if alone is not None:
        number, before, after = alone
        notes.append(
            f'point {number + 1} stands out: a rigid fit leaves {1e3 * before:.2f} mm with it and '
            f'{1e3 * after:.2f} mm without'
        )
    return replace(
        empty,
        estimates={**estimates, 'point_jitter_rms_m': _jitter(points)},
        groups={'point to point distance errors': group},
        points=tuple(points),
        notes=tuple(notes),
    )


def _optical_points(found: HandEye, poses: PoseSequence, points: Sequence[StillPoint]) -> Array:
    """Where the optical reference puts the sensor in each pause, m, tracker's frame."""
    view, _, known = predicted(found.fit.state.problem.path, poses, found.fit.terms)
    places = []
    for point in points:
        inside = (poses.time >= point.begin_s) & (poses.time <= point.end_s) & known
        if not inside.any():
            raise FitError(
                f'the reference does not see the tool in the pause at {point.begin_s:.1f} s'
            )
        places.append(np.median(view.position[inside], axis=0))
    return np.array(places)


def _dynamic(empty: Assessment, given: _Given) -> Assessment:
    session = given.recordings[0].session
    if session.reference is None:
        raise ParameterError('dynamic needs a moving reference: a bag with optical poses')
    found = fit_hand_eye(session)
    estimates, speeds = assess_motion(found, given.recordings[0].poses.name, given.rng)
    notes = (
        'latency is measured against the reference and its clock, and includes the latency of '
        'the reference',
    )
    return replace(empty, estimates=estimates, speeds=speeds, notes=notes)
