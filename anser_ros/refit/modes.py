"""Condenses the uncertainty of the refit into a few modes and a remainder.

A *mode* is one direction in which the refitted model may be wrong: a set of moments whose field
has the size of one standard deviation. Modes are independent of each other. They are the principal
directions of random draws of the posterior's error; one number states the remainder.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.refit.evidence import STRENGTHS, FrameEvidence
from anser_ros.refit.posterior import Bank, Eigenbasis

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MOST = len(STRENGTHS) - 1
"""Index of the largest of the `STRENGTHS`."""


@dataclass(frozen=True)
class ErrorLevel:
    """Holds the noise with the indices of the strengths of the real and the imaginary part."""

    noise: float
    strengths: tuple[int, int]

    def growth(self, other: 'ErrorLevel') -> float:
        """Return by how much an error may be larger at another level, at least 1."""
        steps = [STRENGTHS[b] / STRENGTHS[a]
                 for a, b in zip(self.strengths, other.strengths, strict=True)]  # fmt: skip
        return max(1.0, other.noise / self.noise, math.sqrt(max(steps)))


@dataclass(frozen=True)
class PosteriorModes:
    """Holds the error of a hypothesis' posterior in units of the noise.

    It is a sum of moments (R, N, K) of the hypothesis' layer with independent normal factors. What
    they leave has the standard deviation ``rest`` of a phasor component in the middle of the
    volume: without it a pose would trust the directions that no mode points in.
    """

    moments: ComplexArray
    rest: float


def error_level(seen: FrameEvidence, hypothesis: int) -> ErrorLevel:
    """Return the noise and strengths, rounded up, for which an uncertainty is computed."""
    noise = 2.0 ** float(np.ceil(np.log2(seen.noise) - 0.1))
    real, imaginary = (int(part.argmax()) for part in seen.strength[hypothesis])
    strengths = min(real + real % 2, MOST), min(imaginary + imaginary % 2, MOST)
    return ErrorLevel(noise, strengths)


def error_draws(
    bank: Bank, posterior: Eigenbasis, noise: float, strength: int, part: int
) -> Array:
    """Return draws (N K, D) of the posterior's error of the layer's moments in noise units.

    A draw from the prior minus the posterior mean of its own noisy readings is a draw of the
    posterior's error (Matheron's rule; Wilson et al., JMLR 22 (2021) 105).
    """
    prior, power = posterior.prior, STRENGTHS[strength]
    count = prior.draw_readings.shape[1]
    drawn = noise * _noise_draws(count, bank.drift, part)
    readings = np.sqrt(power) * prior.draw_readings[bank.rows] + drawn
    gain = power / (power * posterior.values + noise**2)
    weights = gain[:, None] * (posterior.basis.T @ readings)
    return np.asarray(np.sqrt(power) * prior.draw_moments - posterior.synthesis @ weights)


def _noise_draws(count: int, drift: Array, part: int) -> Array:
    """Return repeatable draws of the readings' noise and drift, (n, D)."""
    rng = np.random.default_rng(1 + part)
    white = rng.standard_normal((len(drift), count))
    return np.asarray(white + drift @ rng.standard_normal((drift.shape[1], count)))


def error_modes(
    bank: Bank, posterior: Eigenbasis, level: ErrorLevel, count: int
) -> PosteriorModes:
    """Return the principal modes of a posterior's error, weighted by its effect on poses.

    The posterior is one of `Bank.posterior`, the level one of `error_level`; ``count`` modes are
    kept. It takes long and changes nothing, so any thread may do it.
    """
    layer = posterior.prior.layer
    size, width = len(layer.positions), bank.width
    draws, powers, directions = [], [], []
    for part in range(2):
        error = error_draws(bank, posterior, level.noise, level.strengths[part], part)
        felt = (layer.metric @ error.reshape(size, -1)).reshape(error.shape)
        power, direction = np.linalg.eigh(felt.T @ felt)
        draws.append(error)
        powers.append(power)
        directions.append(direction / np.sqrt(len(power)))
    # The real and the imaginary part are independent: each mode is of one of them.
    half = len(powers[0])
    largest = np.argsort(-np.concatenate(powers), kind='stable')[:count]
    moments = np.zeros((len(largest), size, width), dtype=complex)
    left = np.zeros((len(layer.middle), width))
    for part, unit in enumerate((1.0, 1j)):
        ranks = np.flatnonzero(largest // half == part)
        modes = draws[part] @ directions[part][:, largest[ranks] % half]
        moments[ranks] = unit * modes.T.reshape(-1, size, width)
        # What all directions together make of the field, less what the modes do.
        left += _power_of(layer.middle, draws[part], width) / half
        left -= _power_of(layer.middle, modes, width)
    return PosteriorModes(moments, float(np.sqrt(np.median(np.maximum(left, 0.0)) / 2.0)))


def _power_of(middle: Array, moments: Array, width: int) -> Array:
    """Return the power (Q, K) of the field of moments (N K, D), summed over the last axis."""
    field = middle @ moments.reshape(middle.shape[1], -1)
    return np.asarray((field.reshape(len(middle), width, -1) ** 2).sum(axis=2))
