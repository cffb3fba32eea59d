"""The refitted model: calibrated dipoles, the layer's moments on top, and their uncertainty."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.fitting.model import FieldModel
from anser_ros.fitting.refit_layer import Layer
from anser_ros.fitting.refit_modes import error_modes
from anser_ros.fitting.refit_posterior import Bank, Evaluation

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

NEGLIGIBLE = 0.01
"""Hypotheses less probable than this take no part in the mean."""
INFLATION_STEP = 1.2
MOST_MODES = 16


class Assembly:
    """Puts refitted models together.

    Parameters
    ----------
    model : FieldModel
        Calibrated.
    layers : sequence of Layer
        All layers that hypotheses may use; the first one is in every refitted model.
    """

    def __init__(self, model: FieldModel, layers: Sequence[Layer]) -> None:
        self.base = model
        self.layers = tuple(layers)
        self._modes: dict[tuple[object, ...], ComplexArray] = {}
        self._geometry: dict[int, tuple[Array, Array, list[NDArray[np.int64]]]] = {}

    def _place(self, count: int) -> tuple[Array, Array, list[NDArray[np.int64]]]:
        """Dipoles with the first ``count`` layers, and the rows of each layer among them."""
        if count not in self._geometry:
            positions, directions = [self.base.positions], [self.base.directions]
            rows, size = [], len(self.base.positions)
            for layer in self.layers[:count]:
                own = np.empty(0, dtype=np.int64) if layer.rows is None else layer.rows
                added = len(layer.positions) - own.size
                rows.append(np.concatenate([own, np.arange(size, size + added)]))
                positions.append(layer.positions[own.size :])
                directions.append(layer.directions[own.size :])
                size += added
            self._geometry[count] = (np.concatenate(positions), np.concatenate(directions), rows)
        return self._geometry[count]

    def model(
        self,
        bank: Bank,
        seen: Evaluation,
        weights: Array,
        drift: ComplexArray,
        typical: float,
        phase: ComplexArray,
        unit: float,
        n_modes: int,
    ) -> FieldModel:
        """The model of one frame.

        Parameters
        ----------
        bank, seen
            The hypotheses and what they say.
        weights : ndarray, shape (H,)
            Their probabilities.
        drift : ndarray, shape (K,), complex
            Relative change of the emitters' strength.
        typical : float
            Left-out chi-square per degree of freedom of the typical coil.
        phase : ndarray, shape (K,), complex
            Of the emitters' own field.
        unit : float
            T of a noise unit.
        n_modes : int
        """
        active = [h for h in np.flatnonzero(weights > NEGLIGIBLE).tolist() if h > 0]
        place = {id(layer): i for i, layer in enumerate(self.layers)}
        of = {h: place[id(bank.priors[h - 1].layer)] for h in active}
        positions, directions, rows = self._place(1 + max(of.values(), default=0))
        moments = np.zeros((len(positions), len(phase)), dtype=complex)
        moments[: len(self.base.moments)] = self.base.moments * (1.0 + drift)
        parts = {h: self._moments(bank, seen, h) * (phase * unit) for h in active}
        for h, part in parts.items():
            moments[rows[of[h]]] += weights[h] * part
        modes = self.base.modes
        if active:
            best = max(active, key=lambda h: float(weights[h]))
            own = self._error(bank, seen, best, typical, n_modes) * (phase * unit)
            modes = np.zeros((len(own) + 1, *moments.shape), dtype=complex)
            modes[:-1, rows[of[best]]] = own
            others = [h for h in active if h != best]
            if others:
                other = max(others, key=lambda h: float(weights[h]))
                size = np.sqrt(weights[best] * weights[other])
                modes[-1, rows[of[best]]] += size * parts[best]
                modes[-1, rows[of[other]]] -= size * parts[other]
            if self.base.modes is not None:
                kept = np.zeros((len(self.base.modes), *moments.shape), dtype=complex)
                kept[:, : len(self.base.moments)] = self.base.modes
                modes = np.concatenate([kept, modes])
        elif modes is not None and len(positions) > len(self.base.positions):
            pad = np.zeros((len(modes), len(positions) - modes.shape[1], modes.shape[2]))
            modes = np.concatenate([modes, pad], axis=1)
        return replace(
            self.base, positions=positions, directions=directions, moments=moments, modes=modes
        )

    @staticmethod
    def _moments(bank: Bank, seen: Evaluation, hypothesis: int) -> ComplexArray:
        parts = bank.moments(seen, hypothesis)
        return np.asarray((parts[:, 0] + 1j * parts[:, 1]).reshape(-1, bank.width))

    def _error(
        self, bank: Bank, seen: Evaluation, hypothesis: int, typical: float, n_modes: int
    ) -> ComplexArray:
        """Modes of one standard deviation, in noise units; larger where readings fit badly."""
        steps = max(0, round(np.log(max(typical, 1.0)) / (2.0 * np.log(INFLATION_STEP))))
        level = bank.error_level(seen, hypothesis)
        key = (id(bank), hypothesis, level, n_modes)
        if key not in self._modes:
            if len(self._modes) >= MOST_MODES:
                del self._modes[next(iter(self._modes))]
            self._modes[key] = error_modes(bank, hypothesis, level, n_modes - 1)
        return np.asarray(INFLATION_STEP**steps * self._modes[key])
