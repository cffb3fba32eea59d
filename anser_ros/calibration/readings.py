"""Turns measurements into rows of a matrix, deals them to folds, and checks that they suffice.
Readings are taken in blocks of frames that fit into memory (`usable_readings`); `basis_rows` is
the article's matrix of what each dipole does to them; whole frames in cells of space are dealt
to the folds by which errors are held out (`fold_of_frames`).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from anser_ros.arrays import Array, Booleans, ComplexArray, Integers
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.parallel import slices
from anser_ros.physics.dipole import flux_basis, flux_jacobian
from anser_ros.physics.sensor import along_each_axis

BLOCK_ROWS = 8192
"""Readings that are in memory at a time as rows of a matrix. With 400 dipoles such a block takes
26 MB; smaller blocks cost more calls, larger ones only memory."""


class Readings(NamedTuple):
    """Holds P usable readings of sensors with a pose, for K emitters."""

    # points, axes (P, 3): sensor centres (m) and unit axes, frame fg
    points: Array
    axes: Array
    lengths: Array  # (P,): coil lengths, m
    flux: ComplexArray  # (P, K): measured flux density along the axes, T


def frame_blocks(count: int, sensors: int, rows: int = BLOCK_ROWS) -> list[slice]:
    """Return slices of whole frames with at most ``rows`` readings each, but at least a frame."""
    return slices(count, max(1, rows // max(1, sensors)))


def thinned(measurements: Sequence[Measurements], most: int) -> list[Measurements]:
    """Return every n-th frame with the smallest n that leaves about so many readings at most."""
    count = sum(m.flux.shape[0] * m.flux.shape[1] for m in measurements)
    step = slice(None, None, max(1, -(-count // most)))
    return [m.frames(step) for m in measurements]


def usable_readings(measurements: Sequence[Measurements]) -> Iterator[Readings]:
    """Yield the usable readings of measurements at their poses, block by block."""
    for whole in measurements:
        for block in frame_blocks(len(whole.time), len(whole.sensors)):
            part = whole.frames(block)
            used = part.usable
            if used.any():
                points, axes = part.placed()
                lengths = np.broadcast_to(part.sensors.length, used.shape)[used]
                yield Readings(points[used], axes[used], lengths, part.flux[used])


def weighted_readings(
    measurements: Sequence[Measurements], weights: Sequence[Array]
) -> tuple[Readings, Array]:
    """Return the P readings that have weight, at their poses, and the roots of their weights."""
    parts, roots = [], []
    for m, weight in zip(measurements, weights, strict=True):
        points, axes = m.placed()
        used = weight > 0.0
        lengths = np.broadcast_to(m.sensors.length, used.shape)[used]
        parts.append((points[used], axes[used], lengths, m.flux[used]))
        roots.append(np.sqrt(weight[used]))
    return Readings(*map(np.concatenate, zip(*parts, strict=True))), np.concatenate(roots)


def usable_weights(measurements: Measurements) -> Array:
    """Return weights of the readings, shape (F, S): 1 where a reading is usable, else 0."""
    return np.asarray(measurements.usable, dtype=np.float64)


def with_pose(measurements: Measurements) -> Measurements:
    """Return the frames with a pose and a valid reading; fluxes that are not usable become 0."""
    kept = measurements.frames(np.asarray(measurements.usable.any(axis=1)))
    flux = np.where(kept.usable[:, :, None], kept.flux, 0.0)
    return replace(kept, flux=flux)


@dataclass(frozen=True)
class DipoleSites:
    """Holds positions (m) and unit directions of N virtual dipoles, shape (N, 3), frame fg."""

    positions: Array
    directions: Array
    own: Booleans | None = None  # (N, K): whose dipoles they are; None if everybody's

    def __len__(self) -> int:
        return int(self.positions.shape[0])

    def groups(self, emitters: int) -> list[tuple[list[int], Integers]]:
        """Return emitters that have the same dipoles, with the indices of these."""
        if self.own is None:
            return [(list(range(emitters)), np.arange(len(self)))]
        alike: dict[bytes, list[int]] = {}
        for k in range(emitters):
            alike.setdefault(self.own[:, k].tobytes(), []).append(k)
        return [(some, np.flatnonzero(self.own[:, some[0]])) for some in alike.values()]

    @staticmethod
    def of_any_direction(places: Array) -> 'DipoleSites':
        """Return three dipoles, along x, y and z, at each of P places (P, 3), m."""
        return DipoleSites(*along_each_axis(places))

    @property
    def shared(self) -> 'DipoleSites':
        """Return the same dipoles, of which every emitter may have moments."""
        return DipoleSites(self.positions, self.directions)

    def joined(self, other: 'DipoleSites') -> 'DipoleSites':
        """Return these dipoles, then the others."""
        return DipoleSites(
            np.concatenate([self.positions, other.positions]),
            np.concatenate([self.directions, other.directions]),
        )


def basis_rows(measurements: Measurements, dipoles: DipoleSites) -> Array:
    """Return the article's matrix M for all readings, shape (F S, N), T / (A m^2)."""
    return flux_basis(*_rows(measurements), dipoles.positions, dipoles.directions)


