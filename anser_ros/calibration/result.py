"""Holds the result of a calibration, and makes the document ``calibration.json`` of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.held_out import HeldOut, rms
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.least_squares import as_real
from anser_ros.calibration.moments import FitFigures
from anser_ros.calibration.population import OpticalNoise
from anser_ros.calibration.readings import usable_readings
from anser_ros.calibration.requirements import FEWEST_SCAN_FRAMES
from anser_ros.calibration.selection import LayoutCandidate
from anser_ros.calibration.sensor_fit import SensorFit
from anser_ros.calibration.sensor_records import undetermined_words
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord, FieldModel, plain
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Residuals:
    """Holds the residuals of a model at the measured poses."""

    each_t: Array  # (K,): root mean square of the magnitude of each emitter's complex residual, T
    span_t: float  # range of the measured in-phase fluxes, T

    @property
    def rmse_t(self) -> float:
        """Return the root mean square over the readings of all emitters, T."""
        return float(np.sqrt(np.mean(self.each_t**2)))


def residuals(measurements: Sequence[Measurements], model: FieldModel) -> Residuals:
    """Return a model's residuals of the usable readings at the measured poses."""
    power, count = np.zeros(len(model.emitters)), 0
    low, high = np.inf, -np.inf
    for points, axes, lengths, flux in usable_readings(measurements):
        error = flux - model.flux(points, axes, lengths)
        power, count = power + (np.abs(error) ** 2).sum(axis=0), count + len(error)
        low, high = min(low, float(flux.real.min())), max(high, float(flux.real.max()))
    return Residuals(np.sqrt(power / count), high - low)


@dataclass(frozen=True)
class Scan:
    """Holds a scan as ideal sensors and an ideal clock would have given it."""

    measurements: tuple[Measurements, ...]  # the frames that are used, one per body and session
    accuracy: Accuracy  # noise and jitter, estimated where they were
    # what was wrong with sensors and clock; the model corrects it
    corrections: tuple[EffectRecord, ...] = ()
    reported_effects: tuple[EffectRecord, ...] = ()  # what the scan contained besides
    sensor_fit: SensorFit | None = None  # how that was found; None where nothing was estimated
    # standard deviation of what was taken off the fluxes, T a phasor component: the field that is
    # learnt from them is no better
    field_sigma_t: float = 0.0


@dataclass(frozen=True)
class Calibration:
    """Holds a field model with the figures of its fit and of its choice."""

    model: FieldModel
    fit: FitFigures  # of the moments, to all readings
    held_out: HeldOut  # of the chosen layout, with every fold fitted from the start
    layout: Layout  # chosen or given, as is the damping
    damping: float
    n_measurements: int  # readings of each emitter
    residuals: Residuals  # on all readings that the model was fitted to
    scan: Scan  # with what was wrong with it
    # root mean square of the magnitude of the nominal model's residual on the same readings, T
    nominal_rmse_t: float | None = None
    candidates: tuple[LayoutCandidate, ...] = ()  # all layouts that were compared
    contradictions: tuple[str, ...] = ()  # a line for everything of which two sessions disagree
    undetermined: tuple[str, ...] = ()  # lines on what the readings cannot determine
    # sections that only some engine's calibrations have in their document, as plain data
    more: Mapping[str, Any] = field(default_factory=dict)

    @property
    def better_than_nominal(self) -> bool:
        """Return whether the held-out error is below the nominal model's, or nothing compares."""
        return self.nominal_rmse_t is None or rms(self.held_out.error) < self.nominal_rmse_t


def with_provenance(calibration: Calibration, names: Sequence[str]) -> Calibration:
    """Return a calibration whose model says for its file how it was made, of named sessions."""
    held_out, fit = calibration.held_out, calibration.fit
    provenance = {
        'method': 'calibration',
        'sessions': list(dict.fromkeys(names)),
        'n_measurements': calibration.n_measurements,
        'layout': calibration.layout.describe(),
        'damping': calibration.damping,
        'rank': fit.rank,
        'condition': fit.condition,
        'noise_t': fit.noise_t,
        'heldout_flux_rmse_t': rms(held_out.error),
        'heldout_marginal_rmse_t': float(np.sqrt(np.mean(as_real(held_out.left_over) ** 2))),
        'heldout_chi_square': held_out.chi_square,
        'flux_error_t': calibration.model.flux_error_t,
        'nominal_flux_rmse_t': calibration.nominal_rmse_t,
    }
    return replace(calibration, model=replace(calibration.model, provenance=provenance))


