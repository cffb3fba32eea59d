"""Compares distances and turns with known ones, by Hummel's protocol and by ASTM F2554.

Hummel et al., "Design and application of an assessment protocol for electromagnetic tracking
systems", Med. Phys. 32 (2005): distances on a board of holes, and a ring of rotations; the small
volume of Maier-Hein et al., Med. Phys. 39 (2012). Orders, descriptions and statistics are those of
MITK's HummelProtocolEvaluation, so that the figures can be compared.

ASTM F2554, "Standard Practice for Measurement of Positional Accuracy of Computer Assisted Surgical
Systems": how far readings of one location scatter while the tool is turned about it, and how far
distances between points of a phantom are from the true ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.assessment import intervals
from anser_ros.apps.poses.assessment.rest import StillPoint
from anser_ros.apps.poses.sequence import PoseSequence
from anser_ros.arrays import Array, Integers
from anser_ros.errors import FitError, ParameterError
from anser_ros.physics.rotations import axis_angles

SPACING_M = 0.05
"""Distance of neighbouring holes of the protocol's board, m."""
RING_STEP_DEG = 11.25
"""Turn from one hole of the protocol's ring to the next, degrees: 32 in a whole turn."""
VOLUMES = {12: ('small', 3, 4), 25: ('medium', 5, 5), 90: ('standard', 9, 10)}
"""Name, rows and columns of MITK's volumes, by the number of their points."""
SMALL_LABEL = 4  # MITK numbers rows and columns of the small volume from the board's own 4 on
WRONG_ORDER = 0.5
"""Error of neighbours, in spacings, from which on points are not in the order they should be; and
in the error of another order, below which that one is it."""
NEIGHBOURS = '5 cm distance errors'
DISTANCE_STEPS = ((NEIGHBOURS, 1), ('15 cm distance errors', 3), ('30 cm distance errors', 6))
"""Kinds of distances, and how many spacings of the board's points each is."""
ACCUMULATED = 'accumulated distance errors'
COMMON_ERROR_SIGMAS = 1.0
"""Correlation of the errors of parallel neighbouring distances, in its standard errors, from which
on they count as alike: in doubt the interval is the wider one. Chosen on simulated boards."""
PARTS = 3
"""Strips of a board, along and across, that are drawn again where lines are alike."""
ROTATION = 'Rotation error statistics'
ORDERS = ('rows', 'serpentine')


@dataclass(frozen=True)
class ErrorGroup:
    """Holds errors of one kind."""

    unit: str  # ``mm`` or ``deg``, as MITK has them
    descriptions: tuple[str, ...]
    errors: Array  # (n,), sizes, as MITK's ``distanceError``
    signed: Array  # (n,), measured less true
    summary: dict[str, intervals.IntervalEstimate]  # of the sizes


@dataclass(frozen=True)
class Grid:
    """Describes the board's layout: rows, columns, spacing in m, and MITK's name of it or none."""

    rows: int
    columns: int
    spacing_m: float = SPACING_M
    name: str = field(default='')

    @classmethod
    def of(cls, count: int, shape: tuple[int, int] | None, spacing_m: float) -> 'Grid':
        """Return the layout of so many points.

        Raises `ParameterError` when no layout is given and none has so many points, or the given
        one has others.
        """
        known = VOLUMES.get(count)
        if shape is None:
            if known is None:
                takes = ', '.join(f'{n} ({r} x {c})' for n, (_, r, c) in VOLUMES.items())
                raise ParameterError(
                    f'{count} points were found, but the protocol needs {takes}: state your '
                    'board with --grid ROWSxCOLUMNS, or check the points for one too many or '
                    'too few'
                )
            return cls(known[1], known[2], spacing_m, known[0])
        if shape[0] * shape[1] != count:
            raise ParameterError(
                f'{count} points were found, but a board of {shape[0]} x {shape[1]} holes needs '
                f'{shape[0] * shape[1]}'
            )
        name = known[0] if known and shape == known[1:] else ''
        return cls(*shape, spacing_m, name)

    def point(self, row: int, column: int) -> str:
        """Return the label of a hole, as ``row/column``."""
        first = SMALL_LABEL if self.name == 'small' else 1
        return f'{row + first}/{column + first}'


