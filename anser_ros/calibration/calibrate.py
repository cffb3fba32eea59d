"""Calibrates a field model: checks, choice by held-out error, and the final fit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.blocks import fold_of_frames
from anser_ros.calibration.held_out import HeldOut, predict_held_out
from anser_ros.calibration.layout_fit import LayoutFit, LayoutFitter
from anser_ros.calibration.layout_score import DAMPINGS, LayoutCandidate
from anser_ros.calibration.layouts import Generator, Layout, place
from anser_ros.calibration.moments import Progress
from anser_ros.calibration.prior import DrawnBoard
from anser_ros.calibration.readings import with_pose
from anser_ros.calibration.requirements import check_agreement, check_kept, check_measurements
from anser_ros.calibration.result import Calibration, Scan, provenance, residuals
from anser_ros.calibration.scan_gaps import gaps_of
from anser_ros.calibration.selection import (
    COUNTS,
    LOSS_FOR_A_THIRD,
    Selection,
    choose_layout,
    thin_frames,
)
from anser_ros.calibration.sensor_survey import SensorSurveyor
from anser_ros.calibration.source_size import source_sizes
from anser_ros.calibration.survey_records import (
    contradiction_words,
    corrections,
    reported_effects,
    size_records,
)
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.settings import Accuracy

Array = NDArray[np.float64]

FEW_SENSORS = 1.0 / 3.0
"""Share of the sensors of which sessions may say different things and be of one board."""


@dataclass(frozen=True)
class Options:
    """Holds the options of a calibration.

    Attributes
    ----------
    accuracy : Accuracy
        Flux noise and pose jitter.
    layout : Layout or None
        Layout of the dipoles; chosen by held-out error by default.
    damping : float or None
        Damping of the moments; chosen by held-out error by default.
    estimate : tuple of str
        What is estimated of sensors and clock together with the field, of
        `sensor_parameters.KINDS`. Whatever is, frames whose pose or field is bad are left
        out then, and the optical jitter is estimated.
    """

    accuracy: Accuracy = field(default_factory=Accuracy)
    layout: Layout | None = None
    damping: float | None = None
    estimate: tuple[str, ...] = ()


def fit_scan(
    scan: Scan,
    names: Sequence[str],
    generator: Generator,
    emitters: tuple[str, ...],
    frequencies_hz: tuple[float, ...],
    options: Options,
    nominal: FieldModel | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """Choose and fit a field model to a scan that was surveyed.

    Parameters
    ----------
    scan : Scan
        What `survey` made of the measurements.
    names : sequence of str
        Name of the session of each of the measurements.
    generator : Generator
        Places of the coils.
    emitters : tuple of str, length K
        Names of the emitters.
    frequencies_hz : tuple of float, length K
        Drive frequencies, Hz.
    options : Options
        Uncertainties, and what not to choose.
    nominal : FieldModel, optional
        The drawn board: a prior of the fit, and compared with its result.
    progress : callable, optional
        Called with the name of the stage and its finished fraction.

    Raises
    ------
    FitError
        When one field cannot explain all sessions.
    """
    posed, options = list(scan.measurements), replace(options, accuracy=scan.accuracy)
    readings = sum(int(m.usable.sum()) for m in posed)
    thin = thin_frames(posed)
    folds = fold_of_frames([m.position for m in thin])
    drawn = None if nominal is None else DrawnBoard(nominal, thin)
    selection = choose_layout(
        thin, folds, generator, options.accuracy, progress, options.layout, drawn
    )

    fold_fits = _FoldFits(thin, folds, generator, options, nominal, selection)
    tested, finalists = fold_fits.tested, selection.finalists
    chosen, held_out = _better([(finalist, tested(finalist)) for finalist in finalists])
    if options.damping is None:
        chosen, held_out = best_damped(chosen, held_out, tested)
    damping = _damping(chosen, options)
    whole = LayoutFitter(posed, generator, options.accuracy, nominal).fit(
        chosen.layout, damping, progress=progress
    )
    dipoles, fit = whole.dipoles, whole.fit
    sizes = source_sizes(
        chosen.layout, selection.candidates, whole, posed,
        fold_of_frames([m.position for m in posed]), options.accuracy,
    )  # fmt: skip
    scan = replace(scan, reported_effects=(*scan.reported_effects, *size_records(sizes)))
    if not _is_explained(scan):
        check_agreement(posed, names, fit, _fitter(chosen, generator, options, nominal))
    model = FieldModel(
        positions=dipoles.positions,
        directions=dipoles.directions,
        moments=fit.moments,
        emitters=emitters,
        frequencies_hz=frequencies_hz,
        flux_error_t=float(np.hypot(held_out.flux_error_t, scan.field_sigma_t)),
        shift_sigma_m=0.0 if scan.survey is None else scan.survey.shift_sigma_m,
        effects=scan.corrections,
        gaps=None if chosen.layout.local else gaps_of(whole, damping, posed, held_out.gap_factor),
    )
    calibration = Calibration(
        model, fit, held_out, None if nominal is None else residuals(posed, nominal).rmse_t,
        selection.candidates, chosen, chosen.layout, damping, readings, residuals(posed, model),
        scan, () if scan.survey is None else contradiction_words(scan.survey, names),
    )  # fmt: skip
    return replace(calibration, model=replace(model, provenance=provenance(calibration, names)))


def survey(
    measurements: Sequence[Measurements],
    generator: Generator,
    options: Options,
    nominal: FieldModel | None = None,
    progress: Progress | None = None,
    steady: Sequence[NDArray[np.bool_]] | None = None,
) -> Scan:
    """Return the measurements as ideal sensors would have given them, and what was not.

    Parameters
    ----------
    measurements : sequence of Measurements
        One a body and session; their optical poses are the reference.
    generator : Generator
        Places of the coils.
    options : Options
        Uncertainties, and what is estimated of the sensors.
    nominal : FieldModel, optional
        The drawn board: a prior of the fit.
    progress : callable, optional
        Called with the name of the stage and its finished fraction.
    steady : sequence of ndarray of bool, shape (F,), optional
        Frames of each of the measurements in which the references saw nothing move.

    Raises
    ------
    FitError
        When the measurements cannot determine a model.
    """
    needed = COUNTS[0] ** 2 if options.layout is None else len(place(options.layout, generator))
    check_measurements(measurements, needed, not options.estimate)
    if not options.estimate:
        return Scan(tuple(with_pose(m) for m in measurements), options.accuracy)
    surveyor = SensorSurveyor(
        measurements, options.estimate, generator, options.accuracy, nominal, progress, steady
    )
    result = surveyor.fit()
    sound = [m.frames(kept) for m, kept in zip(measurements, result.kept, strict=True)]
    check_kept(measurements, sound, needed)
    root = np.sqrt(result.optical.interpolated)
    accuracy = replace(
        options.accuracy,
        optical_position_m=float(root * result.optical.position_m),
        optical_rotation_rad=float(root * result.optical.rotation_rad),
    )
    corrected = tuple(with_pose(result.survey(m.body).apply(m)) for m in sound)
    return Scan(
        corrected, accuracy, corrections(result), reported_effects(result, measurements), result
    )


def _is_explained(scan: Scan) -> bool:
    """Whether sessions disagree in few sensors: that is told, and is no other board."""
    if scan.survey is None:
        return False
    sensors = sum(len(table) for table in scan.survey.parameters.tables)
    return 0 < len(scan.survey.contradictions) <= FEW_SENSORS * sensors


def _damping(candidate: LayoutCandidate, options: Options) -> float:
    return candidate.damping if options.damping is None else options.damping


def _fitter(
    candidate: LayoutCandidate, generator: Generator, options: Options, nominal: FieldModel | None
) -> Callable[[list[Measurements]], LayoutFit]:
    def fit(part: list[Measurements]) -> LayoutFit:
        return _fitted(
            LayoutFitter(part, generator, options.accuracy, nominal), candidate, options
        )

    return fit


def _fitted(fitter: LayoutFitter, candidate: LayoutCandidate, options: Options) -> LayoutFit:
    damping = _damping(candidate, options)
    return fitter.fit(candidate.layout, damping, alternations=3, exact=False)


class _FoldFits:
    """Fits candidates to all folds but one, each fold from the start.

    The folds are shared among the threads, since all candidates' fits to the same folds have the
    larger part in common.
    """

    def __init__(
        self,
        thin: Sequence[Measurements],
        folds: Sequence[NDArray[np.int64]],
        generator: Generator,
        options: Options,
        nominal: FieldModel | None,
        selection: Selection,
    ) -> None:
        self.thin, self.folds, self.options = thin, folds, options
        self.reference = selection.reference
        self._fitters = {
            fold: LayoutFitter(
                [m.frames(f != fold) for m, f in zip(thin, folds, strict=True)],
                generator, options.accuracy, nominal,
            )
            for fold in np.unique(np.concatenate(list(folds))).tolist()
        }  # fmt: skip

    def tested(self, candidate: LayoutCandidate) -> HeldOut:
        """Return a candidate's held-out error."""
        return predict_held_out(
            self.thin,
            self.folds,
            lambda fold: _fitted(self._fitters[fold], candidate, self.options),
            self.options.accuracy,
            self.reference.noise_t,
            self.reference.quadrature_noise_t,
            None if candidate.layout.local else _damping(candidate, self.options),
        )