OUTLIER_WEIGHT = 0.25
"""A reading whose weight fell below this counts as an outlier: its residual is twice as large as
the one from which on readings lose weight."""


def to_document(calibration: Calibration) -> dict[str, Any]:
    """Return the figures of a calibration as plain data.

    Errors are root mean squares of the complex residual's magnitude at the measured poses; the
    normalised ones are divided by the range of the measured in-phase fluxes (article, equation 8).
    """
    held_out, scan = calibration.held_out, calibration.scan
    inside, span = calibration.residuals, calibration.residuals.span_t
    each = zip(calibration.model.emitters, inside.each_t, held_out.error.T, strict=True)
    nominal = calibration.nominal_rmse_t
    return {
        'schema': 'anser_calibration/1',
        'n_measurements': calibration.n_measurements,
        'n_dipoles': len(calibration.model.positions),
        'flux_rmse_t': inside.rmse_t,
        'heldout_flux_rmse_t': rms(held_out.error),
        'heldout_n_rmse_percent': 100.0 * rms(held_out.error) / span,
        'heldout_n_mae_percent': 100.0 * float(np.abs(held_out.error).mean()) / span,
        'emitters': [
            {'name': name, 'flux_rmse_t': float(fitted), 'heldout_flux_rmse_t': rms(outside)}
            for name, fitted, outside in each
        ],
        'marginal': {
            'noise_t': held_out.noise_t,
            'flux_noise_t': held_out.flux_noise_t,
            'heldout_component_rmse_t': float(np.sqrt(np.mean(as_real(held_out.left_over) ** 2))),
            'heldout_chi_square': held_out.chi_square,
            'flux_error_t': held_out.flux_error_t,
            'fit_noise_t': calibration.fit.noise_t,
            'outlier_fraction': _outlier_fraction(calibration.fit.weights),
        },
        **_by_pose(held_out),
        'choice': {
            'layout': calibration.layout.describe(),
            'damping': calibration.damping,
            'rank': calibration.fit.rank,
            'condition': calibration.fit.condition,
            'freedom': calibration.fit.freedom,
            'alternations': calibration.fit.alternations,
            'curve': [
                {
                    'layout': c.layout.describe(),
                    'n_dipoles': len(c.dipoles),
                    'damping': damping,
                    'heldout_t': score,
                }
                for c in calibration.candidates
                for damping, score in c.curve
            ],
        },
        'nominal_flux_rmse_t': nominal,
        'effects': [_effect(record) for record in (*scan.corrections, *scan.reported_effects)],
        'unobservable': [
            *([] if scan.sensor_fit is None else undetermined_words(scan.sensor_fit)),
            *calibration.undetermined,
        ],
        **calibration.more,
        'shift_sigma_m': calibration.model.shift_sigma_m,
        'contradictions': list(calibration.contradictions),
        'optical_noise': None if scan.sensor_fit is None else _optical(scan.sensor_fit.optical),
    }


def _by_pose(held_out: HeldOut) -> dict[str, Any]:
    """Errors of single poses, where so few were recorded that each is worth a look."""
    if len(held_out.place) >= FEWEST_SCAN_FRAMES:
        return {}
    order = np.lexsort(held_out.place.T)
    return {
        'heldout_by_pose': [
            {
                'position_m': held_out.place[k].tolist(),
                'flux_rmse_t': float(held_out.frame_rmse_t[k]),
            }
            for k in order
        ]
    }


def _effect(record: EffectRecord) -> dict[str, Any]:
    return {
        'name': record.name,
        'parameters': plain(dict(record.parameters)),
        'uncertainty': plain(dict(record.uncertainty)),
        'evidence': plain(dict(record.evidence)),
    }


def _optical(noise: OpticalNoise) -> dict[str, Any]:
    relative = noise.relative_uncertainty
    return {
        'position_m': noise.position_m,
        'rotation_rad': noise.rotation_rad,
        'uncertainty': {
            'position_m': relative * noise.position_m,
            'rotation_rad': relative * noise.rotation_rad,
        },
    }


def _outlier_fraction(weights: Sequence[NDArray[np.float64]]) -> float:
    every = np.concatenate([w.ravel() for w in weights])
    return float((every[every > 0.0] < OUTLIER_WEIGHT).mean())
