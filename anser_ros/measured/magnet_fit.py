"""Fits effects of a magnet recording on its own poses, chosen on blocks left out of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.measured.candidates import CandidateSearch, grow
from anser_ros.measured.magnet_model import (
    EFFECTS,
    Parameters,
    Recording,
    Source,
    add,
    columns,
    predict,
    zero,
)

Array = NDArray[np.float64]

ROUNDS = 4
"""Largest number of Gauss-Newton rounds; the small effects are nearly linear."""
SETTLED = 1e-4
"""Step, in units of each parameter's spread, below which the rounds end."""


@dataclass(frozen=True)
class Jitter:
    """Holds standard deviations of stated poses (optical system or robot): m and rad, per axis."""

    position_m: float
    angle_rad: float


@dataclass(frozen=True)
class MagnetFit:
    """Holds what one recording taught.

    Attributes
    ----------
    source : Source
    moment : float
        A m^2, as fitted.
    found : mapping
        Parameters of the effects.
    sigma : mapping
        Their standard deviations, same layout.
    noise_t : float
        Rms residual of a reading that no pose jitter explains, T, degrees of freedom counted.
    """

    source: Source
    moment: float
    found: Parameters
    sigma: Parameters
    noise_t: float

    def predict(self, recording: Recording) -> Array:
        """Return the predicted readings, shape (F, S, 3), T."""
        return predict(recording, self.source, self.moment, self.found)


def start_moment(recording: Recording, source: Source) -> float:
    """Return the strength that fits all readings with equal relative weight, A m^2."""
    unit = predict(recording, source, 1.0, {})
    weight = 1.0 / np.linalg.norm(recording.field_t, axis=2, keepdims=True)
    return float(np.sum(unit * recording.field_t * weight**2) / np.sum((unit * weight) ** 2))


def whiteners(
    recording: Recording,
    source: Source,
    moment: float,
    found: Parameters,
    noise_t: float,
    jitter: Jitter,
) -> Array:
    """Return the inverse Cholesky factor of a reading's covariance in each frame, shape (F, 3S,
    3S).

    Noise is independent; the pose's jitter moves all readings of a frame together.
    """
    frames, sensors = recording.field_t.shape[:2]
    pose = np.concatenate(
        [
            columns(recording, source, moment, found, 'lever_arm') * (jitter.position_m / 1e-3),
            columns(recording, source, moment, found, 'source_axis') * (jitter.angle_rad / 0.02),
        ],
        axis=3,
    ).reshape(frames, 3 * sensors, -1)
    covariance = noise_t**2 * np.eye(3 * sensors) + pose @ pose.swapaxes(1, 2)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _design(
    recording: Recording,
    source: Source,
    moment: float,
    found: Parameters,
    names: Sequence[str],
    white: Array,
) -> tuple[Array, Array]:
    """Whitened columns (F, 3S, n) and residual (F, 3S)."""
    frames = len(recording.field_t)
    residual = recording.field_t - predict(recording, source, moment, found)
    parts = [columns(recording, source, moment, found, name) for name in names]
    matrix = np.concatenate(parts, axis=3).reshape(frames, white.shape[1], -1)
    return white @ matrix, np.einsum('fij,fj->fi', white, residual.reshape(frames, -1))


def fit(
    recording: Recording,
    source: Source,
    names: Sequence[str],
    noise_t: float,
    jitter: Jitter,
) -> MagnetFit:
    """Fit the strength and the named effects to all poses of a recording (Gauss-Newton).

    Raises
    ------
    FitError
        When there are fewer readings than parameters.
    """
    moment, found = start_moment(recording, source), dict[str, Array]()
    names, sensors = ('moment', *names), recording.field_t.shape[1]
    covariance: Array = np.zeros((0, 0))
    white: Array = np.zeros((0, 0, 0))
    for _ in range(ROUNDS):
        white = whiteners(recording, source, moment, found, noise_t, jitter)
        matrix, residual = _design(recording, source, moment, found, names, white)
        flat = matrix.reshape(-1, matrix.shape[2])
        if flat.shape[0] < flat.shape[1]:
            raise FitError(f'{flat.shape[0]} readings cannot give {flat.shape[1]} parameters')
        covariance = np.asarray(np.linalg.inv(flat.T @ flat + np.eye(flat.shape[1])))
        pull = np.concatenate([_in_spreads(found, name, sensors) for name in names])
        step = covariance @ (flat.T @ residual.ravel() - pull)
        found = add(found, names, step, sensors)
        if np.abs(step).max() < SETTLED:
            break
    sigma = add({}, names, np.sqrt(np.diag(covariance)), sensors)
    noise = _noise(recording, source, moment, found, white, noise_t, len(covariance))
    return MagnetFit(source, moment, found, sigma, noise)


def _in_spreads(found: Parameters, name: str, sensors: int) -> Array:
    return np.asarray(found.get(name, zero(name, sensors)) / EFFECTS[name].spread).ravel()


def _noise(
    recording: Recording,
    source: Source,
    moment: float,
    found: Parameters,
    white: Array,
    noise_t: float,
    n_parameters: int,
) -> float:
    residual = recording.field_t - predict(recording, source, moment, found)
    whitened = np.einsum('fij,fj->fi', white, residual.reshape(len(residual), -1))
    return float(noise_t * np.sqrt(np.sum(whitened**2) / max(whitened.size - n_parameters, 1)))


def blocks_of(frames: int, count: int) -> NDArray[np.int64]:
    """Return the block of each frame: runs of neighbours, so that no held-out pose has a twin."""
    return np.arange(frames) * count // frames


def search(
    recording: Recording,
    source: Source,
    names: Sequence[str],
    noise_t: float,
    jitter: Jitter,
    n_blocks: int = 7,
) -> CandidateSearch:
    """Choose effects on blocks of poses that took no part in each fit.

    The effects are small: columns of the plain model are solved once a block, and the power of the
    whitened residual of the block left out is the score (1 is the noise).
    """
    moment = start_moment(recording, source)
    white = whiteners(recording, source, moment, {}, noise_t, jitter)
    block = blocks_of(len(recording.field_t), n_blocks)
    design = {
        name: _design(recording, source, moment, {}, (name,), white) for name in ('moment', *names)
    }

    def score(chosen: tuple[str, ...]) -> Array:
        matrix = np.concatenate([design[name][0] for name in ('moment', *chosen)], axis=2)
        residual = design['moment'][1]
        return held_out_power(matrix, residual, block)

    sizes = {name: item[0].shape[2] for name, item in design.items()}
    return grow(names, score, sizes)


def held_out_power(matrix: Array, residual: Array, block: NDArray[np.int64]) -> Array:
    """Return each block's mean squared whitened residual, solved from the others, shape (B,)."""
    normal = np.array([_gram(matrix[block == b]) for b in np.unique(block)])
    right = np.array(
        [
            np.einsum('fin,fi->n', matrix[block == b], residual[block == b])
            for b in np.unique(block)
        ]
    )
    power = []
    for k, b in enumerate(np.unique(block)):
        inside = normal.sum(axis=0) - normal[k] + np.eye(matrix.shape[2])
        solution = np.linalg.solve(inside, right.sum(axis=0) - right[k])
        left = residual[block == b] - matrix[block == b] @ solution
        power.append(float(np.mean(left**2)))
    return np.array(power)


def _gram(matrix: Array) -> Array:
    flat = matrix.reshape(-1, matrix.shape[2])
    return np.asarray(flat.T @ flat)
