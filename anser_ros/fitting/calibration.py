"""From measurements to a field model: refusals, choice by held-out error, fit, honest figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.fitting.blocks import fold_of_frames
from anser_ros.fitting.factors import ComplexArray, as_real
from anser_ros.fitting.held_out import HeldOut, predict_held_out, rms
from anser_ros.fitting.layout_fit import LayoutFit, fit_layout
from anser_ros.fitting.layouts import Generator, Layout, place
from anser_ros.fitting.measurements import Measurements
from anser_ros.fitting.model import EffectRecord, FieldModel
from anser_ros.fitting.moments import MomentFit, Progress
from anser_ros.fitting.pose_correction import Uncertainty, with_pose
from anser_ros.fitting.prior import DrawnBoard
from anser_ros.fitting.requirements import check_agreement, check_measurements
from anser_ros.fitting.selection import (
    WORTH_MANY,
    Candidate,
    Selection,
    choose_layout,
    thin_frames,
)
from anser_ros.fitting.sensor_survey import SensorSurveyor

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
    candidates : tuple of Candidate
        All that were compared.
    chosen : Candidate
    layout : Layout
    damping : float
    n_measurements : int
        Readings an emitter.
    error, flux : ndarray, shape (P, K), complex
        Residual at the measured poses, and the measured fluxes, T.
    """

    model: FieldModel
    fit: MomentFit
    held_out: HeldOut
    nominal_rmse_t: float | None
    candidates: tuple[Candidate, ...]
    chosen: Candidate
    layout: Layout
    damping: float
    n_measurements: int
    error: ComplexArray
    flux: ComplexArray

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
    finals = [
        _final(posed, thin, folds, candidate, generator, options, nominal, selection, progress)
        for candidate in selection.finalists
    ]
    chosen, whole, held_out = _better(finals)
    dipoles, fit = whole.dipoles, whole.fit
    damping = chosen.damping if options.damping is None else options.damping
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
    error, flux = _residual(posed, model)
    calibration = Calibration(
        model, fit, held_out, _nominal_rms(posed, nominal), selection.candidates,
        chosen, chosen.layout, damping, readings, error, flux,
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


Final = tuple[Candidate, LayoutFit, HeldOut]


def _fitter(
    candidate: Candidate, generator: Generator, options: Options, nominal: FieldModel | None
) -> Callable[[list[Measurements]], LayoutFit]:
    damping = candidate.damping if options.damping is None else options.damping

    def fit(part: list[Measurements]) -> LayoutFit:
        return fit_layout(
            part, candidate.layout, damping, generator, options.uncertainty, nominal,
            alternations=3, exact=False,
        )  # fmt: skip

    return fit


def _final(
    posed: Sequence[Measurements],
    thin: Sequence[Measurements],
    folds: Sequence[NDArray[np.int64]],
    candidate: Candidate,
    generator: Generator,
    options: Options,
    nominal: FieldModel | None,
    selection: Selection,
    progress: Progress | None,
) -> Final:
    """The candidate fitted to everything, and its held-out error, every fold from the start."""
    damping = candidate.damping if options.damping is None else options.damping
    whole = fit_layout(
        posed, candidate.layout, damping, generator, options.uncertainty, nominal,
        progress=progress,
    )  # fmt: skip
    noise = min(whole.fit.noise_t, selection.reference.noise_t)
    fitter = _fitter(candidate, generator, options, nominal)
    return candidate, whole, predict_held_out(thin, folds, fitter, options.uncertainty, noise)


def _better(finals: Sequence[Final]) -> Final:
    """The one with the fewest dipoles whose held-out error is the least to within `WORTH_MANY`."""
    limit = min(final[2].score_t for final in finals) * (1.0 + WORTH_MANY)
    good = [final for final in finals if final[2].score_t <= limit]
    return min(good, key=lambda final: (len(final[1].dipoles), final[2].score_t))


def _residual(
    measurements: Sequence[Measurements], model: FieldModel
) -> tuple[ComplexArray, ComplexArray]:
    errors, fluxes = [], []
    for m in measurements:
        points, axes = m.placed()
        used = m.usable
        lengths = np.broadcast_to(m.sensors.length, used.shape)[used]
        errors.append(m.flux[used] - model.flux(points[used], axes[used], lengths))
        fluxes.append(m.flux[used])
    return np.concatenate(errors), np.concatenate(fluxes)


def _nominal_rms(measurements: Sequence[Measurements], nominal: FieldModel | None) -> float | None:
    return None if nominal is None else rms(_residual(measurements, nominal)[0])


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
