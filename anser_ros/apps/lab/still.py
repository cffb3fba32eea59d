"""Calibrates emitters of unknown geometry with few poses of a body of many sensors.

A plate of a hundred three-axis sensors laid at four heights has more readings than many a scan,
but nothing that a scan has: no poses to average over, and each sensor saw as many places as there
are poses. Field, sensors, poses and a bend of the plate are found jointly (`still_fit`). The
held-out error is that of each pose predicted, where it is stated to be, by all the others: field,
sensors, noise and what is chosen come from those alone. Where errors of the stated poses are
looked for and found, each half of the sensors is predicted at the pose that the other half finds.
"""

import functools
import pickle
from collections.abc import Sequence

import numpy as np

from anser_ros.apps.lab.still_fit import STILL_STEPS, StillFit, StillFitter, figures_of
from anser_ros.apps.lab.still_model import POSE
from anser_ros.arrays import Array, Booleans
from anser_ros.calibration import moments
from anser_ros.calibration.held_out import HeldOut, HeldOutTally, rms
from anser_ros.calibration.layouts import Generator, Layout
from anser_ros.calibration.population import LEAST_EVIDENCE, OpticalNoise, Posterior
from anser_ros.calibration.readings import (
    basis_rows,
    check_measurements,
    usable_weights,
    with_pose,
)
from anser_ros.calibration.result import Calibration, Scan, corrections, residuals
from anser_ros.calibration.sensor_fit import SensorFit
from anser_ros.calibration.sensor_parameters import SensorParameters
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord, FieldModel
from anser_ros.physics.sensor import clusters_of
from anser_ros.settings import Accuracy

STILL_KINDS = ('gains', 'axes', 'bend', 'poses')
"""Kinds of errors that few poses of many sensors show. The poses' errors are part of every fit;
looked for, they are reported, and what is predicted is predicted where they are."""
STILL_ONLY = ('bend', 'poses')
"""Those of them that nothing else determines."""
BEND, PLACEMENT = 'body_bend', 'body_placement'
"""Names of the effects that the last two of them become."""
AS_STATED = 'flux_rms_as_stated_t'
"""The evidence of the second that is the held-out error at the poses as they were stated."""
WORDS = (
    'three-component dipoles at 7 places about every emitter, place free, and at {} beside them'
)
"""The layout in words, with the number of dipoles beside the emitters."""
POPULATIONS = ('gains', 'axes')
"""Those of them that every sensor has a value of."""
FEWEST_PLACED = 4
"""Poses from which on their errors are reported: what was found with three on simulated plates was
as often further from the truth as nearer."""
POSE_STEPS = 4
"""Gauss-Newton steps of a held-out pose from where it is stated: errors are millimetres."""


def calibrate_still(
    measurements: Measurements,
    generator: Generator,
    kinds: Sequence[str],
    accuracy: Accuracy,
    progress: moments.Progress | None = None,
) -> Calibration:
    """Fit field, sensors, poses and bends of a body's frames.

    Raises `FitError` when the readings lie in one plane, or are all zero.
    """
    check_measurements([measurements], 1, field_alone=True)
    posed = with_pose(measurements)
    looked_for = tuple(kind for kind in STILL_KINDS if kind in kinds)
    chosen = tuple(kind for kind in looked_for if kind != 'poses')  # those are in every fit

    whole, *others = _fitters(pickle.dumps((posed, generator.centres, accuracy)))
    folds = []
    for frame, fitter in enumerate(others):
        if progress is not None:
            progress('each pose from the others', frame / (len(others) + 1.0))
        folds.append(fitter.fit(chosen))
    # What most folds do not find has no part in what is predicted, so nothing speaks for it.
    kept = [
        kind for kind in chosen if 2 * sum(kind in fold.evidence for fold in folds) > len(folds)
    ]
    fit = whole.fit(kept)
    held_out = _held_out(posed, folds, accuracy)
    misplaced = []
    if 'poses' in looked_for and len(posed.time) >= FEWEST_PLACED:
        gain = whole.evidence_of_poses(fit)
        elsewhere = _held_out(posed, folds, accuracy, is_as_stated=False)
        if gain >= LEAST_EVIDENCE and rms(elsewhere.error) < rms(held_out.error):
            evidence = {'log_probability': gain, AS_STATED: rms(held_out.error)}
            held_out, misplaced = elsewhere, [_misplaced(fit, folds, evidence)]
    scan = _scan(posed, len(measurements.time), fit, accuracy, (*_bends(fit), *misplaced))
    model = FieldModel(
        positions=fit.sites.positions,
        directions=fit.sites.directions,
        moments=fit.moments,
        emitters=generator.emitters,
        frequencies_hz=generator.frequencies_hz,
        flux_error_t=held_out.flux_error_t,
        shift_sigma_m=0.0 if scan.sensor_fit is None else scan.sensor_fit.shift_sigma_m,
        effects=scan.corrections,
    )
    basis = basis_rows(scan.measurements[0], fit.sites)
    return Calibration(
        model=model,
        fit=figures_of(basis, fit.weights, fit.widths.noise_t, fit.freedom, STILL_STEPS),
        held_out=held_out,
        layout=Layout('free', fit.beside, 1.0, 0.0, words=WORDS.format(fit.beside)),
        damping=0.0,
        n_measurements=int(posed.usable.sum()),
        residuals=residuals(scan.measurements, model),
        scan=scan,
        undetermined=_not_determined(kinds, len(posed.time)),
    )