def grid_points(points: Sequence[StillPoint], grid: Grid, order: str = 'rows') -> Array:
    """Return positions by row and column, shape (rows, columns, 3), m.

    Raises `FitError` when neighbours are so far off that the points are in another order.
    """
    place = np.array([p.position for p in points]).reshape(grid.rows, grid.columns, 3)
    turned = place.copy()
    turned[1::2] = turned[1::2, ::-1]
    taken, other = (turned, place) if order == 'serpentine' else (place, turned)
    off = _off(taken, grid)
    better = next(o for o in ORDERS if o != order)
    lying = place.reshape(grid.columns, grid.rows, 3)
    for option, trial in ((f'--order {better}', other),
                          (f'--grid {grid.columns}x{grid.rows}', lying)):  # fmt: skip
        left = _off(trial, grid)[1]
        if left < WRONG_ORDER * off[1] and off[1] > WRONG_ORDER * grid.spacing_m:
            raise FitError(
                f'the distances of neighbouring points are wrong by {1e3 * off[1]:.0f} mm (rms), '
                f'but with {option} by only {1e3 * left:.1f} mm'
            )
    if off[0] > WRONG_ORDER * grid.spacing_m:
        raise FitError(
            f'the median error of the distances of neighbouring points is {1e3 * off[0]:.0f} '
            f'mm, of a spacing of {1e3 * grid.spacing_m:.0f} mm: were they recorded row by row, '
            'and are --grid and --spacing-mm right?'
        )
    return taken


def _off(place: Array, grid: Grid) -> tuple[float, float]:
    """Errors of neighbours' distances, m: their median, and root mean square."""
    along = [np.linalg.norm(np.diff(place, axis=k), axis=2).ravel() for k in (0, 1)]
    size = np.abs(np.concatenate(along) - grid.spacing_m)
    if not size.size:
        raise FitError('a board must have at least two holes')
    return float(np.median(size)), float(np.sqrt(np.mean(size**2)))


def distance_errors(place: Array, grid: Grid, rng: np.random.Generator) -> dict[str, ErrorGroup]:
    """Return errors of the protocol's distances, by MITK's names, up to the board's length.

    MITK gives 15 cm, 30 cm and accumulated distances for the standard volume alone; here every
    board has those that fit. Intervals resample whole lines of holes, because errors along a line
    are correlated. If those of neighbouring lines are correlated too (`have_common_errors`),
    strips of the board are also resampled. ``place`` (rows, columns, 3): measured, m.
    """
    found, alike = {}, have_common_errors(place, grid)
    for name, step in DISTANCE_STEPS:
        rows = [(r, c, r, c + step) for r in range(grid.rows) for c in range(grid.columns - step)]
        across = [
            (r, c, r + step, c) for c in range(grid.columns) for r in range(grid.rows - step)
        ]
        if rows or across:
            lines = [p[0] for p in rows] + [grid.rows + p[1] for p in across]
            found[name] = _group(place, grid, [*rows, *across], lines, alike, rng)
    pairs = [(r, 0, r, c) for r in range(grid.rows) for c in range(1, grid.columns)]
    if pairs:
        found[ACCUMULATED] = _group(place, grid, pairs, [p[0] for p in pairs], alike, rng)
    return found


def have_common_errors(place: Array, grid: Grid) -> bool:
    """Return whether neighbouring distances have common errors, as in a distorted field.

    Parallel distances share no hole, so the noise of holes leaves them uncorrelated. ``place``
    (rows, columns, 3): measured, m.
    """
    for _, step in DISTANCE_STEPS:
        products, squares = [], []
        for axis, count in enumerate(place.shape[:2]):
            if count <= step:
                continue
            ahead = np.take(place, range(step, count), axis)
            apart = ahead - np.take(place, range(count - step), axis)
            signed = np.linalg.norm(apart, axis=2) - step * grid.spacing_m
            lines = signed if axis else signed.T  # one in a row
            products.append((lines[:-1] * lines[1:]).ravel())
            squares.append(lines.ravel() ** 2)
        if not products or not np.concatenate(products).size:
            continue
        product, square = np.concatenate(products), np.concatenate(squares)
        if product.sum() > COMMON_ERROR_SIGMAS * np.sqrt(product.size) * square.mean():
            return True
    return False


