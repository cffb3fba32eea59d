"""Judges whether reference readings are those of a field without metal.

A baseline is what all later readings are compared with: metal that was present when it was taken
becomes part of the field for good, and no refit detects it. So a baseline has to agree with
independent knowledge of the references: their readings when the model was calibrated, or else what
the nominal board predicts (`DrawnReadings`). The strength of an emitter may have changed,
and single sensors may be bad.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from anser_ros.arrays import Array, ComplexArray
from anser_ros.errors import FitError
from anser_ros.field.model import ReferenceReadings
from anser_ros.field.nominal import SHIFT_M, TILT_RAD
from anser_ros.physics.rotations import tangents
from anser_ros.physics.sensor import SensorTable
from anser_ros.settings import Accuracy, RefitSettings

FieldAt = Callable[[Array], Array]
"""Drawn field at points (P, 3) in m, frame fg: (P, K, 3) in T."""

STEP_M = 1e-5
"""Step (m) of the differences by which the field changes with place."""
FREE_GAIN = 0.1
"""Deviation of an emitter from its nominal strength, which is not judged here."""


@dataclass(frozen=True)
class DrawnReadings:
    """Holds in-phase fluxes (S, K), T, of S sensors over a drawn board of K coils, with
    derivatives.

    The sensors are at points (S, 3), m, with unit axes (S, 3), frame fg; the derivatives (3, S, K)
    are by the place, T/m, and by the axis' vector, T.
    """

    points: Array
    axes: Array
    flux: Array
    by_place: Array
    by_axis: Array

    @staticmethod
    def of(field: FieldAt, points: Array, axes: Array, lengths: Array) -> 'DrawnReadings':
        """Return readings of sensors of some lengths (S,), m, by Gauss' two points."""
        ends = lengths[:, None] / np.sqrt(12.0) * axes

        def mean(places: Array) -> Array:
            return np.asarray(0.5 * (field(places + ends) + field(places - ends)))

        here = mean(points)
        slopes = [(mean(points + STEP_M * e) - here) / STEP_M for e in np.eye(3)]
        along = [np.einsum('ski,si->sk', values, axes) for values in (here, *slopes)]
        by_axis = np.moveaxis(here, 2, 0)
        return DrawnReadings(points, axes, along[0], np.array(along[1:]), by_axis)

    def turned(self, about: Array) -> Array:
        """Return the derivative by turns of all sensors at a point about x, y, z, (3, S, K)."""
        eye = np.eye(3)
        moved = np.cross(eye[:, None, :], self.points - about)
        twisted = np.cross(eye[:, None, :], self.axes)
        return np.asarray(
            np.einsum('rsi,isk->rsk', moved, self.by_place)
            + np.einsum('rsi,isk->rsk', twisted, self.by_axis)
        )

    def by_manufacture(self, centres: Array) -> Array:
        """Return what each coil's deviation from its nominal place does, (6 K, S, K), T a standard
        deviation.

        Six a coil: its strength, its place along x, y and z, its tilt about x and y.
        """
        sensors, count = self.flux.shape
        out = np.zeros((6 * count, sensors, count))
        for k in range(count):
            own = out[6 * k : 6 * (k + 1), :, k]
            own[0] = FREE_GAIN * self.flux[:, k]
            own[1:4] = SHIFT_M * self.by_place[:, :, k]
            own[4:6] = TILT_RAD * self.turned(centres[k])[:2, :, k]
        return out


STABLE_SHARE = 0.25
"""Share of `Accuracy.reference_gain` that a sensor's reading may change by from one day to
another: more than a warm amplifier does, less than metal that moves poses by 0.1 mm."""
CERTAIN = 4.0
"""Changes below so many times their noise do not count; noise seldom passes twice its size."""
FEWEST_SENSORS = RefitSettings.min_references
"""Sensors that have to be known: with fewer, the emitters' strengths explain what metal does."""
PARTS = 3
"""Parts of a recording whose means must agree: metal may come and go, and be away at both ends."""
FEWEST_FRAMES_OF_CHANGE = 12
"""Frames in which a change is looked for: four a part. In fewer, noise hides it."""
NOTICEABLE = 2e-4
"""Change of a reading, as a share of its size, that counts: poses move more than they jitter."""
MOST_SENSORS = 0.9
"""Part of the sensors (0 to 1) that must not change by more: on the simulated board metal at the
limit moves poses by 0.09 mm (median of 53 places), and by 1.1 mm with half of the sensors."""
SAME_PLACE_M = 1e-4
"""Farthest, m, that a sensor may be from its place at the calibration for its reading to count."""
STRENGTH_STEPS = 25
"""Steps in which sensors that changed most lose their say in the emitters' strengths: beside 8 of
32 that changed by 20 % the others seem to change by 2e-5, and by 5e-3 after 10 steps."""
DRAWN_GATE = 3.0
"""Root mean square of all differences, over what survey and manufacture allow: above is metal."""
DRAWING_ERROR = 1e-4
"""Error of a drawn field relative to itself: turns and leads are not drawn to less."""


