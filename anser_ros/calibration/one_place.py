"""Calibrates emitters of unknown place by a body of many sensors that rests at one place.

An array of hundreds of sensors around a few coils determines where these are without a pose that
changes (`sources`). One place does not determine each sensor's own error, which other places
would show: it is a width here, no correction, except which way round it is. The held-out error
is that of sensors: each fifth of them predicted by the others, from the start.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.blocks import FOLDS
from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.factors import as_real
from anser_ros.calibration.held_out import HeldOut
from anser_ros.calibration.layout_score import LayoutCandidate
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.moments import MomentFit, Progress
from anser_ros.calibration.population import LEAST_EVIDENCE
from anser_ros.calibration.readings import with_pose
from anser_ros.calibration.requirements import MANY_SENSORS
from anser_ros.calibration.result import Calibration, Residuals, Scan, SourcePlace, provenance
from anser_ros.calibration.sources import KINDS, SourceReadings, SourcesFit, SourcesFitter
from anser_ros.calibration.survey_records import noisy_sensors, reversed_sensors
from anser_ros.errors import FitError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.windings import PlacedPoints
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

STILL = 5.0
"""Standard deviations of the optical jitter within which all poses are one place."""
NOISY = 5.0
"""Times the median noise from which on a sensor is called noisy; its scatter has eight degrees of
freedom with two frames of four emitters, which make such a ratio in no sensor of a thousand."""
FEWEST_SCATTERS = 4
"""Degrees of freedom of a sensor's scatter from which on it is called noisy."""
REACH = 0.1
"""How far beyond the box around the sensors sources are looked for, as a fraction of its longest
side."""


def is_at_one_place(measurements: Sequence[Measurements], accuracy: Accuracy) -> bool:
    """Return whether one body with many sensors rested at one place in all frames."""
    if len(measurements) != 1 or len(measurements[0].sensors) < MANY_SENSORS:
        return False
    one = with_pose(measurements[0])
    if not len(one.time):
        return False
    moved = np.ptp(one.position, axis=0).max() > STILL * accuracy.optical_position_m
    turned = np.abs(one.rotation - one.rotation[0]).max() > STILL * accuracy.optical_rotation_rad
    return not (moved or turned)


@dataclass(frozen=True)
class _Mean:
    """The frames of a body at rest as one, with the noise of each sensor's mean."""

    measured: Measurements
    readings: SourceReadings
    noise_ratio: Array

    @staticmethod
    def of(measured: Measurements, accuracy: Accuracy) -> '_Mean':
        good = measured.usable[:, :, None]
        count = np.maximum(measured.usable.sum(axis=0), 1)
        flux = np.where(good, measured.flux, 0.0).sum(axis=0) / count[:, None]
        is_constant = not (measured.flux[measured.usable].imag != 0.0).any()
        parts = flux.real[:, :, None] if is_constant else np.stack([flux.real, flux.imag], axis=2)
        noise, ratio = _noise(measured, flux, parts.shape[2], accuracy)
        rotation = measured.rotation[0]
        points = PlacedPoints.of(measured.sensors, measured.position.mean(axis=0), rotation)
        used = np.asarray(measured.usable.any(axis=0))
        return _Mean(measured, SourceReadings(points, parts, noise / np.sqrt(count), used), ratio)


