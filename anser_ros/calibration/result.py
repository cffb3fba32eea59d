"""Holds the result of a calibration with its residuals and its provenance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.factors import as_real
from anser_ros.calibration.held_out import HeldOut, rms
from anser_ros.calibration.layout_score import LayoutCandidate
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.moments import FitFigures
from anser_ros.calibration.readings import usable_readings
from anser_ros.calibration.survey_result import SensorFit
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord, FieldModel
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
