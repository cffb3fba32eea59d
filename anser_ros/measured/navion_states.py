"""Splits the eight states of the currents into fields, what the iron remembers, and a slow supply.

Eight sign combinations of three equal currents are a complete two-level design: the readings are
one constant, three coil fields, three pair terms and one triple term (Box, Hunter and Hunter,
Statistics for Experimenters, chapter 5). Linear magnets have no pair and no triple term.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.measured.navion_fit import PlateFit
from anser_ros.measured.navion_plate import Plate, PlateData, vector_basis

Array = NDArray[np.float64]

_MEMORY_MOMENT_AM2 = 30.0
"""Expected size of a moment that the iron remembers, A m^2, a prior of the fit."""
_MEMORY_NOISE_T = 2e-5
"""Noise of a reading in the fit of the iron's memory, T."""
_OFFSET_T = 3e-4
"""Expected size of a sensor's constant offset, T, a prior of the fit."""


def split_states(reading_t: Array, sign: Array) -> Array:
    """Return constant, coil, pair and triple terms (8, ...) of the eight states' readings (8,
    ...).

    Raises
    ------
    FitError
        When the currents are no complete two-level design.
    """
    if sign.shape != (8, 3) or len(np.unique(sign, axis=0)) != 8:
        raise FitError('need the eight sign combinations of three currents')
    return np.asarray(np.tensordot(_design(sign).T / 8.0, reading_t, axes=1))


def join_states(terms_t: Array, sign: Array) -> Array:
    """Return readings (8, ...) of the eight states from their terms (8, ...)."""
    return np.asarray(np.tensordot(_design(sign), terms_t, axes=1))


def _design(sign: Array) -> Array:
    a, b, c = sign.T
    return np.stack([np.ones(8), a, b, c, a * b, a * c, b * c, a * b * c], axis=1)


@dataclass(frozen=True)
class Memory:
    """Holds what a reading contains besides the linear coil fields.

    Attributes
    ----------
    offset_t : ndarray, shape (S, 3)
        Each sensor's constant: its own offset, the Earth's field, remanence.
    moment_am2 : ndarray, shape (3N, 4)
        The sources' moments for the pair and triple terms: iron that hasn't forgotten the state
        before, or saturates.
    """

    offset_t: Array
    moment_am2: Array


def learn_memory(data: PlateData, terms_t: Array, fit: PlateFit) -> Memory:
    """Learn offsets and hysteresis from the fitted heights.

    Parameters
    ----------
    data : PlateData
        The heights that `fit` was fitted to.
    terms_t : ndarray, shape (P, 8, S, 3)
        Their terms, T.
    fit : PlateFit
    """
    weight = fit.weight[..., None]
    constant = (weight * terms_t[:, 0]).sum(axis=0)
    offset = constant / (weight.sum(axis=0) + (_MEMORY_NOISE_T / _OFFSET_T) ** 2)
    position, sensing = sensor_frames(data, fit, fit.states)
    basis = vector_basis(position.reshape(-1, 3), fit.sources.position_m)
    rows = np.einsum('psil,pslm->psim', sensing, basis.reshape(*position.shape[:2], 3, -1))
    flat = rows.reshape(-1, rows.shape[3])
    heavy = np.broadcast_to(fit.weight[..., None], rows.shape[:3]).reshape(-1)
    normal = (flat * heavy[:, None]).T @ flat
    normal += np.eye(len(normal)) * (_MEMORY_NOISE_T / _MEMORY_MOMENT_AM2) ** 2
    wanted = terms_t[:, 4:].transpose(1, 0, 2, 3).reshape(4, -1)
    return Memory(offset, np.linalg.solve(normal, flat.T @ (heavy * wanted).T))


def predict_memory(data: PlateData, fit: PlateFit, memory: Memory) -> Array:
    """Return pair and triple terms (P, 4, S, 3), T, at heights whose plate state nobody knows."""
    states = np.zeros((len(data.height_m), fit.states.shape[1]))
    position, sensing = sensor_frames(data, fit, states)
    basis = vector_basis(position.reshape(-1, 3), fit.sources.position_m)
    field = (basis @ memory.moment_am2).reshape(*position.shape, 4)
    return np.asarray(np.einsum('psil,pslk->pksi', sensing, field))


def sensor_frames(data: PlateData, fit: PlateFit, states: Array) -> tuple[Array, Array]:
    """Return positions (P, S, 3) and sensing matrices (P, S, 3, 3) of the sensors at some
    heights.
    """
    plate = Plate(data.grid_m)
    placed = [
        plate.place(height, state, fit.errors.shift_m)
        for height, state in zip(data.height_m, states, strict=True)
    ]
    position = np.array([p for p, _ in placed])
    rotation = np.array([r for _, r in placed])
    return position, np.einsum('sij,pslj->psil', fit.errors.matrix, rotation)


@dataclass(frozen=True)
class Slew:
    """Describes a supply that ramps its current: it starts `delay_s` after the command, then moves
    steadily.

    Attributes
    ----------
    delay_s : float
    rate_a_per_s : float
    """

    delay_s: float
    rate_a_per_s: float

    def settled_s(self, change_a: float) -> float:
        """Return the seconds after a command at which a change of `change_a` has arrived."""
        return self.delay_s + abs(change_a) / self.rate_a_per_s


def fit_slew(time_s: Array, reading_t: Array, command_s: Array, current_a: Array) -> Slew:
    """Fit the ramp to the changes between full-current states of one height.

    A change's progress is the projection of the readings on the difference between the states'
    settled means; the middle of each ramp, 20 to 80 %, gives a straight line. The coils of one
    command differ in direction but not in size, so one progress serves all of them.

    Parameters
    ----------
    time_s : ndarray, shape (T,)
    reading_t : ndarray, shape (T, S, 3)
    command_s : ndarray, shape (C,)
        Times of the commands.
    current_a : ndarray, shape (C, 3)
        The commanded currents.

    Raises
    ------
    FitError
        When no ramp has two readings in its middle.
    """
    flat = reading_t.reshape(len(time_s), -1)
    starts, rates = [], []
    for k in range(1, len(command_s) - 1):
        old = flat[(time_s > command_s[k] - 1.5) & (time_s < command_s[k])].mean(axis=0)
        new = flat[(time_s > command_s[k + 1] - 1.5) & (time_s < command_s[k + 1])].mean(axis=0)
        span = (time_s > command_s[k]) & (time_s < command_s[k] + 4.0)
        progress = (flat[span] - old) @ (new - old) / ((new - old) @ (new - old))
        middle = (progress > 0.2) & (progress < 0.8)
        change = float(np.abs(current_a[k] - current_a[k - 1]).max())
        if middle.sum() < 2:
            continue
        slope, level = np.polyfit(time_s[span][middle] - command_s[k], progress[middle], 1)
        starts.append(-level / slope)
        rates.append(slope * change)
    if not rates:
        raise FitError('no change of current has two readings in the middle of its ramp')
    return Slew(float(np.median(starts)), float(np.median(rates)))
