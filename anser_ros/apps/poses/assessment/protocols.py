"""Assesses by protocols, one each: from the poses of recordings to figures with intervals."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.apps.poses.assessment.dynamic import SpeedGroup, assess_motion
from anser_ros.apps.poses.assessment.f2554 import point_to_point, single_point, standing_alone
from anser_ros.apps.poses.assessment.hummel import (
    ORDERS,
    RING_STEP_DEG,
    ROTATION,
    SPACING_M,
    ErrorGroup,
    Grid,
    distance_errors,
    grid_points,
    have_common_errors,
    matching_error,
    rotation_errors,
)
from anser_ros.apps.poses.assessment.intervals import IntervalEstimate
from anser_ros.apps.poses.assessment.source import AssessedPoses
from anser_ros.apps.poses.assessment.stability import AllanCurve, assess_rest, metal_shifts
from anser_ros.apps.poses.assessment.stillness import PauseRule, StillPoint, point_of, still_points
from anser_ros.apps.poses.hand_eye import HandEye, fit_hand_eye
from anser_ros.apps.poses.sequence import PoseSequence
from anser_ros.errors import FitError, ParameterError

Array = NDArray[np.float64]

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
    spacing_m: float = SPACING_M
    step_deg: float = RING_STEP_DEG
    order: str = ORDERS[0]  # one of `ORDERS`: how a board was gone over
    axis: Array | None = None  # (3,), or None, direction of a sensor without roll
    # (n, 3), or None, places of a phantom's points, m; None: the recording's optical reference
    truth: Array | None = None


@dataclass(frozen=True)
class Assessment:
    """Holds what a protocol found."""

    protocol: str
    body: str
    recordings: tuple[str, ...]
    start_ns: int  # stamp at which the first recording begins
    estimates: dict[str, IntervalEstimate]  # figures by name; units are in the names
    # errors of a kind, under MITK's names where it has them
    groups: dict[str, ErrorGroup] = field(default_factory=dict)
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

    Raises
    ------
    ParameterError
        When the protocol takes another number of recordings, or lacks an option.
    FitError
        When the recordings are not what the protocol takes.
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
        return makers[protocol](empty, recordings, options, rng)
    except FitError as error:
        raise FitError(f'{first.session.path}: {error}') from error


def points_of(recordings: Sequence[AssessedPoses], rule: PauseRule) -> list[StillPoint]:
    """Return the points of recordings: the pauses of one, or one of each where there are several.

    Raises
    ------
    FitError
        When no pause is found.
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


def _rest(
    empty: Assessment,
    recordings: Sequence[AssessedPoses],
    options: ProtocolOptions,
    rng: np.random.Generator,
) -> Assessment:
    found = assess_rest(recordings[0].poses)
    notes = []
    if found.even_share < EVEN_ENOUGH:
        notes.append(
            'poses are missing: the Allan deviation is that of the longest stretch without a '
            f'gap, {found.even_share:.0%} of the poses'
        )
    if found.estimates['position_jitter_rms_m'].value < STUCK_M:
        notes.append('the position never changes at all: is the sensor stuck?')
    return replace(empty, estimates=found.estimates, allan=found.allan, notes=tuple(notes))


def _grid(
    empty: Assessment,
    recordings: Sequence[AssessedPoses],
    options: ProtocolOptions,
    rng: np.random.Generator,
) -> Assessment:
    points = points_of(recordings, options.pause)
    grid = Grid.of(len(points), options.grid, options.spacing_m)
    place = grid_points(points, grid, options.order)
    estimates = {
        'grid_matching_fre_m': IntervalEstimate(matching_error(place, grid)),
        'point_jitter_rms_m': _jitter(points),
    }
    notes: tuple[str, ...] = ()
    if have_common_errors(place, grid):
        notes = (
            'neighbouring lines of holes seem to have the same error, as in a distorted field: '
            'intervals come from thirds of the board, and are wide',
        )
    groups = distance_errors(place, grid, rng)
    return replace(empty, estimates=estimates, groups=groups, points=tuple(points), notes=notes)