def best_damped(
    candidate: LayoutCandidate, held_out: HeldOut, tested: Callable[[LayoutCandidate], HeldOut]
) -> tuple[LayoutCandidate, HeldOut]:
    """Return the winner with a neighbouring damping, where its folds ask for that.

    Layouts were compared at poses that a rich layer corrected. Those of the winner itself are more
    exact, so that it may need less damping.
    """
    start = DAMPINGS.index(candidate.damping)
    around = [*DAMPINGS[max(start - 1, 0) : start], *DAMPINGS[start + 1 : start + 2]]
    near = [replace(candidate, damping=damping) for damping in around]
    other, result = min(((one, tested(one)) for one in near), key=lambda pair: pair[1].score_t)
    while result.score_t < held_out.score_t:
        ahead = 2 * DAMPINGS.index(other.damping) - DAMPINGS.index(candidate.damping)
        candidate, held_out = other, result
        if not 0 <= ahead < len(DAMPINGS):
            break
        other = replace(candidate, damping=DAMPINGS[ahead])
        result = tested(other)
    return candidate, held_out


def _better(tested: Sequence[tuple[LayoutCandidate, HeldOut]]) -> tuple[LayoutCandidate, HeldOut]:
    """Return the finalist whose error is least; a third of the dipoles is worth some error."""

    def cost(pair: tuple[LayoutCandidate, HeldOut]) -> float:
        held_out = pair[1]
        exponent = np.log(LOSS_FOR_A_THIRD) / np.log(3.0)
        return float(held_out.score_t * held_out.n_dipoles**exponent)

    return min(tested, key=cost)
