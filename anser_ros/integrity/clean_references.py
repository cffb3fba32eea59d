"""Judges whether reference readings are those of a field without metal.

A baseline is what all later readings are compared with: metal that was present when it was taken
becomes part of the field for good, and no refit detects it. So a baseline has to agree with
independent knowledge of the references: their readings when the model was calibrated, or else the
drawing of the board. The strength of an emitter may have changed, and single sensors may be bad.
"""

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.field.reference_readings import ReferenceReadings
from anser_ros.integrity.drawn_readings import DrawnReadings, FieldAt
from anser_ros.physics.sensor import SensorTable
from anser_ros.physics.tangent import tangents
from anser_ros.settings import Accuracy, RefitSettings

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

STABLE_SHARE = 0.25
"""Share of `Accuracy.reference_gain` that a sensor's reading may change by from one day to
another: what it is known by at all is worse than how it keeps. Smaller, and a warm amplifier is
taken for metal; larger, and metal that moves poses by a tenth of a millimetre is not noticed."""
CERTAIN = 4.0
"""Changes below so many times their noise do not count: it is the median sensor's, all emitters
together, which noise alone hardly takes past twice what it usually is. Smaller takes noise for
metal; larger misses metal that weak readings see."""
FEWEST_SENSORS = RefitSettings.min_references
"""Sensors that have to be known: with fewer, the emitters' strengths explain what metal does."""
SAME_PLACE_M = 1e-4
"""Farthest that a sensor may be from where it was at the calibration, m. A new survey tells of
another place, where the old reading is worth nothing."""
STEPS = 25
"""Steps in which sensors that changed most lose their say in the emitters' strengths. Fewer leave
sensors beside metal some say; more change nothing once the weights have settled. Its choice is not
recorded."""
DRAWN_GATE = 3.0
"""Root mean square of all readings' differences from the drawn board, in units of what survey and
manufacture allow, from which on there is metal. It is 1 where these are stated as they are.
Smaller, and a board that was made less well is refused; larger, and more metal passes."""
LEAST_SHARE = 1e-4
"""Error of a drawn field relative to itself: turns and leads are not drawn to less."""


def change_beside_gains(now: ComplexArray, before: ComplexArray) -> Array:
    """Return by how much each sensor's readings changed, beside a gain of each emitter.

    The gains are those of most sensors: the fit gives less weight to those that changed more.

    Parameters
    ----------
    now, before : ndarray, shape (R, K), complex
        T; rows with NaN have no say.

    Returns
    -------
    ndarray, shape (R,)
        Norm of the change over that of the reading; NaN where one is not known.
    """
    change = np.full(len(now), np.nan)
    known = np.isfinite(now).all(axis=1) & np.isfinite(before).all(axis=1)
    new, old = now[known], before[known]
    size = np.maximum(np.linalg.norm(old, axis=1), 1e-300)
    weight = np.ones(len(new))
    relative = np.zeros(len(new))
    for _ in range(STEPS if len(new) else 0):
        across = weight[:, None] / size[:, None] ** 2
        gain = (across * old.conj() * new).sum(axis=0) / (across * np.abs(old) ** 2).sum(axis=0)
        relative = np.linalg.norm(new - gain * old, axis=1) / size
        weight = 1.0 / np.maximum(relative, np.median(relative) / 3.0 + 1e-12)
    change[known] = relative
    return change


def check_steady(parts: list[ComplexArray], sigma_t: float, allowed: float) -> None:
    """Refuse readings that change from one part of a recording to another, as near moving metal.

    Parameters
    ----------
    parts : list of ndarray, shape (R, K), complex
        Mean readings of each part, T.
    sigma_t : float
        Noise of a component of these means, T.
    allowed : float
        Change relative to a reading that no pose would feel.

    Raises
    ------
    FitError
    """
    for i, before in enumerate(parts):
        for now in parts[i + 1 :]:
            share = _typical_change(now, before, np.sqrt(2.0) * sigma_t, allowed)
            if share > 0.0:
                raise FitError(
                    f'most reference readings change by {share:.2%} during the recording; is '
                    'metal moving nearby?'
                )