def _noise(
    measured: Measurements, mean: NDArray[np.complex128], parts: int, accuracy: Accuracy
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


def calibrate_at_one_place(
    measurements: Measurements,
    name: str,
    emitters: tuple[str, ...],
    frequencies_hz: tuple[float, ...],
    kinds: Sequence[str],
    accuracy: Accuracy,
    progress: Progress | None = None,
) -> Calibration:
    """Find each emitter's place and field, and which sensors are the wrong way round.

    Parameters
    ----------
    measurements : Measurements
        Frames of one body at rest, with poses.
    name : str
        Of the session.
    emitters, frequencies_hz : tuple, length K
        Names of the emitters, and their frequencies, Hz.
    kinds : sequence of str
        Of `KINDS`; others keep the setup's values. With none, sensors are as stated.
    accuracy : Accuracy
        Noise of a single frame.
    progress : callable, optional
        Called with the name of the stage and its finished fraction.

    Raises
    ------
    FitError
        When all fluxes of an emitter are zero.
    """
    posed = with_pose(measurements)
    mean = _Mean.of(posed, accuracy)
    received = mean.readings.flux[mean.readings.used].any(axis=(0, 2))
    if not received.all():
        silent = ', '.join(emitters[k] for k in np.flatnonzero(~received))
        raise FitError(f'{measurements.body}: all fluxes of {silent} are zero')
    looked_for = tuple(kind for kind in KINDS if kind in kinds)
    looked_for += ('polarity',) if looked_for else ()
    fold = np.arange(len(mean.readings.used)) % FOLDS
    foretold = np.zeros_like(mean.readings.flux)
    spread, evidence = np.ones_like(foretold), np.zeros(len(fold))
    for k in range(FOLDS):
        if progress is not None:
            progress('each fifth of the sensors from the others', k / (FOLDS + 1.0))
        out = fold == k
        rest = replace(mean.readings, used=mean.readings.used & ~out)
        part = _fitted(rest, looked_for)
        foretold[out], spread[out] = part.predicted[out], part.sigma[out]
        evidence[out] = part.sign_evidence[out]
    fit = _fitted(mean.readings, looked_for)
    turned = (fit.sign_evidence > LEAST_EVIDENCE) & (evidence > 0.0) & mean.readings.used
    turned &= bool(looked_for)
    sign = np.where(turned, -1.0, 1.0)
    held_out = _held_out(mean, fit, foretold, spread, sign)
    effects = reversed_sensors(
        posed.sensors.channel[turned], fit.sign_evidence[turned], evidence[turned]
    )
    loud = mean.noise_ratio > NOISY
    model = FieldModel(
        *_dipoles(fit), emitters=emitters, frequencies_hz=frequencies_hz,
        flux_error_t=held_out.flux_error_t, effects=effects,
    )  # fmt: skip
    sound = replace(posed, flux=posed.flux * sign[:, None])
    scan = Scan(
        (sound,),
        accuracy,
        effects,
        noisy_sensors(posed.sensors.channel[loud], mean.noise_ratio[loud]),
    )
    calibration = Calibration(
        model, _moment_fit(mean, fit, sign, model), held_out, None, (),
        LayoutCandidate(_layout(fit), DipoleSites(model.positions, model.directions), 0.0,
                        held_out.score_t, ()),
        _layout(fit), 0.0, int(posed.usable.sum()), _residuals(mean, fit, sign), scan,
        sources=_places(emitters, fit), sensor_widths=fit.widths,
        undetermined=_unclear(posed, fit, mean.readings.used & ~turned) if looked_for else (),
    )  # fmt: skip
    return replace(calibration, model=replace(model, provenance=provenance(calibration, [name])))


def _fitted(readings: SourceReadings, kinds: Sequence[str]) -> SourcesFit:
    points = readings.points.points
    low, high = points.min(axis=0), points.max(axis=0)
    margin = REACH * float((high - low).max())
    return SourcesFitter(readings, (low - margin, high + margin), kinds).fit()


def _layout(fit: SourcesFit) -> Layout:
    return Layout('sources', sum(len(one.places) - 1 for one in fit.sources), 1.0, 0.0)


def _dipoles(fit: SourcesFit) -> tuple[Array, Array, NDArray[np.complex128]]:
    """Positions, directions and moments (N, K): each source's own dipoles drive it alone."""
    sites = [one.sites for one in fit.sources]
    moments = np.zeros((sum(map(len, sites)), len(sites)), dtype=complex)
    first = 0
    for k, one in enumerate(fit.sources):
        own = slice(first, first + len(one.moments))
        moments[own, k] = one.moments[:, 0]
        if one.moments.shape[1] == 2:
            moments[own, k] += 1j * one.moments[:, 1]
        first = own.stop
    positions, directions = (
        np.concatenate([getattr(one, part) for one in sites])
        for part in ('positions', 'directions')
    )
    return positions, directions, moments


def _phasors(parts: Array) -> NDArray[np.complex128]:
    """Fluxes (S, K) of their parts (S, K, C)."""
    return np.asarray(parts[..., 0] + (1j * parts[..., 1] if parts.shape[-1] == 2 else 0.0))


def _residuals(mean: _Mean, fit: SourcesFit, sign: Array) -> Residuals:
    used = mean.readings.used
    flux = _phasors(mean.readings.flux * sign[:, None, None])[used]
    left = flux - _phasors(fit.predicted)[used]
    span = float(flux.real.max() - flux.real.min())
    return Residuals(np.sqrt((np.abs(left) ** 2).mean(axis=0)), span)


def _held_out(
    mean: _Mean, fit: SourcesFit, foretold: Array, spread: Array, sign: Array
) -> HeldOut:
    used = mean.readings.used
    left = mean.readings.flux * sign[:, None, None] - foretold
    error = _phasors(left)[used]
    noise = float(np.median(mean.readings.noise_t[used]))
    excess = float(np.median((left[used] ** 2).mean(axis=(1, 2)))) - noise**2
    return HeldOut(
        error, error, float(np.mean((left / spread)[used] ** 2)), noise, noise,
        float(np.sqrt(max(excess, 0.0))), sum(len(one.moments) for one in fit.sources),
        mean.measured.position[:1], np.array([np.sqrt(np.mean(np.abs(error) ** 2))]),
        gap_factor=1.0,
    )  # fmt: skip


def _moment_fit(mean: _Mean, fit: SourcesFit, sign: Array, model: FieldModel) -> MomentFit:
    basis = mean.readings.points.basis(model.positions, model.directions)
    size = np.linalg.svd(basis / np.linalg.norm(basis, axis=0), compute_uv=False)
    left = (mean.readings.flux * sign[:, None, None] - fit.predicted)[mean.readings.used]
    noise = float(np.sqrt(np.mean(as_real(_phasors(left)) ** 2)))
    return MomentFit(
        model.moments, (mean.measured,), (mean.measured.usable.astype(np.float64),), noise, noise,
        int((size > size[0] * len(basis) * np.finfo(float).eps).sum()),
        float(len(model.moments)) / len(fit.sources),
        float(size[0] / max(size[-1], np.finfo(float).tiny)), 1,
    )  # fmt: skip


def _unclear(posed: Measurements, fit: SourcesFit, others: Mask) -> tuple[str, ...]:
    """A line for the sensors whose polarity the readings do not determine."""
    rows = np.flatnonzero(others & (fit.sign_evidence >= -LEAST_EVIDENCE))
    if not rows.size:
        return ()
    names = ', '.join(posed.sensors.name[row] for row in rows)
    return (f'polarity: the readings do not determine it for {names}; taken as stated',)


def _places(emitters: tuple[str, ...], fit: SourcesFit) -> tuple[SourcePlace, ...]:
    return tuple(
        SourcePlace(
            name, one.places[0], float(sigma), one.moments[:3, 0], len(one.places) - 1
        )
        for name, one, sigma in zip(emitters, fit.sources, fit.place_sigma_m, strict=True)
    )  # fmt: skip
