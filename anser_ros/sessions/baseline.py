"""Finds what a session's references read without metal, from a recording of the same board."""

import math
from dataclasses import dataclass

import numpy as np

from anser_ros.arrays import ComplexArray
from anser_ros.effects.correction import needs_correction
from anser_ros.errors import BagError, FitError, ModelFileError
from anser_ros.field.model import FieldModel, ReferenceReadings
from anser_ros.integrity.board_place import BoardPlace
from anser_ros.integrity.clean_references import check_as_calibrated, check_as_drawn, check_steady
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.frame import ReadingWindow
from anser_ros.sessions.nominal_board import NominalBoard, tracked_volume
from anser_ros.sessions.session import Session
from anser_ros.sessions.starting_model import is_nominal
from anser_ros.wire.setup import Setup

SAME_PLACE_M = 0.005
"""Farthest that a sensor may be from where the session has it, m; a survey moves it by 1 mm."""


@dataclass(frozen=True)
class Baseline:
    """Holds clean readings (R, K), T, of a session's reference sensors, NaN for one that has none.

    ``path`` is the recording that they are from.
    """

    path: str
    flux: ComplexArray


def clean_flux(recording: Session, sensors: SensorTable, model: FieldModel) -> ComplexArray:
    """Return mean readings of a recording without metal in it, as far as it can be checked.

    Arguments, result and further errors are those of `baseline_flux`. Raises `BagError` when
    readings change during the recording, or are not those that the model knows of.
    """
    flux = baseline_flux(recording, sensors)
    try:
        sigma = steady_sigma(recording)
        check_clean(model, sensors, flux, sigma, recording.setup)
    except FitError as error:
        raise BagError(f'{recording.path} is not usable as a baseline: {error}') from error
    return flux


def check_clean(
    model: FieldModel, sensors: SensorTable, flux: ComplexArray, sigma_t: float, setup: Setup
) -> None:
    """Raise `FitError` when references do not read what they do without metal.

    The expected readings are those at the calibration, or else those of the drawing; references
    and model must also agree about the place of the board. A model that contains metal found by a
    diagnosis, and no such readings, is not compared. ``flux`` (R, K), T, are the sensors'
    readings, with the noise ``sigma_t`` of a component.
    """
    known = model.references
    compared = known is not None and check_as_calibrated(
        known, sensors, flux, sigma_t, setup.accuracy
    )
    place = board_place_of(model, sensors, setup)
    if place is not None:
        place.check(flux)
    board = NominalBoard.of(setup).board
    if not compared and board is not None and _is_without_metal(model):
        check_as_drawn(board.field, board.centres, sensors, flux, setup.accuracy)


def board_place_of(model: FieldModel, sensors: SensorTable, setup: Setup) -> BoardPlace | None:
    """Return what compares the board's places by model and references, or None."""
    board = NominalBoard.of(setup).board
    if board is None or is_nominal(model) or not len(sensors) or not _is_without_metal(model):
        return None
    return BoardPlace(
        model, board.field, board.centres, tracked_volume(setup), sensors, setup.accuracy
    )


def check_place(model: FieldModel, session: Session) -> None:
    """Raise `ModelFileError` when a model lies beside the board that a session's references see.

    Nothing is compared without references, nor where `board_place_of` has nothing to compare.
    """
    reference = session.reference
    if reference is None or not reference.flux.size:
        return
    place = board_place_of(model, reference.sensors, session.setup)
    if place is None:
        return
    flux = np.full(reference.flux.shape[1:], np.nan, dtype=complex)
    for row, good in enumerate(reference.valid.T):
        if good.any():  # the median, as metal may come for a while, and a sensor fail
            parts = reference.flux[good, row].view(float)
            flux[row] = np.nanmedian(parts, axis=0).view(complex)
    try:
        place.check(flux)
    except FitError as error:
        raise ModelFileError(f'{session.path}: {error}') from error


def _is_without_metal(model: FieldModel) -> bool:
    """Whether all effects of a model are those of sensors, emitters and optics."""
    return all(needs_correction(record) for record in model.effects)


def clean_mean(
    window: ReadingWindow, model: FieldModel | None, sensors: SensorTable | None, setup: Setup
) -> ComplexArray:
    """Return the mean readings (R, K), T, of a window in which there seems to be no metal.

    Raises `FitError` when they change, or are not what the references read without metal.
    """
    mean, sigma = window.mean(), check_steady(window.frames)
    if model is not None and sensors is not None:
        if sigma is None:
            sigma = setup.accuracy.flux_noise_t / math.sqrt(len(window))
        check_clean(model, sensors, mean, sigma, setup)
    return mean


def steady_sigma(recording: Session) -> float:
    """Return the noise of a component of mean readings, T; raises `FitError` when these change."""
    reference, stated = recording.reference, recording.setup.accuracy.flux_noise_t
    if reference is None:
        return stated
    sigma = check_steady(np.where(reference.valid[:, :, None], reference.flux, np.nan))
    return stated if sigma is None else sigma


def readings_of(recording: Session) -> ReferenceReadings | None:
    """Return what a calibration keeps of references; None without any or near moving metal."""
    reference = recording.reference
    if reference is None:
        return None
    sensors = reference.sensors
    try:
        sigma, flux = steady_sigma(recording), baseline_flux(recording, sensors)
    except FitError:
        return None
    known = np.flatnonzero(np.isfinite(flux).all(axis=1))
    if not len(known):
        return None
    kept, names = sensors.select(known), np.array(sensors.name)[known].tolist()
    return ReferenceReadings(tuple(names), kept.position, kept.axis, flux[known], sigma)


def baseline_flux(baseline: Session, sensors: SensorTable) -> ComplexArray:
    """Return the mean reading of each of R reference sensors in a recording without metal.

    (R, K), T, in the order of the sensors; NaN for one without a good reading. Raises `BagError`
    when the recording has no reference fluxes, or lacks one of the sensors, or has it at another
    place.
    """
    reference = baseline.reference
    if reference is None:
        raise BagError(f'{baseline.path}: the baseline has no reference fluxes')
    mean = np.full((len(sensors), reference.flux.shape[2]), np.nan, dtype=complex)
    for row, (channel, name) in enumerate(
        zip(sensors.channel.tolist(), sensors.name, strict=True)
    ):
        found = np.flatnonzero(reference.sensors.channel == channel)
        if found.size == 0 or reference.sensors.name[found[0]] != name:
            raise BagError(f'{baseline.path}: the baseline lacks the reference sensor {name}')
        apart = np.linalg.norm(reference.sensors.position[found[0]] - sensors.position[row])
        if apart > SAME_PLACE_M:
            raise BagError(
                f'{baseline.path}: in the baseline the reference sensor {name} is '
                f'{1e3 * apart:.0f} mm from where the session has it; is it of another setup?'
            )
        good = reference.valid[:, found[0]]
        if good.any():
            mean[row] = reference.flux[good, found[0]].mean(axis=0)
    return mean