@functools.lru_cache(maxsize=1)
def _fitters(readings: bytes) -> tuple[StillFitter, ...]:
    """Fitters of all frames, then without each, kept while a diagnosis leaves out other kinds."""
    posed, centres, accuracy = pickle.loads(readings)
    frames = np.arange(len(posed.time))
    some = [posed, *(posed.frames(frames != frame) for frame in frames)]
    return tuple(StillFitter(part, centres, accuracy) for part in some)


def _not_determined(kinds: Sequence[str], poses: int) -> tuple[str, ...]:
    """A line for what was asked for and cannot be found in this way."""
    others = ', '.join(kind for kind in kinds if kind not in STILL_KINDS)
    lines = []
    if others:
        lines.append(f'{others}: not determined by few poses of many sensors; the setup is kept')
    if 'poses' in kinds and poses < FEWEST_PLACED:
        lines.append(f'poses: determined from {FEWEST_PLACED} poses on; there are {poses}')
    return tuple(lines)


def _parameters(
    measured: Measurements, fit: StillFit
) -> tuple[SensorParameters, Array, Array, Array]:
    """The sensors' errors as those of a joint fit: values, standard deviations, prior widths."""
    parameters, gains = SensorParameters([measured], POPULATIONS), fit.model.gains
    values, sigma, width = np.zeros((3, len(parameters)))
    for kind, columns in (('gains', slice(0, gains)), ('axes', slice(gains, None))):
        own = fit.unknowns.sensors[:, columns]
        rows = parameters.rows(kind).reshape(len(own), -1)[:, : own.shape[1]]
        values[rows], sigma[rows] = own, fit.sensor_sigma[:, columns]
        width[rows] = fit.widths.sensors[columns]
    return parameters, values, sigma, width


def _held_out(
    posed: Measurements, folds: Sequence[StillFit], accuracy: Accuracy, is_as_stated: bool = True
) -> HeldOut:
    """Sum up each frame's residual, its sensors and its field as the other frames predict them.

    It is at the stated pose, however good that is, or where the other half of its sensors is.
    """
    noise = min(fit.widths.noise_t for fit in folds)
    tally = HeldOutTally(noise, noise, accuracy, max(len(fit.sites) for fit in folds))
    for frame, fit in enumerate(folds):
        part = posed.frames(np.array([frame]))
        parameters, values, *_ = _parameters(part, fit)
        sound = parameters.errors_of(part.body, values).apply(part)
        if is_as_stated:
            terms = moments.pose_terms(sound, fit.sites, fit.moments)
        else:
            terms = _where_the_other_half_finds_it(sound, fit, accuracy)
        tally.add(terms, usable_weights(sound), sound.position)
    return tally.result()


def _where_the_other_half_finds_it(
    sound: Measurements, fit: StillFit, accuracy: Accuracy
) -> moments.PoseTerms:
    """Readings of each half of the sensors less those at the pose that the other half finds.

    A sensor of several channels is in one half as a whole; the halves take turns over the body.
    """
    halves = np.zeros(len(sound.sensors), dtype=bool)
    for sensor, channels in enumerate(clusters_of(sound.sensors)):
        halves[channels] = sensor % 2 == 1
    one, other = (
        moments.pose_terms(_at_best_pose(sound, fit, accuracy, half), fit.sites, fit.moments)
        for half in (halves, ~halves)
    )
    residual = np.where(halves[:, None], other.residual, one.residual)
    return moments.PoseTerms(residual, np.where(halves[:, None, None], other.slope, one.slope))


