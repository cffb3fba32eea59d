"""Judges whether a field model lies where the reference sensors say that the board is.

A model that is displaced from its board as a whole displaces all poses by as much, and no residual
of a tool shows it: every field of the model is a field of the board, slightly shifted. References
have stated places. They and the model are both compared with the drawn board, with the same errors
of its coils; the remaining difference is the displacement of the model's board from that of the
references.
"""

from dataclasses import dataclass

import numpy as np

from anser_ros.arrays import Array, ComplexArray
from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.integrity import clean_references
from anser_ros.physics.sensor import SensorTable, along_each_axis
from anser_ros.physics.volume import TrackedVolume
from anser_ros.settings import Accuracy

FAR_M = 5e-4
"""Distance of the two boards from which on a model is refused: half of what a pose may be off."""
FAR_SIGMAS = 5.0
"""The same in standard deviations: a correct model is farther off once in 65 000 times."""
EXPLAINED = 1.0
"""Misfit of the typical reference, in what survey and manufacture allow, up to which the distance
is believed (0.04 and 0.5 on two simulated boards): more is metal, which others judge."""
MODEL_SHARE = 2e-3
"""Error of a calibrated model's field relative to itself, in the middle of the volume, that
drawing and shift need not explain. Half and twice as much move the distance by 5 um at most."""
DRAWN_SHARE = 2e-3
"""Error of a drawn field relative to itself at the references: tracks 0.07 mm off, at 10 cm."""
INNER = 0.5
"""Part of the volume, from its middle, in which the model is asked: scans reach that far."""
SIDE = 4
"""Points along a side of that part; three readings each."""
EFFECTIVE_READINGS = 40.0
"""So many of these readings count, about one in five: neighbouring points say the same."""
PRIOR_M, PRIOR_RAD = 5e-3, 0.02
"""Standard deviations of how far a model lies aside, m and rad: a board put down again by hand."""
WEIGHT_ROUNDS = 12
"""Rounds in which sensors that do not fit lose weight; from the sixth on 1 um changes."""


@dataclass(frozen=True)
class Misplacement:
    """States how far a model's board lies from where the references have it.

    The shift (3,), m, its standard deviations, and the turn (3,), rad, are along and about x, y
    and z of fg, in the middle of the volume; ``misfit`` is that of the typical reference with
    these, in what survey and manufacture allow.
    """

    shift_m: Array
    turn_rad: Array
    sigma_m: Array
    misfit: float

    @property
    def is_certain(self) -> bool:
        """Return whether the model lies so far aside that its poses cannot be trusted."""
        far = float(np.linalg.norm(self.shift_m))
        across = float(self.sigma_m @ np.abs(self.shift_m)) / max(far, 1e-12)
        return self.misfit < EXPLAINED and far > max(FAR_M, FAR_SIGMAS * across)


class BoardPlace:
    """Compares where a calibrated model and the references have the nominal board.

    ``field`` is the drawn field of the K coils at ``centres`` (K, 3), m; ``volume`` is where the
    model is good; ``sensors`` are the references at their stated places.
    """

    def __init__(
        self,
        model: FieldModel,
        field: clean_references.FieldAt,
        centres: Array,
        volume: TrackedVolume,
        sensors: SensorTable,
        accuracy: Accuracy,
    ) -> None:
        self._drawn = clean_references.DrawnReadings.of(
            field, sensors.position, sensors.axis, sensors.length
        )
        self._roots = _survey_roots(self._drawn, accuracy)
        rows = _rows(self._drawn, centres, np.zeros(3))
        # Coils are the same for both; where the model lies is the model's alone.
        rows[..., -6:] = 0.0
        self._rows = np.asarray(np.linalg.solve(self._roots, rows), dtype=np.float64)
        self._by_model = _of_model(model, field, centres, volume)

    def misplacement(self, flux: ComplexArray) -> Misplacement | None:
        """Return how far the model lies from the board that the references see.

        ``flux`` (R, K), T, are readings of one frame or of many; NaN rows are passed over. None
        where too few references have readings.
        """
        good = np.isfinite(flux).all(axis=1)
        if good.sum() < clean_references.FEWEST_SENSORS:
            return None
        difference = (flux[good].real - self._drawn.flux[good])[..., None]
        white = np.asarray(np.linalg.solve(self._roots[good], difference)[..., 0], np.float64)
        estimate, covariance, misfit = _solved((self._rows[good], white), self._by_model)
        scale = np.repeat([PRIOR_M, PRIOR_RAD], 3)
        placed = scale * estimate[-6:]
        sigma = scale * np.sqrt(np.diag(covariance)[-6:])
        return Misplacement(placed[:3], placed[3:], sigma[:3], misfit)

    def check(self, flux: ComplexArray) -> bool:
        """Refuse a model that lies beside the board; return whether the readings determine it.

        Raises `FitError` with how far.
        """
        found = self.misplacement(flux)
        if found is not None and found.is_certain:
            shift = ', '.join(f'{1e3 * v:+.1f}' for v in found.shift_m)
            raise FitError(
                f'the model lies {1e3 * np.linalg.norm(found.shift_m):.1f} mm ({shift} along x, '
                'y, z) from where the references locate the board; is it in another frame?'
            )
        return found is not None


