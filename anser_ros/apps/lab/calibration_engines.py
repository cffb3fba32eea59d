"""Calibrates bodies of many sensors that hardly move, and magnets, beside the usual scans.

`ENGINES` are registered before the core's own (`sessions/calibration.py`). A scan of emitters
without a drawing also says how large they are: moments of several dipoles on an axis are fitted in
turn with the poses, and a size is close to a shift of all poses, which would take very many turns.
So place, axis, moment and size of each emitter are fitted by Gauss-Newton to fluxes of which the
part that poses explain counts as little as the jitter is large (`with_source_sizes`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from anser_ros.apps.lab.one_place import calibrate_at_one_place
from anser_ros.apps.lab.still import STILL_ONLY, calibrate_still
from anser_ros.arrays import Array, ComplexArray, Integers, as_real
from anser_ros.calibration import readings
from anser_ros.calibration.calibrate import Options
from anser_ros.calibration.moments import PoseWhitener, Progress, pose_precision, pose_terms
from anser_ros.calibration.result import Calibration, with_provenance
from anser_ros.calibration.selection import COAXIAL, LEAST_GAIN
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import Dipoles, EffectRecord, FieldModel, size_figures, spread_along
from anser_ros.physics.rotations import tilted
from anser_ros.sessions.calibration import SCAN, Engine, at_constant_strength, generator_of
from anser_ros.sessions.nominal_board import NominalBoard
from anser_ros.sessions.session import Session
from anser_ros.settings import Accuracy

POINT, SIZED = COAXIAL[:2]
"""Layouts of emitters without a size, and of those that have no more than a size."""
STILL = 5.0
"""Standard deviations of the optical jitter within which all poses are one place."""
LEAST_SIGMAS = 5.0
"""Standard deviations, of five blocks, at which a size is reported: chance in one of 130."""
STEPS = 4
"""Steps of the fit, each of which leaves a small part of the error before it."""
WAYS = np.array([1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4, 1e-4, 1e-7])
"""Steps of the differences by centre (m), tilt of the axis (rad), real and imaginary part of the
moment (relative) and second moment (m^2): small beside any distance, far above rounding."""


@dataclass(frozen=True)
class _SizedSources:
    """K emitters, each on an axis of its own: centres and axes (K, 3), moments and sizes (K,)."""

    centres: Array
    axes: Array
    moments: ComplexArray
    sizes_m2: Array

    @staticmethod
    def of(model: FieldModel, count: int) -> '_SizedSources':
        """Those of ``count`` fitted dipoles each, still without a size."""
        moments = model.moments
        middle = slice((count - 1) // 2, None, count)
        total = [moments[count * k : count * (k + 1), k].sum() for k in range(moments.shape[1])]
        return _SizedSources(
            model.positions[middle], model.directions[middle], np.array(total),
            np.zeros(len(total)),
        )  # fmt: skip

    def moved(self, step: Array) -> '_SizedSources':
        """The sources after a step (K, 8), in the order of `WAYS`."""
        return _SizedSources(
            self.centres + step[:, :3], tilted(self.axes, step[:, 3:5]),
            self.moments * (1.0 + step[:, 5] + 1j * step[:, 6]), self.sizes_m2 + step[:, 7],
        )  # fmt: skip

    def dipoles(self) -> Dipoles:
        """Dipoles that have the sources' field."""
        base = Dipoles(self.centres, self.axes, np.diag(self.moments))
        for k, (axis, size) in enumerate(zip(self.axes, self.sizes_m2, strict=True)):
            base = base.joined(spread_along(base, k, axis, size))
        return base


def with_source_sizes(calibration: Calibration) -> Calibration:
    """Return a calibration that reports the sizes of emitters without a drawing.

    Only dipoles on an axis of each emitter have a size, and none is reported where emitters
    without one predict the scan as well.
    """
    scan, layout = calibration.scan, calibration.layout
    scores = {one.layout: one.score for one in calibration.candidates}
    if layout.kind != SIZED.kind or not {POINT, SIZED} <= scores.keys():
        return calibration
    if scores[POINT] < scores[SIZED] * (1.0 + LEAST_GAIN):
        return calibration
    folds = readings.fold_of_frames([m.position for m in scan.measurements])
    blocks = np.unique(np.concatenate(folds))
    sources = _SizedSources.of(calibration.model, layout.count)
    for _ in range(STEPS):
        normal, right = _sums(sources, calibration, folds, blocks)
        sources = sources.moved(_solved(normal.sum(axis=0), right.sum(axis=0)))
    normal, right = _sums(sources, calibration, folds, blocks)
    # The jackknife: each block is left out in turn.
    whole, at = normal.sum(axis=0), right.sum(axis=0)
    parts = [_solved(whole - n, at - r)[:, 7] for n, r in zip(normal, right, strict=True)]
    sigma = np.sqrt((blocks.size - 1) * np.var(parts, axis=0))
    evidence = {'heldout_point_t': scores[POINT], 'heldout_sized_t': scores[SIZED]}
    records = []
    for k in np.flatnonzero(np.abs(sources.sizes_m2) > LEAST_SIGMAS * sigma).tolist():
        figures, sigmas = size_figures(float(sources.sizes_m2[k]), float(sigma[k]))
        records.append(EffectRecord('emitter_size', {'coil': k, **figures}, sigmas, evidence))
    scan = replace(scan, reported_effects=(*scan.reported_effects, *records))
    return replace(calibration, scan=scan)


def _solved(normal: Array, right: Array) -> Array:
    """The step (K, 8) that normal equations give."""
    scale = 1.0 / np.sqrt(np.diag(normal))
    scaled = np.linalg.lstsq(normal * np.outer(scale, scale), right * scale, rcond=1e-12)[0]
    return np.asarray((scaled * scale).reshape(-1, len(WAYS)))