def _at_best_pose(
    sound: Measurements, fit: StillFit, accuracy: Accuracy, seen: Booleans
) -> Measurements:
    """The frame at the pose that the readings of these sensors make most probable."""
    weights, precision = usable_weights(sound) * seen, moments.pose_precision(accuracy)
    offset = np.zeros((len(sound.time), POSE))
    for _ in range(POSE_STEPS):
        terms = moments.pose_terms(moments.moved(sound, offset), fit.sites, fit.moments)
        offset += moments.most_probable_step(
            terms, weights, fit.widths.noise_t, precision, offset
        )[0]
    return moments.moved(sound, offset)


def _scan(
    posed: Measurements, frames: int, fit: StillFit, accuracy: Accuracy,
    reported: tuple[EffectRecord, ...],
) -> Scan:  # fmt: skip
    """The frames as ideal sensors on a flat body would have given them, and what was not ideal;
    ``frames`` are those of the session, without a pose too.
    """
    parameters, values, sigma, width = _parameters(posed, fit)
    offsets = fit.unknowns.frames[:, :POSE]
    poses = OpticalNoise(
        float(np.sqrt(np.mean(offsets[:, :3] ** 2))),
        float(np.sqrt(np.mean(offsets[:, 3:] ** 2))),
        float(len(offsets)),
    )
    every = np.ones(frames, dtype=bool)
    evidence = {kind: gain for kind, gain in fit.evidence.items() if kind in POPULATIONS}
    result = SensorFit(
        parameters,
        Posterior(values, width, np.diag(sigma**2), fit.log_evidence),
        tuple(kind for kind in POPULATIONS if kind not in evidence),
        evidence, fit.widths.noise_t, poses, {kind: np.zeros(0, np.int64) for kind in POPULATIONS},
        (every,), (every,), 0.0, {}, float(accuracy.optical_position_m / np.sqrt(len(offsets))),
    )  # fmt: skip
    flat = fit.model.unbent(fit.unknowns, fit.sites)
    sound = result.errors_of(posed.body).apply(flat)
    return Scan((sound,), accuracy, corrections(result), reported, result)


def _bends(fit: StillFit) -> tuple[EffectRecord, ...]:
    """The bend of the body in each frame, as one record: another session's is another."""
    if 'bend' not in fit.evidence:
        return ()
    bend = fit.model.bend
    assert bend is not None
    lift = bend.shape(fit.unknowns.frames[:, POSE:])[0] @ bend.normal
    return (
        EffectRecord(
            BEND,
            {'body': fit.model.measured.body, 'largest_m': float(np.abs(lift).max()),
             'rms_m': np.sqrt(np.mean(lift**2, axis=1)).tolist()},
            {},
            {'log_probability': fit.evidence['bend'],
             'summary': 'the body is not flat, and bent otherwise at each pose',
             'remedy': 'none: at another pose the bend is another'},
        ),
    )  # fmt: skip


def _misplaced(
    fit: StillFit, folds: Sequence[StillFit], evidence: dict[str, float]
) -> EffectRecord:
    """How far the body stood from each stated pose, in frame fg."""
    offset = fit.unknowns.frames[:, :POSE]
    sigma = np.maximum(fit.frame_sigma[:, :POSE], _jackknifed(offset, folds))
    return EffectRecord(
        PLACEMENT,
        {
            'body': fit.model.measured.body,
            'largest_m': float(np.linalg.norm(offset[:, :3], axis=1).max()),
            'shift_m': offset[:, :3].tolist(),
            'rotation_rad': offset[:, 3:].tolist(),
        },
        {'shift_m': sigma[:, :3].tolist(), 'rotation_rad': sigma[:, 3:].tolist()},
        {
            **evidence,
            'summary': 'the body does not stand where its poses are stated; the mean over all '
            'poses is kept, since the field could be shifted as well',
            'remedy': 'none: at another pose the error is another; measure the poses',
        },
    )


def _jackknifed(offset: Array, folds: Sequence[StillFit]) -> Array:
    """Standard deviation of poses' errors (F, 6) by how they change when one pose is left out.

    It knows of what the model of field and bend misses, which the posterior does not (Efron, The
    Jackknife, the Bootstrap and Other Resampling Plans, 1982, equation 3.5).
    """
    count, power = len(offset), np.zeros_like(offset)
    for frame, fit in enumerate(folds):
        rest = np.arange(count) != frame
        change = fit.unknowns.frames[:, :POSE] - (offset[rest] - offset[rest].mean(axis=0))
        power[rest] += change**2
    return np.asarray(np.sqrt((count - 1) / count * power))
