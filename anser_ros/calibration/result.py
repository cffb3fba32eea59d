"""Holds the result of a calibration with its residuals and its provenance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.factors import as_real
from anser_ros.calibration.held_out import HeldOut, rms
from anser_ros.calibration.layout_score import LayoutCandidate
from anser_ros.calibration.layouts import Layout
from anser_ros.calibration.moments import MomentFit
from anser_ros.calibration.readings import usable_readings
from anser_ros.calibration.survey_result import SurveyResult
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord, FieldModel
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Residuals:
    """Holds the residuals of a model at the measured poses.

    Attributes
    ----------
    each_t : ndarray, shape (K,)
        Root mean square of the magnitude of each emitter's complex residual, T.
    span_t : float
        Range of the measured in-phase fluxes, T.
    """

    each_t: Array
    span_t: float

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
    """Holds a scan as ideal sensors and an ideal clock would have given it.

    Attributes
    ----------
    measurements : tuple of Measurements
        The frames that are used, one per body and session.
    accuracy : Accuracy
        Noise and jitter, estimated where they were.
    corrections : tuple of EffectRecord
        What was wrong with sensors and clock; the model corrects it.
    reported_effects : tuple of EffectRecord
        What the scan contained besides.
    survey : SurveyResult or None
        How that was found; None where nothing was estimated.
    field_sigma_t : float
        Standard deviation of what was taken off the fluxes, T a phasor component: the field that
        is learnt from them is no better.
    """

    measurements: tuple[Measurements, ...]
    accuracy: Accuracy
    corrections: tuple[EffectRecord, ...] = ()
    reported_effects: tuple[EffectRecord, ...] = ()
    survey: SurveyResult | None = None
    field_sigma_t: float = 0.0


@dataclass(frozen=True)
class SourcePlace:
    """States where an emitter of unknown place was found.

    Attributes
    ----------
    name : str
        Of the emitter.
    position_m, moment_am2 : ndarray, shape (3,)
        Place, and the in-phase part of its moment, frame fg.
    sigma_m : float
        Standard deviation of the place, root of the sum over three axes.
    stray_dipoles : int
        Dipoles that describe its stray field.
    """

    name: str
    position_m: Array
    sigma_m: float
    moment_am2: Array
    stray_dipoles: int


@dataclass(frozen=True)
class Calibration:
    """Holds a field model with the figures of its fit and of its choice.

    Attributes
    ----------
    model : FieldModel
        The calibrated field model.
    fit : MomentFit
        The fit of the moments to all readings.
    held_out : HeldOut
        Held-out errors of the chosen layout, with every fold fitted from the start.
    nominal_rmse_t : float or None
        Root mean square of the magnitude of the nominal model's residual on the same readings, T;
        None without a nominal model.
    candidates : tuple of LayoutCandidate
        All layouts that were compared.
    chosen : LayoutCandidate
        The chosen one of them.
    layout : Layout
        The chosen layout.
    damping : float
        The damping of the fit, chosen or given.
    n_measurements : int
        Number of readings of each emitter.
    residuals : Residuals
        Residuals of the model on all readings that it was fitted to.
    scan : Scan
        The scan with what was wrong with it.
    contradictions : tuple of str
        A line for every sensor of which two sessions say different things.
    sources : tuple of SourcePlace
        Of the emitters whose places are not in the setup, where these were found.
    sensor_widths : mapping of str to float
        Standard deviations of the sensors' places (m), axes (rad) and gains, where only these can
        be told.
    undetermined : tuple of str
        Lines on what the readings of one place do not determine: the polarity of some sensors.
    """

    model: FieldModel
    fit: MomentFit
    held_out: HeldOut
    nominal_rmse_t: float | None
    candidates: tuple[LayoutCandidate, ...]
    chosen: LayoutCandidate
    layout: Layout
    damping: float
    n_measurements: int
    residuals: Residuals
    scan: Scan
    contradictions: tuple[str, ...] = ()
    sources: tuple[SourcePlace, ...] = ()
    sensor_widths: Mapping[str, float] = field(default_factory=dict)
    undetermined: tuple[str, ...] = ()

    @property
    def better_than_nominal(self) -> bool:
        """Return whether the held-out error is below the nominal model's, or nothing compares."""
        return self.nominal_rmse_t is None or rms(self.held_out.error) < self.nominal_rmse_t


def provenance(calibration: Calibration, names: Sequence[str]) -> Mapping[str, Any]:
    """Return how the model was made, as plain data for its file."""
    held_out = calibration.held_out
    return {
        'method': 'calibration',
        'sessions': list(dict.fromkeys(names)),
        'n_measurements': calibration.n_measurements,
        'layout': calibration.layout.describe(),
        'damping': calibration.damping,
        'rank': calibration.fit.rank,
        'condition': calibration.fit.condition,
        'noise_t': calibration.fit.noise_t,
        'heldout_flux_rmse_t': rms(held_out.error),
        'heldout_marginal_rmse_t': float(np.sqrt(np.mean(as_real(held_out.left_over) ** 2))),
        'heldout_chi_square': held_out.chi_square,
        'flux_error_t': calibration.model.flux_error_t,
        'nominal_flux_rmse_t': calibration.nominal_rmse_t,
    }
