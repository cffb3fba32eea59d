"""From measurements to a field model: refusals, choice by held-out error, fit, honest figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.blocks import fold_of_frames
from anser_ros.calibration.factors import as_real
from anser_ros.calibration.held_out import HeldOut, predict_held_out, rms
from anser_ros.calibration.layout_fit import LayoutFit, fit_layout
from anser_ros.calibration.layouts import Generator, Layout, place
from anser_ros.calibration.moments import MomentFit, Progress
from anser_ros.calibration.pose_correction import Uncertainty, frame_blocks, with_pose
from anser_ros.calibration.prior import DrawnBoard
from anser_ros.calibration.requirements import check_agreement, check_measurements
from anser_ros.calibration.selection import (
    WORTH_MANY,
    LayoutCandidate,
    Selection,
    choose_layout,
    thin_frames,
)
from anser_ros.calibration.sensor_survey import SensorSurveyor
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import EffectRecord, FieldModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Options:
    """What a calibration may be told.

    Attributes
    ----------
    uncertainty : Uncertainty
    layout : Layout or None
        The dipoles asked for; chosen by held-out error when not given.
    damping : float or None
        Likewise.
    estimate : tuple of str
        What is found of the sensors together with the field: `sensor_survey.KINDS`.
    """

    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    layout: Layout | None = None
    damping: float | None = None
    estimate: tuple[str, ...] = ()


@dataclass(frozen=True)
class Calibration:
    """A field model with everything that was learnt on the way.

    Attributes
    ----------
    model : FieldModel
    fit : MomentFit
    held_out : HeldOut
        Of the chosen layout, every fold fitted from the start.
    nominal_rmse_t : float or None
        Residual of the nominal model on the same readings, root mean square of the magnitude.
    candidates : tuple of LayoutCandidate
        All that were compared.
    chosen : LayoutCandidate
    layout : Layout
    damping : float
    n_measurements : int
        Readings an emitter.
    residuals : Residuals
        Of the model on everything it was fitted to.
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
    residuals: 'Residuals'

    @property
    def better_than_nominal(self) -> bool:
        """Whether the held-out error is below the nominal model's, where there is one."""
        return self.nominal_rmse_t is None or rms(self.held_out.error) < self.nominal_rmse_t


