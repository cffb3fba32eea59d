"""Calibrates a field model: checks, choice by held-out error, and the final fit.

The scan is corrected for errors of its own sensors and clock (`correct_scan`); layouts and
dampings are compared by the error of held-out blocks (`choose_layout`); the finalists are fitted
from the start without each block; the winner is fitted to everything (`fit_scan`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from anser_ros.arrays import Booleans, Integers
from anser_ros.calibration import readings
from anser_ros.calibration.held_out import HeldOut, gaps_of, predict_held_out
from anser_ros.calibration.layout_fit import LayoutFit, LayoutFitter
from anser_ros.calibration.layouts import FREE_KINDS, Generator, Layout, place
from anser_ros.calibration.moments import SMALLEST_NOISE_T, Progress
from anser_ros.calibration.result import (
    Calibration,
    Scan,
    contradiction_words,
    corrections,
    reported_effects,
    residuals,
    with_provenance,
)
from anser_ros.calibration.selection import (
    COUNTS,
    DAMPINGS,
    LOSS_FOR_A_THIRD,
    MOST_ROWS,
    LayoutCandidate,
    Selection,
    choose_layout,
)
from anser_ros.calibration.sensor_fit import SensorFit, SensorFitter
from anser_ros.calibration.sensor_parameters import SURVEYED_M
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel, OpenArm
from anser_ros.parallel import in_order
from anser_ros.settings import Accuracy

Tested = tuple[LayoutCandidate, HeldOut]
"""A layout with its damping, and what a fit without each block predicts in that block."""

FEW_SENSORS = 1.0 / 3.0
"""Share of the sensors of which sessions may say different things and be of one board."""


@dataclass(frozen=True)
class Options:
    """Holds the options of a calibration."""

    accuracy: Accuracy = field(default_factory=Accuracy)  # flux noise and pose jitter
    surveyed_m: float = SURVEYED_M  # error of a coil's place in its body along each axis
    layout: Layout | None = None  # layout of the dipoles; chosen by held-out error by default
    # kinds of errors of sensors and clock that are estimated together with the field; whatever is,
    # frames whose pose or field is bad are left out then, and the optical jitter is estimated
    estimate: tuple[str, ...] = ()
    is_joint: bool = False  # fit all errors jointly where an engine can, though nothing is named


def correct_scan(
    measurements: Sequence[Measurements],
    generator: Generator,
    options: Options,
    progress: Progress | None = None,
    steady: Sequence[Booleans] | None = None,
) -> Scan:
    """Return the measurements as ideal sensors would have given them, and what was not.

    ``steady``: frames of each of the measurements in which the references saw nothing move.
    Raises `FitError` when the measurements cannot determine a model.
    """
    needed = COUNTS[0] ** 2 if options.layout is None else len(place(options.layout, generator))
    readings.check_measurements(measurements, needed, not options.estimate)
    if not options.estimate:
        return Scan(tuple(readings.with_pose(m) for m in measurements), options.accuracy)
    fitter = SensorFitter(
        measurements, options.estimate, generator, options.accuracy, progress, steady,
        options.surveyed_m,
    )  # fmt: skip
    found = fitter.fit()
    sound = [m.frames(kept) for m, kept in zip(measurements, found.kept, strict=True)]
    readings.check_kept(measurements, sound, needed)
    root = np.sqrt(found.optical.interpolated)
    accuracy = replace(
        options.accuracy,
        optical_position_m=float(root * found.optical.position_m),
        optical_rotation_rad=float(root * found.optical.rotation_rad),
    )
    corrected = tuple(
        readings.with_pose(found.errors_of(m.body, m.session).apply(m)) for m in sound
    )
    reported = reported_effects(found, measurements)
    return Scan(corrected, accuracy, corrections(found), reported, found)


def fit_scan(
    scan: Scan,
    names: Sequence[str],
    generator: Generator,
    options: Options,
    progress: Progress | None = None,
) -> Calibration:
    """Choose and fit a field model to a scan that `correct_scan` made.

    ``names``: of the session of each of the measurements.
    Raises `FitError` when one field cannot explain all sessions.
    """
    posed, accuracy, nominal = list(scan.measurements), scan.accuracy, generator.nominal
    thin = readings.thinned(posed, MOST_ROWS)
    folds = readings.fold_of_frames([m.position for m in thin])
    selection = choose_layout(thin, folds, generator, accuracy, progress, options.layout)
    chosen, held_out = _winner(selection, thin, folds, generator, accuracy)
    layout, damping = chosen.layout, chosen.damping
    whole = LayoutFitter(posed, generator, accuracy).fit(layout, damping, progress=progress)

    def alone(part: list[Measurements]) -> float:
        return _fitted(LayoutFitter(part, generator, accuracy), chosen).fit.noise_t

    if not _is_explained(scan):
        readings.check_agreement(posed, names, whole.fit.noise_t, alone)
    sensors = scan.sensor_fit
    flux_error = float(np.hypot(held_out.flux_error_t, scan.field_sigma_t))
    missed = max(whole.fit.noise_t**2 - flux_error**2, 0.0)
    # Only the quadrature tells noise from the model's error, and a constant field has none.
    is_told = held_out.flux_noise_t > 2.0 * SMALLEST_NOISE_T
    model = FieldModel(
        positions=whole.dipoles.positions, directions=whole.dipoles.directions,
        moments=whole.fit.moments, emitters=generator.emitters,
        frequencies_hz=generator.frequencies_hz, flux_error_t=flux_error,
        noise_t=max(held_out.flux_noise_t, float(np.sqrt(missed))) if is_told else 0.0,
        error_share=held_out.error_share if is_told else 0.0,
        shift_sigma_m=0.0 if sensors is None else sensors.shift_sigma_m,
        open_arms={} if sensors is None else _open_arms(posed, sensors),
        effects=scan.corrections, gaps=gaps_of(whole, damping, posed, held_out.gap_factor),
    )  # fmt: skip
    calibration = Calibration(
        model=model, fit=whole.fit, held_out=held_out, layout=layout, damping=damping,
        n_measurements=sum(int(m.usable.sum()) for m in posed),
        residuals=residuals(posed, model), scan=scan,
        nominal_rmse_t=None if nominal is None else residuals(posed, nominal).rmse_t,
        candidates=selection.candidates,
        contradictions=() if sensors is None else contradiction_words(sensors, names),
    )  # fmt: skip
    return with_provenance(calibration, names)


def _open_arms(posed: Sequence[Measurements], found: SensorFit) -> dict[str, OpenArm]:
    """Return how bodies stood whose lever arms, and turns of all their axes, stay open."""
    arm_m, width = found.open_arm_m, found.posterior.width[found.parameters.rows('axes')]
    axes_rad = float(np.sqrt(np.sum(width**2) / max(2 * width.size, 1)))  # means of two tilts
    turns = {m.body: [n.rotation for n in posed if n.body == m.body] for m in posed if arm_m}
    return {b: OpenArm(arm_m, np.concatenate(t).mean(axis=0), axes_rad) for b, t in turns.items()}


def _is_explained(scan: Scan) -> bool:
    """Whether sessions disagree in few sensors: that is reported, and is no other board."""
    if scan.sensor_fit is None:
        return False
    sensors = sum(len(table) for table in scan.sensor_fit.parameters.tables)
    return 0 < len(scan.sensor_fit.contradictions) <= FEW_SENSORS * sensors


def _fitted(fitter: LayoutFitter, candidate: LayoutCandidate) -> LayoutFit:
    return fitter.fit(candidate.layout, candidate.damping, alternations=3, exact=False)


def _winner(
    selection: Selection,
    thin: Sequence[Measurements],
    folds: Sequence[Integers],
    generator: Generator,
    accuracy: Accuracy,
) -> Tested:
    """Return the best finalist, each fitted from the start without each fold, and its damping."""
    # All candidates' fits to the same folds have the larger part in common.
    fitters = {
        fold: LayoutFitter(
            [m.frames(f != fold) for m, f in zip(thin, folds, strict=True)], generator, accuracy
        )
        for fold in np.unique(np.concatenate(list(folds))).tolist()
    }
    reference = selection.reference

    def tested(candidate: LayoutCandidate) -> HeldOut:
        def fit(fold: int) -> LayoutFit:
            return _fitted(fitters[fold], candidate)

        return predict_held_out(thin, folds, fit, accuracy, reference, candidate.damping)

    return best_damped(*_better([(one, tested(one)) for one in selection.finalists]), tested)


def best_damped(
    candidate: LayoutCandidate, held_out: HeldOut, tested: Callable[[LayoutCandidate], HeldOut]
) -> Tested:
    """Return the winner with a neighbouring damping, where its folds ask for that.

    Layouts were compared at poses that a rich layer corrected. Those of the winner itself are more
    exact, so that it may need less damping.
    """
    start = DAMPINGS.index(candidate.damping)
    around = [*DAMPINGS[max(start - 1, 0) : start], *DAMPINGS[start + 1 : start + 2]]
    if candidate.layout.kind in FREE_KINDS:  # whose poses are as exact in the comparison
        return candidate, held_out
    near = [replace(candidate, damping=damping) for damping in around]
    tries = zip(near, in_order(tested, near), strict=True)
    other, result = min(tries, key=lambda pair: pair[1].score_t)
    while result.score_t < held_out.score_t:
        ahead = 2 * DAMPINGS.index(other.damping) - DAMPINGS.index(candidate.damping)
        candidate, held_out = other, result
        if not 0 <= ahead < len(DAMPINGS):
            break
        other = replace(candidate, damping=DAMPINGS[ahead])
        result = tested(other)
    return candidate, held_out


def _better(tested: Sequence[Tested]) -> Tested:
    """Return the finalist whose error is least; a third of the dipoles is worth some error."""
    exponent = np.log(LOSS_FOR_A_THIRD) / np.log(3.0)
    return min(tested, key=lambda pair: pair[1].score_t * pair[1].n_dipoles ** exponent)