def _sums(
    sources: _SizedSources, calibration: Calibration, folds: Sequence[Integers], blocks: Integers
) -> tuple[Array, Array]:
    """Normal equations of each block, (B, 8K, 8K) and (B, 8K)."""
    ways = np.diag(np.tile(WAYS, len(sources.sizes_m2)))
    here, size = sources.dipoles(), len(ways)
    sites = readings.DipoleSites(here.positions, here.directions)
    normal, right = np.zeros((blocks.size, size, size)), np.zeros((blocks.size, size))
    scan, fit = calibration.scan, calibration.fit
    precision = pose_precision(scan.accuracy)
    for measured, weights, fold in zip(scan.measurements, fit.weights, folds, strict=True):
        for some in readings.frame_blocks(*weights.shape):
            part = measured.frames(some)
            terms = pose_terms(part, sites, here.moments)
            white = PoseWhitener(terms.slope, weights[some], fit.noise_t, precision)
            columns = [_slope(sources, way, part) for way in ways]
            left = np.stack([white.left_over(one) for one in [*columns, terms.residual]], axis=-1)
            left = left.reshape(*white.root.shape, -1) / white.noise_t
            rows = np.stack(columns, axis=-1).reshape(*white.root.shape, -1)
            rows *= white.root[:, :, None] / white.noise_t
            sums = np.einsum('fri,frj->fij', rows, left, optimize=True)
            for place, block in enumerate(blocks):
                total = sums[fold[some] == block].sum(axis=0)
                normal[place] += total[:, :-1]
                right[place] += total[:, -1]
    return normal, right


def _slope(sources: _SizedSources, way: Array, measured: Measurements) -> Array:
    """Derivative of the fluxes, (F, S, 2K), by the parameter that a way of (8K,) changes."""
    step = way.reshape(-1, len(WAYS))
    ahead, behind = (_flux(sources.moved(sign * step), measured) for sign in (1.0, -1.0))
    return np.asarray((ahead - behind) / (2.0 * way.sum()))


def _flux(sources: _SizedSources, measured: Measurements) -> Array:
    """Modelled fluxes, (F, S, 2K), T."""
    points, axes = measured.placed()
    lengths = np.tile(measured.sensors.length, len(points))
    flux = sources.dipoles().flux(points.reshape(-1, 3), axes.reshape(-1, 3), lengths)
    return as_real(flux).reshape(*points.shape[:2], -1)


def _tools(sessions: Sequence[Session]) -> list[Measurements]:
    return [tool for session in sessions for tool in session.tools]


def _is_free(sessions: Sequence[Session], options: Options) -> bool:
    """Whether nothing says where the emitters' field comes from."""
    return options.layout is None and NominalBoard.of(sessions[0].setup).model is None


def is_at_one_place(measurements: Sequence[Measurements], accuracy: Accuracy) -> bool:
    """Return whether one body with many sensors rested at one place in all frames."""
    if len(measurements) != 1 or len(measurements[0].sensors) < readings.MANY_SENSORS:
        return False
    one = readings.with_pose(measurements[0])
    if not len(one.time):
        return False
    moved = np.ptp(one.position, axis=0).max() > STILL * accuracy.optical_position_m
    turned = np.abs(one.rotation - one.rotation[0]).max() > STILL * accuracy.optical_rotation_rad
    return not (moved or turned)


def _accepts_one_place(sessions: Sequence[Session], options: Options) -> bool:
    return is_at_one_place(_tools(sessions), options.accuracy) and _is_free(sessions, options)


def is_still(measurements: Sequence[Measurements]) -> bool:
    """Return whether there are few poses of one body with many sensors, and no more."""
    many = len(measurements) == 1 and len(measurements[0].sensors) >= readings.MANY_SENSORS
    return (
        many
        and readings.FEWEST_FRAMES_OF_MANY
        <= readings.usable_frames(measurements)
        < readings.FEWEST_SCAN_FRAMES
    )


def _accepts_still(sessions: Sequence[Session], options: Options) -> bool:
    is_asked = bool(options.estimate) or options.is_joint
    return is_asked and is_still(_tools(sessions)) and _is_free(sessions, options)


def _fitted(
    calibrate: Callable[..., Calibration],
    sessions: Sequence[Session],
    options: Options,
    progress: Progress | None = None,
) -> Calibration:
    sessions, _ = at_constant_strength(sessions, options)
    (tool,) = _tools(sessions)
    session = next(one for one in sessions if one.tools)
    generator = generator_of(sessions[0].setup)
    calibration = calibrate(tool, generator, options.estimate, options.accuracy, progress)
    return with_provenance(calibration, [Path(session.path).name])


def _fit_still(
    sessions: Sequence[Session], options: Options, progress: Progress | None = None
) -> Calibration:
    readings.check_single_coils(_tools(sessions))
    return _fitted(calibrate_still, sessions, options, progress)


ENGINES = (
    Engine(_accepts_one_place, partial(_fitted, calibrate_at_one_place), is_joint=True),
    Engine(
        _accepts_still,
        _fit_still,
        True,
        STILL_ONLY,
        f'{readings.FEWEST_FRAMES_OF_MANY} to {readings.FEWEST_SCAN_FRAMES - 1} poses of one body '
        f'with at least {readings.MANY_SENSORS} sensors, over emitters without a drawing, and '
        'with no layout of dipoles stated',
    ),
    Engine(_is_free, lambda *scan: with_source_sizes(SCAN.fit(*scan))),
)
"""In their order: a body of many sensors at one place, at a few poses, and a scan, with the
sizes of emitters without a drawing."""
