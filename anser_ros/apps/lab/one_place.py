"""Calibrates emitters of unknown place by a body of many sensors that rests at one place.

An array of hundreds of sensors around a few coils determines where these are without a pose that
changes (`sources`). One place does not determine each sensor's own error, which other places
would show: it is a width here, no correction, except which way round it is. The held-out error
is that of sensors: each fifth of them predicted by the others, from the start.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.linalg

from anser_ros.apps.lab.source_calibration import KINDS, SourceReadings, SourcesFit, SourcesFitter
from anser_ros.apps.lab.still_fit import figures_of
from anser_ros.arrays import Array, Booleans, ComplexArray, Integers, as_real
from anser_ros.calibration.held_out import HeldOut, rms
from anser_ros.calibration.layouts import Generator, Layout
from anser_ros.calibration.moments import Progress
from anser_ros.calibration.population import LEAST_EVIDENCE
from anser_ros.calibration.readings import FOLDS, with_pose
from anser_ros.calibration.result import Calibration, Residuals, Scan
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord, FieldModel
from anser_ros.physics.sensor import PlacedPoints
from anser_ros.settings import Accuracy

NOISY = 5.0
"""Times the median noise to be called noisy: chance in no sensor of a thousand with two frames."""
FEWEST_SCATTERS = 4
"""Degrees of freedom of a sensor's scatter from which on it is called noisy."""
WORDS = 'a three-component dipole for every emitter, place free, and {} of their stray fields'
"""The layout in words, with the number of dipoles of stray fields."""


def calibrate_at_one_place(
    measurements: Measurements,
    generator: Generator,
    kinds: Sequence[str],
    accuracy: Accuracy,
    progress: Progress | None = None,
) -> Calibration:
    """Find each emitter's place and field, and which sensors are the wrong way round.

    ``kinds``: of `KINDS`; others keep the setup's values. With none, sensors are as stated.
    Raises `FitError` when all fluxes of an emitter are zero.
    """
    posed, emitters = with_pose(measurements), generator.emitters
    readings, ratio = _mean(posed, accuracy)
    noisy = tuple(
        EffectRecord('excess_noise', {'factor': factor, 'channels': [channel]})
        for factor, channel in zip(ratio.tolist(), posed.sensors.channel.tolist(), strict=True)
        if factor > NOISY  # times the median channel's
    )
    received = readings.flux[readings.used].any(axis=(0, 2))
    if not received.all():
        silent = ', '.join(emitters[k] for k in np.flatnonzero(~received))
        raise FitError(f'{measurements.body}: all fluxes of {silent} are zero')
    looked_for = tuple(kind for kind in KINDS if kind in kinds)
    predicted, spread, evidence = _each_fifth(readings, looked_for, progress)
    fit = SourcesFitter(readings, looked_for).fit()
    turned = (fit.sign_evidence > LEAST_EVIDENCE) & (evidence > 0.0) & readings.used
    turned &= bool(looked_for)
    sign = np.where(turned, -1.0, 1.0)
    sound = replace(readings, flux=readings.flux * sign[:, None, None])
    held_out = _held_out(sound, predicted, spread, fit, posed.position[:1])
    effects = _reversed(posed.sensors.channel[turned], fit.sign_evidence[turned], evidence[turned])
    model = FieldModel(
        *_dipoles(fit), emitters=emitters, frequencies_hz=generator.frequencies_hz,
        flux_error_t=held_out.flux_error_t, effects=effects,
    )  # fmt: skip
    right = replace(posed, flux=posed.flux * sign[:, None])
    flux = _phasors(sound.flux)[sound.used]
    left = flux - _phasors(fit.predicted)[sound.used]
    strays = sum(len(one.places) - 1 for one in fit.sources)
    return Calibration(
        model=model,
        fit=figures_of(
            readings.points.basis(model.positions, model.directions),
            posed.usable.astype(np.float64),
            float(np.sqrt(np.mean(as_real(left) ** 2))),
            float(len(model.moments)) / len(fit.sources),
            alternations=1,
        ),
        held_out=held_out,
        layout=Layout('sources', strays, 1.0, 0.0, words=WORDS.format(strays)),
        damping=0.0,
        n_measurements=int(posed.usable.sum()),
        residuals=Residuals.of(left, flux),
        scan=Scan((right,), accuracy, effects, noisy),
        undetermined=_unclear(posed, fit, readings.used & ~turned) if looked_for else (),
        more={'sources': _places(emitters, fit), 'sensor_widths': dict(fit.widths)},
    )


def _mean(measured: Measurements, accuracy: Accuracy) -> tuple[SourceReadings, Array]:
    """The frames of a body at rest as one, and each sensor's noise by the median sensor's."""
    good = measured.usable[:, :, None]
    count = np.maximum(measured.usable.sum(axis=0), 1)
    flux = np.where(good, measured.flux, 0.0).sum(axis=0) / count[:, None]
    is_constant = not (measured.flux[measured.usable].imag != 0.0).any()
    parts = flux.real[:, :, None] if is_constant else np.stack([flux.real, flux.imag], axis=2)
    noise, ratio = _noise(measured, flux, parts.shape[2], accuracy)
    rotation = measured.rotation[0]
    points = PlacedPoints.of(measured.sensors, measured.position.mean(axis=0), rotation)
    used = np.asarray(measured.usable.any(axis=0))
    return SourceReadings(points, parts, noise / np.sqrt(count), used), ratio