def change_without_gains(now: ComplexArray, before: ComplexArray) -> Array:
    """Return by how much each sensor's readings (R, K), T, changed, apart from a gain of each
    emitter.

    The norm of the change over that of the reading, (R,); NaN where one is not known. The gains
    are those of most sensors: the fit gives less weight to those that changed more.
    """
    change = np.full(len(now), np.nan)
    known = np.isfinite(now).all(axis=1) & np.isfinite(before).all(axis=1)
    new, old = now[known], before[known]
    size = np.maximum(np.linalg.norm(old, axis=1), 1e-300)
    weight = np.ones(len(new))
    relative = np.zeros(len(new))
    for _ in range(STRENGTH_STEPS if len(new) else 0):
        across = weight[:, None] / size[:, None] ** 2
        power = (across * np.abs(old) ** 2).sum(axis=0)
        gain = (across * old.conj() * new).sum(axis=0) / np.maximum(power, 1e-300)
        relative = np.linalg.norm(new - gain * old, axis=1) / size
        weight = 1.0 / np.maximum(relative, np.median(relative) / 3.0 + 1e-12)
    change[known] = relative
    return change


def check_steady(flux: ComplexArray) -> float | None:
    """Refuse readings that change while they are recorded, as near moving metal.

    The means of `PARTS` parts are compared with each other, beside a gain of each emitter: the
    strength of an emitter may drift while there is no metal, and a refit follows it.

    ``flux`` (F, R, K) are frames of readings, T, in the order of time; NaN where one is bad.
    Returns the noise of a component of the mean reading, T, by the frames' scatter; None for fewer
    than `FEWEST_FRAMES_OF_CHANGE`, which are not judged. Raises `FitError` with how much a tenth
    of the sensors change at least.
    """
    if len(flux) < FEWEST_FRAMES_OF_CHANGE:
        return None
    good = np.asarray(np.isfinite(flux).all(axis=2))
    whole = good.sum(axis=0) > len(flux) // 2
    flux = np.where(good[..., None], flux, np.nan)[:, whole]
    # The variance of a second difference of complex noise is 12 times that of a component.
    scatter = np.mean(np.abs(np.diff(flux, 2, axis=0)) ** 2, axis=2)
    scatter = scatter[np.isfinite(scatter)]  # three whole frames in a row
    noise = float(np.sqrt(np.median(scatter) / 12.0)) if scatter.size else 0.0
    means = [mean_reading(part) for part in np.array_split(flux, PARTS)]
    sigma = np.sqrt(2.0 * PARTS / len(flux)) * noise
    for before, now in itertools.combinations(means, 2):
        share = _change(now, before, sigma, NOTICEABLE, MOST_SENSORS)
        if share > 0.0:
            raise FitError(
                f'reference readings change by {share:.2%} during the recording; is metal '
                'moving nearby?'
            )
    return noise / float(np.sqrt(len(flux)))


def mean_reading(flux: ComplexArray) -> ComplexArray:
    """Return the mean (R, K) of frames (F, R, K) without the NaN; NaN where all are."""
    good = np.isfinite(flux)
    total = np.where(good, flux, 0.0).sum(axis=0)
    return np.asarray(np.where(good.any(axis=0), total / np.maximum(good.sum(axis=0), 1), np.nan))


def check_as_calibrated(
    known: ReferenceReadings, sensors: SensorTable, flux: ComplexArray, sigma_t: float,
    accuracy: Accuracy,
) -> bool:  # fmt: skip
    """Refuse readings that are not those of the calibration; return whether they were compared.

    ``flux`` (R, K), T, are readings of the sensors now, with the noise ``sigma_t`` of a component.
    Raises `FitError` when most sensors read something else, which is metal at rest, or another
    board.
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
    share = _change(flux, before, noise, STABLE_SHARE * accuracy.reference_gain, 0.5)
    if share > 0.0:
        raise FitError(
            f'most reference readings differ by {share:.2%} from those of the calibration; is '
            'metal nearby, or is it another board?'
        )
    return True


def _change(
    now: ComplexArray, before: ComplexArray, sigma_t: float, allowed: float, part: float
) -> float:
    """Return a sensor's relative change where it is more than allowed and than noise, else 0.

    The sensor is the one that a part (0 to 1) of all sensors change less than.
    """
    change = change_without_gains(now, before)
    known = np.isfinite(change)
    if known.sum() < FEWEST_SENSORS:
        return 0.0
    size = np.linalg.norm(before[known], axis=1)
    noise = np.sqrt(2.0 * now.shape[1]) * sigma_t / np.maximum(size, 1e-300)
    share = float(np.quantile(change[known], part))
    certain = np.quantile(change[known] / (noise + 1e-300), part)
    return share if share > allowed and certain > CERTAIN else 0.0


def check_as_drawn(
    field: FieldAt, centres: Array, sensors: SensorTable, flux: ComplexArray, accuracy: Accuracy
) -> None:
    """Refuse readings that the nominal board, its tolerances and the survey do not explain.

    It detects only large amounts of metal: a plate near the board, but not a piece of a hand's
    breadth at the side. ``centres`` (K, 3), m, are those of the coils; ``flux`` (R, K), T, may
    have NaN rows, which are passed over. Raises `FitError` when all readings together differ by
    more than `DRAWN_GATE` of what is allowed.
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
    noise = accuracy.flux_noise_t**2 + (DRAWING_ERROR * drawn.flux.ravel()) ** 2
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