def _jitter(points: Sequence[StillPoint]) -> IntervalEstimate:
    return IntervalEstimate(float(np.sqrt(np.mean([p.jitter_m**2 for p in points]))))


def _rotation(
    empty: Assessment,
    recordings: Sequence[AssessedPoses],
    options: ProtocolOptions,
    rng: np.random.Generator,
) -> Assessment:
    points = points_of(recordings, options.pause)
    group = rotation_errors(points, options.step_deg, options.axis, rng)
    place = np.array([p.position for p in points])
    estimates = {
        # The ring turns the sensor about a place that hardly moves: how far it seems to.
        'position_spread_rms_m': IntervalEstimate(
            float(np.sqrt(np.mean(np.sum((place - place.mean(axis=0)) ** 2, axis=1))))
        ),
        'point_jitter_rms_m': _jitter(points),
    }
    return replace(empty, estimates=estimates, groups={ROTATION: group}, points=tuple(points))


def _metal(
    empty: Assessment,
    recordings: Sequence[AssessedPoses],
    options: ProtocolOptions,
    rng: np.random.Generator,
) -> Assessment:
    names = [f'{k}' for k in range(1, len(recordings))]
    others = [(n, r.poses) for n, r in zip(names, recordings[1:], strict=True)]
    shifts = metal_shifts(recordings[0].poses, others)
    notes = [f'{n} is {r.session.path}' for n, r in zip(names, recordings[1:], strict=True)]
    return replace(empty, estimates=shifts, notes=tuple(notes))


def _single_point(
    empty: Assessment,
    recordings: Sequence[AssessedPoses],
    options: ProtocolOptions,
    rng: np.random.Generator,
) -> Assessment:
    group, estimates = single_point(recordings[0].poses, rng)
    return replace(empty, estimates=estimates, groups={'single point deviations': group})


def _point_to_point(
    empty: Assessment,
    recordings: Sequence[AssessedPoses],
    options: ProtocolOptions,
    rng: np.random.Generator,
) -> Assessment:
    true, notes = options.truth, []
    if true is None:
        first = recordings[0]
        if len(recordings) > 1 or first.session.reference is None:
            raise ParameterError(
                'point-to-point needs the true points: --truth FILE.csv, or one recording with '
                'an optical reference'
            )
        found = fit_hand_eye(first.session)
        # As they are meant, where units or quaternions say something else.
        recordings = [replace(first, poses=found.session.sensors[first.poses.name])]
        points = points_of(recordings, options.pause)
        true = _optical_points(found, recordings[0].poses, points)
        notes.append(
            'the truth is the optical reference, whose own error is included in the figures'
        )
    else:
        points = points_of(recordings, options.pause)
    group, estimates = point_to_point(points, true, rng)
    alone = standing_alone(np.array([p.position for p in points]), true)
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
    problem = found.fit.state.problem
    same = np.zeros(poses.size, dtype=np.int64)
    every = replace(
        problem, sensors=(poses,), blocks=(same,), places=(same,), weight=(np.ones(poses.size),),
        noise=problem.noise[:1],
    )  # fmt: skip
    part = every.state(found.fit.terms).parts[0]
    places = []
    for point in points:
        inside = (poses.time >= point.begin_s) & (poses.time <= point.end_s) & part.used
        if not inside.any():
            raise FitError(
                f'the reference does not see the tool in the pause at {point.begin_s:.1f} s'
            )
        places.append(np.median(part.view.position[inside], axis=0))
    return np.array(places)


def _dynamic(
    empty: Assessment,
    recordings: Sequence[AssessedPoses],
    options: ProtocolOptions,
    rng: np.random.Generator,
) -> Assessment:
    session = recordings[0].session
    if session.reference is None:
        raise ParameterError('dynamic needs a moving reference: a bag with optical poses')
    found = fit_hand_eye(session)
    motion = assess_motion(found, recordings[0].poses.name, rng)
    notes = (
        'latency is measured against the reference and its clock, and includes the latency of '
        'the reference',
    )
    return replace(empty, estimates=motion.estimates, speeds=motion.groups, notes=notes)