def _group(
    place: Array, grid: Grid, pairs: Sequence[tuple[int, int, int, int]], lines: Sequence[int],
    alike: bool, rng: np.random.Generator,
) -> ErrorGroup:  # fmt: skip
    signed, words = [], []
    for number, (r, c, r2, c2) in enumerate(pairs, start=1):
        measured = float(np.linalg.norm(place[r2, c2] - place[r, c]))
        signed.append(1e3 * (measured - grid.spacing_m * (abs(r2 - r) + abs(c2 - c))))
        counted = 'Distance' if grid.name == 'small' else f'Distance({number})'
        words.append(f'{counted} {grid.point(r, c)} to {grid.point(r2, c2)}')
    clusters = [np.array(lines)]
    if alike:
        ends = np.array(pairs, dtype=np.float64)
        # Strips of the board that the middle of each distance is in.
        clusters += [intervals.equal_parts(ends[:, k] + ends[:, k + 2], PARTS) for k in (0, 1)]
    return grouped('mm', words, np.array(signed), clusters, rng)


def grouped(
    unit: str, words: Sequence[str], signed: Array, clusters: Sequence[Integers],
    rng: np.random.Generator,
) -> ErrorGroup:  # fmt: skip
    """Return errors with intervals from resamples of clusters, the widest of several ways."""
    size = np.abs(signed)
    found = [
        intervals.summarised(
            size, intervals.cluster_weights(labels, rng), int(np.unique(labels).size)
        )
        for labels in clusters
    ]
    return ErrorGroup(unit, tuple(words), size, signed, intervals.widest(found))


def matching_error(place: Array, grid: Grid) -> float:
    """Return the rms distance, m, from the board laid on the points: MITK's grid matching."""
    rows, columns = np.meshgrid(np.arange(grid.rows), np.arange(grid.columns), indexing='ij')
    true = grid.spacing_m * np.stack([rows, columns, np.zeros_like(rows)], axis=-1).reshape(-1, 3)
    return rigid_distance(true.astype(np.float64), place.reshape(-1, 3))


def rigid_distance(true: Array, measured: Array) -> float:
    """Return the rms distance, m, of points (n, 3) that are laid on each other rigidly."""
    left, right = measured - measured.mean(axis=0), true - true.mean(axis=0)
    root = Rotation.align_vectors(left, right)[1]  # of the sum of squares
    return float(root / np.sqrt(len(true)))