def check_as_calibrated(
    known: ReferenceReadings, sensors: SensorTable, flux: ComplexArray, sigma_t: float,
    accuracy: Accuracy,
) -> bool:  # fmt: skip
    """Refuse readings that are not those of the calibration; return whether they were compared.

    Parameters
    ----------
    known : ReferenceReadings
        Of the calibration.
    sensors : SensorTable
        The R sensors now.
    flux : ndarray, shape (R, K), complex
        Their readings, T.
    sigma_t : float
        Noise of a component, T.
    accuracy : Accuracy
        How well a sensor's gain is known.

    Raises
    ------
    FitError
        When most sensors read something else, which is metal at rest, or another board.
    """
    before = np.full(flux.shape, np.nan, dtype=np.complex128)
    rows = {name: i for i, name in enumerate(known.name)}
    for row, name in enumerate(sensors.name):
        i = rows.get(name)
        if i is None or known.flux.shape[1] != flux.shape[1]:
            continue
        moved = np.linalg.norm(known.position[i] - sensors.position[row])
        turned = np.linalg.norm(known.axis[i] - sensors.axis[row])
        if moved < SAME_PLACE_M and turned < SAME_PLACE_M:
            before[row] = known.flux[i]
    both = np.isfinite(before).all(axis=1) & np.isfinite(flux).all(axis=1)
    if both.sum() < FEWEST_SENSORS:
        return False
    noise = float(np.hypot(sigma_t, known.sigma_t))
    share = _typical_change(flux, before, noise, STABLE_SHARE * accuracy.reference_gain)
    if share > 0.0:
        raise FitError(
            f'most reference readings differ by {share:.2%} from those of the calibration; is '
            'metal nearby, or is it another board?'
        )
    return True


def _typical_change(
    now: ComplexArray, before: ComplexArray, sigma_t: float, allowed: float
) -> float:
    """Return the median relative change where it is more than allowed and than noise, else 0."""
    change = change_beside_gains(now, before)
    known = np.isfinite(change)
    if known.sum() < FEWEST_SENSORS:
        return 0.0
    size = np.linalg.norm(before[known], axis=1)
    noise = np.sqrt(2.0 * now.shape[1]) * sigma_t / np.maximum(size, 1e-300)
    typical, certain = np.median(change[known]), np.median(change[known] / (noise + 1e-300))
    return float(typical) if typical > allowed and certain > CERTAIN else 0.0


def check_as_drawn(
    field: FieldAt, centres: Array, sensors: SensorTable, flux: ComplexArray, accuracy: Accuracy
) -> None:
    """Refuse readings that the drawn board, its tolerances and the survey do not explain.

    It detects only large amounts of metal: a plate near the board, but not a piece of a hand's
    breadth at the side.

    Parameters
    ----------
    field : callable
        The drawn field.
    centres : ndarray, shape (K, 3)
        Centres of the coils, m.
    sensors : SensorTable
        The R sensors.
    flux : ndarray, shape (R, K), complex
        Their readings, T; NaN rows are passed over.
    accuracy : Accuracy
        Of the survey and the readings.

    Raises
    ------
    FitError
        When all readings together differ by more than `DRAWN_GATE` of what is allowed.
    """
    good = np.isfinite(flux).all(axis=1)
    if good.sum() < FEWEST_SENSORS:
        return
    drawn = DrawnReadings.of(
        field, sensors.position[good], sensors.axis[good], sensors.length[good]
    )
    difference = flux[good].real - drawn.flux
    matrix = drawn.by_manufacture(centres).reshape(-1, difference.size)
    own = survey_errors(drawn, accuracy)
    covariance = matrix.T @ matrix
    size = difference.shape[1]
    for s, rows in enumerate(own):
        at = slice(s * size, (s + 1) * size)
        covariance[at, at] += rows.T @ rows
    noise = accuracy.flux_noise_t**2 + (LEAST_SHARE * drawn.flux.ravel()) ** 2
    covariance += np.diag(noise)
    scale = np.sqrt(np.diag(covariance))
    whitened = difference.ravel() / scale
    squares = whitened @ np.linalg.solve(covariance / np.outer(scale, scale), whitened)
    beyond = float(np.sqrt(squares / difference.size))
    if beyond > DRAWN_GATE:
        raise FitError(
            f'the reference readings differ from the drawn board by {beyond:.1f} times what its '
            'tolerances and the survey allow; is metal nearby? If it has to stay, calibrate a '
            'model with it in place, from a scan with the references'
        )


def survey_errors(drawn: DrawnReadings, accuracy: Accuracy) -> Array:
    """Return what each sensor's survey does to its readings, (S, 6, K), T a standard deviation.

    Six a sensor: its place along x, y and z, its axis along two directions across, its gain.
    """
    across = np.einsum('sti,isk->tsk', tangents(drawn.axes), drawn.by_axis)
    rows = [
        accuracy.reference_position_m * drawn.by_place,
        accuracy.reference_axis_rad * across,
        accuracy.reference_gain * drawn.flux[None],
    ]
    return np.concatenate(rows).transpose(1, 0, 2)
