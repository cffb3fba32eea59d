"""From measurements to a field model: refusals, choice by held-out error, fit, honest figures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.fitting.blocks import fold_of_frames
from anser_ros.fitting.held_out import HeldOut, predict_held_out
from anser_ros.fitting.layout_fit import LayoutFit, fit_layout
from anser_ros.fitting.layouts import Generator, Layout, place
from anser_ros.fitting.measurements import Measurements
from anser_ros.fitting.model import EffectRecord, FieldModel
from anser_ros.fitting.moments import (
    ComplexArray,
    MomentFit,
    Progress,
    Uncertainty,
    as_real,
    with_pose,
)
from anser_ros.fitting.prior import DrawnBoard
from anser_ros.fitting.selection import (
    WORTH,
    Candidate,
    Selection,
    choose_layout,
    thin_frames,
)
from anser_ros.fitting.sensor_survey import SensorSurveyor

Array = NDArray[np.float64]

FEWEST_FRAMES = 10
FLATTEST = 0.002
"""Thickness (rms) of the cloud of sensors that the fit needs, as a part of its extent."""
DISAGREEMENT = 10.0
"""Sessions whose common fit leaves this many times what each alone leaves: different boards."""


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


def rms(error: ComplexArray) -> float:
    """Root of the mean squared magnitude of complex errors."""
    return float(np.sqrt(np.mean(np.abs(error) ** 2)))


def check_measurements(measurements: Sequence[Measurements], needed: int) -> int:
    """Refuse what can't determine a field model; returns the number of readings an emitter.

    Raises
    ------
    FitError
        With the number needed and the number found: frames with a pose, readings, thickness.
    """
    if not measurements:
        raise FitError(
            f'a calibration needs at least {FEWEST_FRAMES} frames of tool fluxes with poses, '
            'got 0: no session has tool fluxes'
        )
    for m in measurements:
        if not m.has_pose.any():
            raise FitError(
                f'{m.body}: a calibration needs at least {FEWEST_FRAMES} frames with a pose, '
                f'got 0 of {len(m.time)} (is /optical/{m.body}/pose recorded?)'
            )
    frames = sum(int(m.usable.any(axis=1).sum()) for m in measurements)
    if frames < FEWEST_FRAMES:
        raise FitError(
            f'a calibration needs at least {FEWEST_FRAMES} frames with poses and valid fluxes, '
            f'got {frames}'
        )
    readings = sum(int(m.usable.sum()) for m in measurements)
    if readings < needed:
        raise FitError(
            f'{needed} dipoles need at least {needed} readings an emitter, got {readings}'
        )
    _check_thickness(measurements)
    return readings


def _check_thickness(measurements: Sequence[Measurements]) -> None:
    points = np.concatenate([m.placed()[0][m.usable] for m in measurements])
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    need = FLATTEST * float(spread[0])
    if spread[-1] < need or spread[0] < 1e-3:
        raise FitError(
            f'all readings lie in one plane: their spread across it must be at least '
            f'{1e3 * max(need, 0.05):.2f} mm rms, got {1e3 * spread[-1]:.2f} mm'
        )


def check_agreement(
    measurements: Sequence[Measurements],
    names: Sequence[str],
    joint: MomentFit,
    fit_part: Callable[[list[Measurements]], LayoutFit],
) -> None:
    """Refuse sessions that one field can't explain.

    Parameters
    ----------
    measurements, names
        One session's name for each set of measurements.
    joint : MomentFit
        Fit of all together.
    fit_part : callable
        Fits some of the measurements alone in the same way.

    Raises
    ------
    FitError
        When the common fit leaves `DISAGREEMENT` times what the sessions leave alone.
    """
    sessions = list(dict.fromkeys(names))
    if len(sessions) < 2:
        return
    alone = [
        fit_part([m for m, name in zip(measurements, names, strict=True) if name == session])
        for session in sessions
    ]
    worst = max(part.fit.noise_t for part in alone)
    if joint.noise_t > DISAGREEMENT * worst:
        raise FitError(
            f'the sessions are of different boards: one field leaves {joint.noise_t:.3g} T, '
            f'more than {DISAGREEMENT:g} times the {worst:.3g} T that each leaves alone'
        )


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
    """The one with the fewest dipoles whose held-out error is the least to within `WORTH`."""
    limit = min(final[2].score_t for final in finals) * (1.0 + WORTH)
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


def to_document(calibration: Calibration) -> dict[str, Any]:
    """The contract's calibration document, with further keys of our own.

    Errors are root mean squares of the complex residual's magnitude at the measured poses; the
    normalised ones are divided by the range of the measured in-phase fluxes (article, equation 8).
    """
    held_out = calibration.held_out
    span = float(np.ptp(calibration.flux.real))
    each = zip(calibration.model.emitters, calibration.error.T, held_out.error.T, strict=True)
    nominal = calibration.nominal_rmse_t
    return {
        'schema': 'anser_calibration/1',
        'n_measurements': calibration.n_measurements,
        'n_dipoles': len(calibration.model.positions),
        'flux_rmse_t': rms(calibration.error),
        'heldout_flux_rmse_t': rms(held_out.error),
        'heldout_n_rmse_percent': 100.0 * rms(held_out.error) / span,
        'heldout_n_mae_percent': 100.0 * float(np.abs(held_out.error).mean()) / span,
        'emitters': [
            {'name': name, 'flux_rmse_t': rms(inside), 'heldout_flux_rmse_t': rms(outside)}
            for name, inside, outside in each
        ],
        'marginal': {
            'noise_t': held_out.noise_t,
            'heldout_component_rmse_t': float(np.sqrt(np.mean(as_real(held_out.left_over) ** 2))),
            'heldout_chi_square': held_out.chi_square,
            'flux_error_t': held_out.flux_error_t,
            'fit_noise_t': calibration.fit.noise_t,
            'outlier_fraction': _outlier_fraction(calibration.fit),
        },
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
    }


def _outlier_fraction(fit: MomentFit) -> float:
    weights = np.concatenate([w.ravel() for w in fit.weights])
    return float((weights[weights > 0.0] < 0.25).mean())
