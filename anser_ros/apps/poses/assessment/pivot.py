"""Finds a stylus' tip from poses while it turns about a point that its tip rests on.

Of each pose ``p + R t = c`` holds, with the tip ``t`` in the body's frame and the point ``c`` in
the tracker's: the algebraic one-step form of Yaniv (Proc. SPIE 9415, 2015), solved here on the
poses that a random sample consensus (Fischler and Bolles, 1981) finds to agree, and corrected for
what noise of the rotations takes off the arm.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.assessment.intervals import blocks_of_time
from anser_ros.apps.poses.fit import turn_jitter
from anser_ros.apps.poses.sequence import PoseSequence
from anser_ros.arrays import Array, Booleans
from anser_ros.errors import FitError

Mask = Booleans

FEWEST_PIVOT_POSES = 30  # poses without which nothing is said; at 20 Hz a second and a half
MOST_POSES = 3000  # poses that take part, evenly over the recording; more add nothing new
DRAWS = 300
"""Samples drawn: with half of the poses wrong, one in sixteen has four right ones."""
SAMPLE = 4  # poses of a sample; three turns about two axes already determine tip and point
SCORED = 400  # poses that a sample is judged by: their median distance is good to 3 %
MEDIAN_SIZE = 1.538
"""Median length of a vector of three normal coordinates over their standard deviation."""
CUT = 4.0
"""Distance, in standard deviations of a coordinate, from which a pose is not one of the pivot:
of normal errors one in nine hundred."""
AGREEMENT_ROUNDS = 8
"""Refits while the poses that agree still change: an end where two sets alternate."""
LEAST_AGREEING = 0.5
"""Share of poses that must agree. With fewer, the tip rested on two places or on none."""
LEAST_TILT_DEG = 8.0
"""Root mean square of the turns that move a direction of the body, degrees, below which the tip's
place along it is refused: noise and distortions then decide on it."""
TWO_AXES = 0.25
"""Share of the middle tilt below which the least one is called turning about a single axis."""
SMALLEST_SIGMA_M = 1e-7  # of a coordinate; simulated poses without noise have no scale


@dataclass(frozen=True)
class PivotLimits:
    """Holds bounds from which on a pivot calibration is refused."""

    sigma_m: float = 1e-3  # largest standard deviation of the tip along any direction, m
    # largest root mean square distance of the poses that agree from one point, m
    rms_m: float = 3e-3


@dataclass(frozen=True)
class PivotFit:
    """Holds a tip, and how well it is known."""

    tip: Array  # (3,), m, body's frame
    # (3, 3), of the tip, m^2, body's frame; errors alike within a stretch of time count once
    covariance: Array
    point: Array  # (3,), what the tip rested on, m, tracker's frame
    point_covariance: Array  # (3, 3), m^2, tracker's frame
    # (n,), stamps of the poses that took part, s, and how far each puts the tip from the point, m
    time: Array
    distance: Array
    agrees: Mask  # (n,), the poses that agree on the tip
    rms_m: float  # root mean square distance of those
    tilt_deg: Array  # (3,), root mean square turn of the body's x, y and z direction, degrees

    @property
    def sigma(self) -> Array:
        """Return the standard deviations of the tip, m, shape (3,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def fit_pivot(
    poses: PoseSequence, rng: np.random.Generator, limits: PivotLimits | None = None
) -> PivotFit:
    """Find the tip from poses, in the order of time, while it rests on a point.

    Raises `FitError` when there are too few poses, they don't turn about one point, or their
    motion leaves a direction undetermined; it says which motion is missing.
    """
    limits = limits or PivotLimits()
    fresh = poses.rows(~poses.repeated)
    if fresh.size < FEWEST_PIVOT_POSES:
        raise FitError(
            f'a pivot calibration needs at least {FEWEST_PIVOT_POSES} different poses, better 500 '
            f'over 20 s; got {fresh.size}'
        )
    jitter = turn_jitter(fresh)
    chosen = fresh.rows(np.linspace(0, fresh.size - 1, min(fresh.size, MOST_POSES)).astype(int))
    place, turn = chosen.position, chosen.rotation
    _refuse_poor_motion(turn, np.ones(chosen.size, dtype=bool))
    agrees = _consensus(place, turn, rng)
    share = float(np.mean(agrees))
    tip, point, inverse = _solved(place[agrees], turn[agrees], jitter)
    distance = _distances(place, turn, tip, point)
    rms = float(np.sqrt(np.mean(distance[agrees] ** 2)))
    if share < LEAST_AGREEING:
        raise FitError(
            f'only {share:.0%} of the poses agree on one tip: it slipped, or rested on several '
            'places; record again with the tip in one dimple'
        )
    if rms > limits.rms_m:
        raise FitError(
            'the poses do not turn about one point: they miss the best point by '
            f'{1e3 * rms:.1f} mm (rms, at most {1e3 * limits.rms_m:.1f}); keep the tip in a '
            'dimple while the tool tilts'
        )
    tilt = _refuse_poor_motion(turn, agrees)
    covariance = _covariance(place, turn, chosen.time, agrees, tip, point, inverse)
    values, vectors = np.linalg.eigh(covariance[:3, :3])
    if np.sqrt(values[-1]) > limits.sigma_m:
        raise FitError(
            f'the tip is known to {1e3 * np.sqrt(values[-1]):.2f} mm only along '
            f'{_words(vectors[:, -1])} of the body (at most {1e3 * limits.sigma_m:.2f}): record '
            'longer, or tilt wider'
        )
    return PivotFit(
        tip, covariance[:3, :3], point, covariance[3:, 3:], chosen.time, distance, agrees, rms,
        tilt,
    )  # fmt: skip


def _distances(place: Array, turn: Array, tip: Array, point: Array) -> Array:
    return np.asarray(np.linalg.norm(place + turn @ tip - point, axis=1))


def _consensus(place: Array, turn: Array, rng: np.random.Generator) -> Mask:
    """Poses that agree with the sample that most poses are near to."""
    count = len(place)
    best, smallest = (np.zeros(3), place.mean(axis=0)), np.inf
    some = np.linspace(0, count - 1, min(count, SCORED)).astype(int)
    for _ in range(DRAWS):
        rows = rng.choice(count, SAMPLE, replace=False)
        tip, point = _sample(place[rows], turn[rows])
        middle = float(np.median(_distances(place[some], turn[some], tip, point)))
        if middle < smallest:
            best, smallest = (tip, point), middle
    agrees = np.zeros(count, dtype=bool)
    for _ in range(AGREEMENT_ROUNDS):
        distance = _distances(place, turn, *best)
        sigma = max(float(np.median(distance[agrees] if agrees.any() else distance)), 1e-12)
        near = distance < CUT * max(sigma / MEDIAN_SIZE, SMALLEST_SIGMA_M)
        if np.array_equal(near, agrees) or np.count_nonzero(near) < SAMPLE:
            break
        agrees = near
        best = _sample(place[agrees], turn[agrees])
    return agrees


def _sample(place: Array, turn: Array) -> tuple[Array, Array]:
    """Tip and point of a few poses by least squares, the shortest tip where they leave it open."""
    middle, mean = turn.mean(axis=0), place.mean(axis=0)
    columns = (turn - middle).reshape(-1, 3)
    tip = np.linalg.lstsq(columns, -(place - mean).ravel(), rcond=1e-6)[0]
    return tip, mean + middle @ tip


def _solved(place: Array, turn: Array, jitter: float) -> tuple[Array, Array, Array]:
    """Tip, point, and the inverse (6, 6) of the normal equations of both.

    A noise of ``jitter`` rad a coordinate about each axis adds 2 jitter^2 to the square of each
    direction's turns, which would shorten the arm.
    """
    count, middle = len(place), turn.mean(axis=0)
    normal = np.zeros((6, 6))
    normal[:3, :3] = count * (np.eye(3) - 2 * jitter**2 * (middle.T @ middle))
    normal[:3, 3:] = -count * middle.T
    normal[3:, :3] = -count * middle
    normal[3:, 3:] = count * np.eye(3)
    right = np.concatenate([-np.einsum('nji,nj->i', turn, place), place.sum(axis=0)])
    inverse = np.linalg.inv(normal)
    # About the middle, so that a far point costs no digits.
    shift = place.mean(axis=0)
    right[:3] += np.einsum('nji,j->i', turn, shift)
    right[3:] -= count * shift
    solution = inverse @ right
    return np.asarray(solution[:3]), np.asarray(solution[3:] + shift), np.asarray(inverse)


def _covariance(
    place: Array, turn: Array, time: Array, agrees: Mask, tip: Array, point: Array, inverse: Array
) -> Array:
    """Of tip and point, shape (6, 6); errors that are alike within a stretch of time count once.

    Where the stretches scatter more than independent errors would (White's sandwich with stretches
    as clusters), a parameter's variance is raised to that.
    """
    rest = (place + turn @ tip - point)[agrees]
    turned, when = turn[agrees], time[agrees]
    formal = inverse * float(np.sum(rest**2)) / (3 * len(rest) - 6)
    blocks = blocks_of_time(when)
    scores = np.concatenate([np.einsum('nji,nj->ni', turned, rest), -rest], axis=1)
    sums = np.stack([scores[blocks == b].sum(axis=0) for b in np.unique(blocks)]) @ inverse
    robust = np.sum(sums**2, axis=0) * len(sums) / max(len(sums) - 6, 1)
    scale = np.sqrt(np.maximum(robust / np.diag(formal), 1.0))
    return np.asarray(formal * scale[:, None] * scale[None, :])


def _refuse_poor_motion(turn: Array, used: Mask) -> Array:
    """Tilt of the body's axes, degrees; `FitError` where a direction of the body hardly turned."""
    middle = turn[used].mean(axis=0)
    spread = np.eye(3) - middle.T @ middle  # mean square move of each direction
    values, vectors = np.linalg.eigh(spread)
    tilts = np.rad2deg(np.sqrt(np.maximum(values, 0.0)))
    if tilts[0] < LEAST_TILT_DEG:
        around = _words(vectors[:, 0])
        if tilts[0] < TWO_AXES * tilts[1]:
            raise FitError(
                f'the tool turned about one axis only, {around} in its own frame: where the tip '
                'is along that axis is not determined; tilt the tool to both sides across it too, '
                'by 25 deg or more'
            )
        turns = Rotation.from_matrix(turn[used])
        turned = np.rad2deg((turns.mean().inv() * turns).magnitude().max())
        raise FitError(
            f'the tool turned by {turned:.0f} deg at most, and {around} of the body by '
            f'{tilts[0]:.1f} deg (rms, at least {LEAST_TILT_DEG:g}): tilt it by 25 deg or more to '
            'all sides'
        )
    return np.asarray(np.rad2deg(np.sqrt(np.maximum(np.diag(spread), 0.0))))


def _words(direction: Array) -> str:
    """A direction of the body as the axis that it nearly is, or as numbers."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) > 0.97:
        return 'xyz'[axis]
    turned = direction * np.sign(direction[axis])
    return f'({turned[0]:.2f} {turned[1]:.2f} {turned[2]:.2f})'