def _noise(
    measured: Measurements, mean: ComplexArray, parts: int, accuracy: Accuracy
) -> tuple[Array, Array]:
    """Noise of a part of each sensor's reading, T, and its ratio to the median sensor's.

    One frame has no scatter: it is as the setup states.
    """
    count = measured.usable.sum(axis=0)
    freedom = (count - 1) * mean.shape[1] * parts
    stated = np.full(len(mean), accuracy.flux_noise_t)
    if freedom.max() < FEWEST_SCATTERS:
        return stated, np.ones(len(mean))
    left = np.where(measured.usable[:, :, None], measured.flux - mean, 0.0)
    power = (np.abs(left) ** 2).sum(axis=(0, 2))
    is_measured = freedom >= FEWEST_SCATTERS
    scatter = np.sqrt(power / np.maximum(freedom, 1))
    middle = float(np.median(scatter[is_measured]))
    # Few numbers make a scatter too small by chance, and no sensor is that much better.
    noise = np.where(is_measured, np.maximum(scatter, middle), stated)
    return noise, np.where(is_measured, scatter / max(middle, 1e-300), 1.0)


def _each_fifth(
    readings: SourceReadings, kinds: Sequence[str], progress: Progress | None
) -> tuple[Array, Array, Array]:
    """Readings (S, K, C) as the sensors of the other folds predict them, how far they may be off,
    and the evidence (S,) of a reversed sensor.
    """
    predicted, fold = np.zeros_like(readings.flux), np.arange(len(readings.used)) % FOLDS
    spread, evidence = np.ones_like(predicted), np.zeros(len(fold))
    for k in range(FOLDS):
        if progress is not None:
            progress('each fifth of the sensors from the others', k / (FOLDS + 1.0))
        out = fold == k
        part = SourcesFitter(replace(readings, used=readings.used & ~out), kinds).fit()
        predicted[out], spread[out] = part.predicted[out], part.sigma[out]
        evidence[out] = part.sign_evidence[out]
    return predicted, spread, evidence


def _dipoles(fit: SourcesFit) -> tuple[Array, Array, ComplexArray]:
    """Positions, directions and moments (N, K): each source's own dipoles drive it alone."""
    sites = [one.sites for one in fit.sources]
    moments = scipy.linalg.block_diag(*(_phasors(one.moments)[:, None] for one in fit.sources))
    positions, directions = (
        np.concatenate([getattr(one, part) for one in sites])
        for part in ('positions', 'directions')
    )
    return positions, directions, moments.astype(complex)


def _phasors(parts: Array) -> ComplexArray:
    """Complex numbers (...) of their parts (..., C)."""
    return np.asarray(parts[..., 0] + (1j * parts[..., 1] if parts.shape[-1] == 2 else 0.0))


def _held_out(
    sound: SourceReadings, predicted: Array, spread: Array, fit: SourcesFit, place: Array
) -> HeldOut:
    left, used = sound.flux - predicted, sound.used
    error = _phasors(left)[used]
    noise = float(np.median(sound.noise_t[used]))
    excess = float(np.median((left[used] ** 2).mean(axis=(1, 2)))) - noise**2
    return HeldOut(
        error=error,
        left_over=error,
        chi_square=float(np.mean((left / spread)[used] ** 2)),
        noise_t=noise,
        flux_noise_t=noise,
        flux_error_t=float(np.sqrt(max(excess, 0.0))),
        n_dipoles=sum(len(one.moments) for one in fit.sources),
        place=place,
        frame_rmse_t=np.array([rms(error)]),
    )


def _reversed(channels: Integers, evidence: Array, held_out: Array) -> tuple[EffectRecord, ...]:
    """A record of the channels that are the wrong way round, with the least evidence of one."""
    if not channels.size:
        return ()
    least, other = float(evidence.min()), float(held_out.min())
    found = {'log_probability': least, 'held_out_log_probability': other}
    return (EffectRecord('sensor_polarity', {'channels': channels.tolist()}, {}, found),)


def _unclear(posed: Measurements, fit: SourcesFit, others: Booleans) -> tuple[str, ...]:
    """A line for the sensors whose polarity the readings do not determine."""
    rows = np.flatnonzero(others & (fit.sign_evidence >= -LEAST_EVIDENCE))
    if not rows.size:
        return ()
    names = ', '.join(posed.sensors.name[row] for row in rows)
    return (f'polarity: the readings do not determine it for {names}; taken as stated',)


def _places(emitters: tuple[str, ...], fit: SourcesFit) -> list[dict[str, Any]]:
    """Where each emitter was found, in frame fg, and the in-phase part of its moment."""
    return [
        {
            'name': name,
            'position_m': one.places[0].tolist(),
            'sigma_m': float(sigma),
            'moment_am2': one.moments[:3, 0].tolist(),
            'stray_dipoles': len(one.places) - 1,
        }
        for name, one, sigma in zip(emitters, fit.sources, fit.place_sigma_m, strict=True)
    ]