def rotation_errors(
    points: Sequence[StillPoint], step_deg: float, axis: Array | None, rng: np.random.Generator
) -> ErrorGroup:
    """Return errors of the turns from one hole of the ring to the next, as MITK has them.

    ``axis`` (3,): direction of the sensor whose turn counts (MITK's rotation vector, for sensors
    without roll); None: the whole turn. Raises `FitError` when there are fewer than two points, or
    they are in another order.
    """
    if len(points) < 2:
        raise FitError(
            f'a ring needs at least two points (the protocol has 32), got {len(points)}'
        )
    turns = Rotation.from_matrix(np.array([p.rotation for p in points]))
    if axis is None:
        angles = (turns[:-1].inv() * turns[1:]).magnitude()
    else:
        vectors = turns.apply(axis / np.linalg.norm(axis))
        angles = axis_angles(vectors[:-1], vectors[1:])
    signed = np.rad2deg(angles) - step_deg
    if float(np.median(np.abs(signed))) > WRONG_ORDER * step_deg:
        raise FitError(
            f'the median error of the turns is {np.median(np.abs(signed)):.1f} deg, of a step '
            f'of {step_deg:g} deg: are the points in the order of the holes, and is --step-deg '
            'right?'
        )
    words = [f'Rotation Error ROT{k} / ROT{k + 1}' for k in range(1, len(points))]
    # Neighbouring turns share a hole: they are drawn again by twos.
    return grouped('deg', words, signed, [np.arange(signed.size) // 2], rng)


FEWEST_READINGS = 10  # of a point: fewer give no mean that a bad reading leaves alone
MOST_READINGS = 2000  # that take part, evenly over the recording: two million pairs of them
FAR_M = 0.05
"""Extent of readings, m, beyond which they are no readings of one location."""
FEWEST_FOR_OUTLIER = 6
"""Points without which none is said to stand alone: a rigid fit has six unknowns."""
ALONE = 0.5
"""Share of a rigid fit's error that is left without a point that stands alone."""


def single_point(
    poses: PoseSequence, rng: np.random.Generator
) -> tuple[ErrorGroup, dict[str, intervals.IntervalEstimate]]:
    """Return distances of the readings from their mean, mm, and the largest between two, m.

    ``poses``: of the tip, while it stays at one location. Raises `FitError` when there are too few
    readings, or they are of several locations.
    """
    if poses.size < FEWEST_READINGS:
        raise FitError(f'a point needs at least {FEWEST_READINGS} readings, got {poses.size}')
    rows = np.linspace(0, poses.size - 1, min(poses.size, MOST_READINGS)).astype(int)
    place, time = poses.position[rows], poses.time[rows]
    low, high = np.percentile(place, [5, 95], axis=0)
    spread = float(np.linalg.norm(high - low))
    if spread > FAR_M:
        raise FitError(
            f'the readings extend over {1e3 * spread:.0f} mm: they were taken at several '
            'locations, or are those of the sensor instead of the tip (state the tip with '
            '--tip)'
        )
    size = 1e3 * np.linalg.norm(place - place.mean(axis=0), axis=1)
    group = grouped('mm', [f'Reading at {t:.2f} s' for t in time], size,
                    [intervals.blocks_of_time(time)], rng)  # fmt: skip
    return group, {'span_m': intervals.IntervalEstimate(_span(place))}


def _span(place: Array) -> float:
    """Largest distance of two of some places, m; exact for those that are farthest out."""
    rest = place - place.mean(axis=0)
    outer = rest[np.argsort(-np.linalg.norm(rest, axis=1))[:200]]
    return float(np.max(np.linalg.norm(outer[:, None] - outer[None], axis=2)))


def point_to_point(
    points: Sequence[StillPoint], true: Array, rng: np.random.Generator
) -> tuple[ErrorGroup, dict[str, intervals.IntervalEstimate]]:
    """Return errors of all distances between points, mm, and what a rigid fit leaves, m.

    ``true`` (n, 3): places of the points on the phantom, m, in any frame, in the same order.
    Raises `FitError` when the numbers differ, there are too few, or the order is another one.
    """
    if len(points) != len(true):
        raise FitError(f'{len(points)} points were found, but the truth has {len(true)}')
    if len(points) < 3:
        raise FitError(f'distances need at least three points, got {len(points)}')
    place = np.array([p.position for p in points])
    first, second = np.triu_indices(len(points), 1)
    measured = np.linalg.norm(place[first] - place[second], axis=1)
    wanted = np.linalg.norm(true[first] - true[second], axis=1)
    signed = 1e3 * (measured - wanted)
    size = np.abs(signed)
    if float(np.median(size)) > 0.25 * 1e3 * float(np.median(wanted)):
        raise FitError(
            f'the median error of the distances is {np.median(size):.0f} mm: the '
            'points are not in the order of the truth, or a unit is wrong'
        )
    pairs = np.stack([first, second], axis=1)
    words = tuple(f'Distance {a + 1} to {b + 1}' for a, b in pairs)
    weights = intervals.vertex_weights(pairs, rng)
    group = ErrorGroup('mm', words, size, signed, intervals.summarised(size, weights, len(points)))
    mean = intervals.summarised(signed, weights, len(points))['Mean']
    return group, {
        'mean_error_m': intervals.IntervalEstimate(
            1e-3 * mean.value, 1e-3 * mean.low, 1e-3 * mean.high
        ),
        'standard_deviation_of_error_m': intervals.IntervalEstimate(
            1e-3 * intervals.mitk_statistics(signed)['Sample Standard Deviation']
        ),
        'least_error_m': intervals.IntervalEstimate(1e-3 * float(signed.min())),
        'greatest_error_m': intervals.IntervalEstimate(1e-3 * float(signed.max())),
        'rigid_fit_m': intervals.IntervalEstimate(rigid_distance(true, place)),
    }


def standing_alone(place: Array, true: Array) -> tuple[int, float, float] | None:
    """Return the one point that a rigid fit is much better without, and what both fits leave.

    Causes are a marker found in its second solution, or a tip that was not in its divot. None if
    no single point stands alone, or if there are too few points.
    """
    count = len(place)
    if count < FEWEST_FOR_OUTLIER:
        return None
    whole = rigid_distance(true, place)
    both = np.stack([true, place])
    rest = [rigid_distance(*np.delete(both, k, axis=1)) for k in range(count)]
    best = int(np.argmin(rest))
    return (best, whole, rest[best]) if rest[best] < ALONE * whole else None