def calibrate(
    measurements: Sequence[Measurements],
    names: Sequence[str],
    generator: Generator,
    emitters: tuple[str, ...],
    frequencies_hz: tuple[float, ...],
    options: Options | None = None,
    nominal: FieldModel | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Fit a field model to measurements.

    Parameters
    ----------
    measurements : sequence of Measurements
        One a body and session; the optical poses are the reference.
    names : sequence of str
        Session of each.
    generator : Generator
    emitters, frequencies_hz
        Of the setup.
    options : Options, optional
    nominal : FieldModel, optional
        What the result must beat on held-out data.
    progress : callable, optional
        Called with the name of the stage and its finished share.

    Raises
    ------
    FitError
        When the measurements can't determine the model.
    """
    options = options or Options()
    asked = 36 if options.layout is None else len(place(options.layout, generator))
    readings = check_measurements(measurements, asked)
    posed, effects = _surveyed([with_pose(m) for m in measurements], generator, options)
    thin = thin_frames(posed)
    folds = fold_of_frames([m.position for m in thin])
    drawn = None if nominal is None else DrawnBoard(nominal, thin)
    selection = choose_layout(
        thin, folds, generator, options.uncertainty, progress, options.layout, drawn
    )
    tested = [
        (candidate, _tested(candidate, thin, folds, generator, options, nominal, selection))
        for candidate in selection.finalists
    ]
    chosen, held_out = _better(tested)
    damping = chosen.damping if options.damping is None else options.damping
    whole = fit_layout(
        posed, chosen.layout, damping, generator, options.uncertainty, nominal, progress=progress
    )
    dipoles, fit = whole.dipoles, whole.fit
    check_agreement(posed, names, fit, _fitter(chosen, generator, options, nominal))
    model = FieldModel(
        positions=dipoles.positions,
        directions=dipoles.directions,
        moments=fit.moments,
        emitters=emitters,
        frequencies_hz=frequencies_hz,
        flux_error_t=held_out.flux_error_t,
        effects=effects,
    )
    calibration = Calibration(
        model, fit, held_out, None if nominal is None else residuals(posed, nominal).rmse_t,
        selection.candidates, chosen, chosen.layout, damping, readings, residuals(posed, model),
    )  # fmt: skip
    return replace(calibration, model=replace(model, provenance=provenance(calibration, names)))


def _surveyed(
    posed: list[Measurements], generator: Generator, options: Options
) -> tuple[list[Measurements], tuple[EffectRecord, ...]]:
    """The measurements with their sensors as found, and the records that say so."""
    if not options.estimate:
        return posed, ()
    surveyor = SensorSurveyor(posed, options.estimate, generator, options.uncertainty)
    surveys = surveyor.fit()
    records = tuple(record for survey in surveys.values() for record in survey.records)
    return [surveys[m.body].apply(m) for m in posed], records


def _fitter(
    candidate: LayoutCandidate, generator: Generator, options: Options, nominal: FieldModel | None
) -> Callable[[list[Measurements]], LayoutFit]:
    damping = candidate.damping if options.damping is None else options.damping

    def fit(part: list[Measurements]) -> LayoutFit:
        return fit_layout(
            part, candidate.layout, damping, generator, options.uncertainty, nominal,
            alternations=3, exact=False,
        )  # fmt: skip

    return fit


def _tested(
    candidate: LayoutCandidate,
    thin: Sequence[Measurements],
    folds: Sequence[NDArray[np.int64]],
    generator: Generator,
    options: Options,
    nominal: FieldModel | None,
    selection: Selection,
) -> HeldOut:
    """The candidate's held-out error, every fold fitted from the start."""
    fitter = _fitter(candidate, generator, options, nominal)
    reference = selection.reference
    return predict_held_out(
        thin, folds, fitter, options.uncertainty, reference.noise_t, reference.quadrature_noise_t
    )


def _better(tested: Sequence[tuple[LayoutCandidate, HeldOut]]) -> tuple[LayoutCandidate, HeldOut]:
    """The one with the fewest dipoles whose held-out error is the least to within `WORTH_MANY`."""
    limit = min(held_out.score_t for _, held_out in tested) * (1.0 + WORTH_MANY)
    good = [pair for pair in tested if pair[1].score_t <= limit]
    return min(good, key=lambda pair: (pair[1].n_dipoles, pair[1].score_t))


@dataclass(frozen=True)
class Residuals:
    """What a model leaves of measurements at the measured poses.

    Attributes
    ----------
    each_t : ndarray, shape (K,)
        Root mean square of the complex residual's magnitude, T.
    span_t : float
        Range of the measured in-phase fluxes, T.
    """

    each_t: Array
    span_t: float

    @property
    def rmse_t(self) -> float:
        """Over all emitters, T."""
        return float(np.sqrt(np.mean(self.each_t**2)))


def residuals(measurements: Sequence[Measurements], model: FieldModel) -> Residuals:
    """Sum up a model's residuals, block by block."""
    power, count = np.zeros(len(model.emitters)), 0
    low, high = np.inf, -np.inf
    for whole in measurements:
        for block in frame_blocks(len(whole.time), len(whole.sensors)):
            m = whole.frames(block)  # type: ignore[arg-type]
            points, axes = m.placed()
            used = m.usable
            if not used.any():
                continue
            lengths = np.broadcast_to(m.sensors.length, used.shape)[used]
            error = m.flux[used] - model.flux(points[used], axes[used], lengths)
            power, count = power + (np.abs(error) ** 2).sum(axis=0), count + len(error)
            low = min(low, float(m.flux[used].real.min()))
            high = max(high, float(m.flux[used].real.max()))
    return Residuals(np.sqrt(power / count), high - low)


def provenance(calibration: Calibration, names: Sequence[str]) -> Mapping[str, Any]:
    """Where the model comes from, for its file."""
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
        'flux_error_t': held_out.flux_error_t,
        'nominal_flux_rmse_t': calibration.nominal_rmse_t,
    }