def _rows(drawn: clean_references.DrawnReadings, centres: Array, middle: Array) -> Array:
    """What coils and a displaced frame do to readings, (S, K, 6 K + 6), T a prior deviation."""
    aside = PRIOR_M * drawn.by_place, PRIOR_RAD * drawn.turned(middle)
    return np.moveaxis(np.concatenate([drawn.by_manufacture(centres), *aside]), 0, 2)


def _survey_roots(drawn: clean_references.DrawnReadings, accuracy: Accuracy) -> Array:
    """Root (R, K, K) of the covariance of each sensor's readings by its survey and noise."""
    survey = clean_references.survey_errors(drawn, accuracy)
    count = drawn.flux.shape[1]
    size = np.linalg.norm(drawn.flux, axis=1) / np.sqrt(count)
    noise = accuracy.flux_noise_t**2 + (DRAWN_SHARE * size) ** 2
    covariance = survey.transpose(0, 2, 1) @ survey + noise[:, None, None] * np.eye(count)
    return np.asarray(np.linalg.cholesky(covariance))


def _of_model(
    model: FieldModel, field: clean_references.FieldAt, centres: Array, volume: TrackedVolume
) -> tuple[Array, Array]:
    """The same of readings that the model makes along x, y and z in the middle of the volume."""
    low, high = np.array(volume.low), np.array(volume.high)
    middle, half = (low + high) / 2.0, INNER * (high - low) / 2.0
    steps = np.linspace(-1.0, 1.0, SIDE)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing='ij'), axis=-1).reshape(-1, 3)
    points, axes = along_each_axis(middle + half * grid)
    lengths = np.zeros(len(points))
    drawn = clean_references.DrawnReadings.of(field, points, axes, lengths)
    # A model that lies aside reads at a place what the board makes beside it.
    rows = _rows(drawn, centres, middle)
    difference = model.flux(points, axes, lengths).real - drawn.flux
    size = np.linalg.norm(drawn.flux, axis=1) / np.sqrt(drawn.flux.shape[1])
    weight = np.sqrt(EFFECTIVE_READINGS / len(points)) / np.maximum(
        MODEL_SHARE * size, clean_references.DRAWING_ERROR * size.max()
    )
    return rows * weight[:, None, None], difference * weight[:, None]


def _solved(
    references: tuple[Array, Array], model: tuple[Array, Array]
) -> tuple[Array, Array, float]:
    """Estimate (n,), covariance, and misfit of the typical reference, for a prior of one."""
    prior = np.ones(references[0].shape[2])
    weights = [np.ones(len(references[0])), np.ones(len(model[0]))]
    estimate, covariance, misfit = np.zeros(prior.size), np.diag(prior), 0.0
    for _ in range(WEIGHT_ROUNDS):
        normal, right = np.diag(prior), np.zeros(prior.size)
        for (rows, values), weight in zip((references, model), weights, strict=True):
            flat = (rows * weight[:, None, None]).reshape(-1, prior.size)
            normal += flat.T @ flat
            right += flat.T @ (values * weight[:, None]).ravel()
        covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        estimate = covariance @ right
        left = [
            np.sqrt(np.mean((values - rows @ estimate) ** 2, axis=1))
            for rows, values in (references, model)
        ]
        misfit = float(np.median(left[0]))
        weights = [
            1.0 / np.sqrt(1.0 + (size / max(1.5 * float(np.median(size)), 1.0)) ** 2)
            for size in left
        ]
    return estimate, covariance, misfit