def flux_slopes(
    measurements: Measurements, dipoles: DipoleSites, moments: ComplexArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return modelled fluxes (F, S, K), T, and their derivatives (F, S, 3, K).

    These are by the sensors' centres (T/m) and axes (T).
    """
    rows, sites = _rows(measurements), (dipoles.positions, dipoles.directions)
    flux, by_place, by_axis = flux_jacobian(*rows, *sites, moments)
    shape = (len(measurements.time), len(measurements.sensors), 3, moments.shape[1])
    return flux.reshape(*shape[:2], -1), by_place.reshape(shape), by_axis.reshape(shape)


def _rows(measurements: Measurements) -> tuple[Array, Array, Array]:
    points, axes = measurements.placed()
    lengths = np.tile(measurements.sensors.length, len(points))
    return points.reshape(-1, 3), axes.reshape(-1, 3), lengths


FOLDS = 5
"""Number of folds. Each fit then uses four fifths of the readings; more folds cost a fit each."""
CELLS_ALONG = 5
"""Cells along the longest direction. They must be larger than the distance over which the errors
of a fit are alike, or held-out errors are too small; with fewer cells each fold is one place."""
SMALLEST_SHARE = 0.15
"""A direction is not divided if its extent is a smaller fraction of the longest one's; the cells
of a flat volume would otherwise hold frames of the same places."""


def fold_of_frames(positions: Sequence[Array]) -> list[Integers]:
    """Return the fold of every frame.

    Space is cut into equal cells, `CELLS_ALONG` along the longest direction of a session: those on
    other sides of a source would else be held out whole. Cell (i, j, k) goes to fold
    (i + 2 j + 3 k) mod `FOLDS`, so that a fold is spread over the volume and its cells do not
    touch. All frames of a cell are held out together, never a single point.

    ``positions`` (F, 3) are the bodies', m, one array per body and session.
    Returns (F,): folds of the frames, one array per body and session.
    Raises `FitError` when the frames fill fewer than two folds.
    """
    everywhere = np.concatenate(positions)
    low, high = everywhere.min(axis=0), everywhere.max(axis=0)
    extent = high - low
    own = max(float(np.ptp(where, axis=0).max()) for where in positions if len(where))
    size = max(own / CELLS_ALONG, 1e-9)
    most = np.maximum(np.ceil(extent / size).astype(int), 1) - 1
    out = []
    for where in positions:
        cell = np.floor((where - low) / size).astype(np.int64)
        cell = np.minimum(cell, most)
        cell[:, extent < SMALLEST_SHARE * extent.max()] = 0
        out.append(np.asarray(cell @ np.array([1, 2, 3]) % FOLDS, dtype=np.int64))
    used = np.unique(np.concatenate(out))
    if used.size < 2:
        raise FitError(
            'held-out error needs frames in at least 2 separate cells of space, got 1: '
            'all frames are at one place'
        )
    return out


FEWEST_SCAN_FRAMES = 10
"""Frames with poses below which no calibration is tried: such a recording is empty or cut."""
FEWEST_FRAMES_OF_MANY, MANY_SENSORS = 3, 30
"""Frames that do where a body has many sensors: each of them is another reading. With fewer poses
none could be held out and the others still tell how the field changes between them."""
FLATTEST = 0.002
"""Least thickness (rms) of the cloud of sensor positions, as a fraction of its extent (rms)."""
THINNEST_M = 2e-4
"""The same, m: three times the jitter of the poses, which makes a flat cloud look thick."""
DISAGREEMENT = 10.0
"""Ratio of the residual of a common fit to that of each session alone from which on the sessions
count as recorded with different boards. Sessions of one board have a ratio near one."""


def check_measurements(
    measurements: Sequence[Measurements], needed: int, field_alone: bool = False
) -> int:
    """Check that measurements determine a field model.

    ``needed``: number of readings per emitter that the dipoles need. ``field_alone``: whether
    nothing is estimated of the sensors, so that few poses of many sensors do.
    Returns the number of readings per emitter.
    Raises `FitError` when there are too few frames with a pose or too few readings, or all
    readings lie in one plane; the message has the number needed and the number found.
    """
    if not measurements:
        raise FitError(
            f'a calibration needs at least {FEWEST_SCAN_FRAMES} frames of tool fluxes with poses, '
            'got 0: no session has tool fluxes'
        )
    for m in measurements:
        if not m.has_pose.any():
            raise FitError(
                f'{m.body}: a calibration needs at least {FEWEST_SCAN_FRAMES} frames with a pose, '
                f'got 0 of {len(m.time)} (is /optical/{m.body}/pose recorded?)'
            )
    frames = usable_frames(measurements)
    many = all(len(m.sensors) >= MANY_SENSORS for m in measurements)
    fewest = FEWEST_FRAMES_OF_MANY if many and field_alone else FEWEST_SCAN_FRAMES
    if frames < fewest:
        hint = '; --estimate none fits the field alone to so few poses of so many sensors'
        hint = hint if many and frames >= FEWEST_FRAMES_OF_MANY else ''
        raise FitError(
            f'a calibration needs at least {fewest} frames with poses and valid fluxes, '
            f'got {frames}{hint}'
        )
    readings = sum(int(m.usable.sum()) for m in measurements)
    if readings < needed:
        raise FitError(
            f'{needed} dipoles need at least {needed} readings per emitter, got {readings}'
        )
    got, need, widest = _thickness(measurements)
    if got < need:
        if widest < need:
            raise FitError(
                f'all readings lie within {1e3 * widest:.2g} mm rms: are places in m? '
                'A scan needs poses all over the volume'
            )
        raise FitError(
            f'all readings lie in one plane: their spread across it must be at least '
            f'{1e3 * need:.2f} mm rms, got {1e3 * got:.2f} mm'
        )
    return readings


def check_single_coils(measurements: Sequence[Measurements]) -> None:
    """Raise `FitError` when a sensor has windings, as only a body at one place may have."""
    for m in measurements:
        rows = np.flatnonzero(~m.sensors.is_single)
        if rows.size:
            raise FitError(
                f'{m.sensors.name[rows[0]]} has windings: such sensors are calibrated only on a '
                f'body of at least {MANY_SENSORS} sensors that rests at one place, over emitters '
                'without a drawing'
            )


def check_kept(
    measurements: Sequence[Measurements], kept: Sequence[Measurements], needed: int
) -> None:
    """Check that the frames that a fit of sensors kept still determine a field model.

    Raises `FitError` when too little is left; the message has how many frames were left out, and
    why.
    """
    try:
        check_measurements([m for m in kept if len(m.time)], needed)
    except FitError as error:
        before, after = usable_frames(measurements), usable_frames(kept)
        raise FitError(
            f'{before - after} of {before} frames were left out, because their poses contradict '
            f'their fluxes or something moved; of the others: {error}'
        ) from error


def usable_frames(measurements: Sequence[Measurements]) -> int:
    """Return the number of frames with a pose and a valid reading."""
    return sum(int(m.usable.any(axis=1).sum()) for m in measurements)


def is_thick(measurements: Sequence[Measurements]) -> bool:
    """Return whether usable readings spread enough across their plane for a free field."""
    got, need, _ = _thickness(measurements)
    return got >= need


def _thickness(measurements: Sequence[Measurements]) -> tuple[float, float, float]:
    """Return spreads of usable readings, m rms: across their plane, the least, the largest."""
    points = np.concatenate([m.placed()[0][m.usable] for m in measurements])
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    return float(spread[-1]), max(FLATTEST * float(spread[0]), THINNEST_M), float(spread[0])


def check_agreement(
    measurements: Sequence[Measurements],
    names: Sequence[str],
    noise_t: float,
    noise_of: Callable[[list[Measurements]], float],
) -> None:
    """Check that one field explains all sessions.

    Raises `FitError` when the residual ``noise_t`` of the common fit is more than `DISAGREEMENT`
    times the largest one of the sessions alone, by ``noise_of``.
    """
    sessions = list(dict.fromkeys(names))
    if len(sessions) < 2:
        return
    worst = max(
        noise_of([m for m, name in zip(measurements, names, strict=True) if name == session])
        for session in sessions
    )
    if noise_t > DISAGREEMENT * worst:
        raise FitError(
            'the sessions are of different boards: the residual of one field for all is '
            f'{noise_t:.3g} T, more than {DISAGREEMENT:g} times the {worst:.3g} T of a '
            'field for each'
        )
