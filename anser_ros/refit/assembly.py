"""The refitted model: calibrated dipoles, the layer's added moments, and their uncertainty."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import FieldModel
from anser_ros.refit.evidence import FrameEvidence
from anser_ros.refit.layer import Layer
from anser_ros.refit.modes import ErrorLevel, PosteriorModes, error_level, error_modes
from anser_ros.refit.posterior import Bank

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

NEGLIGIBLE = 0.01
"""Hypotheses less probable than this take no part in the mean."""
INFLATION_STEP = 1.2
"""Ratio of neighbouring factors by which modes are inflated. The steps keep modes, and what was
computed for them, the same for many frames."""
Uncertainty = tuple[ComplexArray | None, float]
"""Modes and flux error of a model."""

MOST_MODES = 16
"""Sets of modes that are kept; the oldest is dropped."""
KEEP_FRAMES = 25
"""Frames for which an inflation is kept at least before it may fall."""
RIVAL = 0.05
"""Probability from which on a second hypothesis adds what it disagrees about."""


@dataclass(frozen=True)
class Geometry:
    """Dipoles of the calibrated model and of some layers.

    Attributes
    ----------
    positions, directions : ndarray, shape (N, 3)
    layer_rows : mapping of str to ndarray
        Rows of each layer's dipoles, by the layer's name.
    """

    positions: Array
    directions: Array
    layer_rows: dict[str, NDArray[np.int64]]

    @property
    def name(self) -> tuple[str, ...]:
        """Names of the layers, which are equal for the same dipoles."""
        return tuple(self.layer_rows)

    @classmethod
    def of(cls, base: FieldModel, layers: Sequence[Layer]) -> 'Geometry':
        """Join a model and layers; a layer that uses dipoles of the model adds only the others."""
        positions, directions = [base.positions], [base.directions]
        rows: dict[str, NDArray[np.int64]] = {}
        size = len(base.positions)
        for layer in layers:
            own = np.empty(0, dtype=np.int64) if layer.rows is None else layer.rows
            added = len(layer.positions) - own.size
            rows[layer.name] = np.concatenate([own, np.arange(size, size + added)])
            positions.append(layer.positions[own.size :])
            directions.append(layer.directions[own.size :])
            size += added
        return cls(np.concatenate(positions), np.concatenate(directions), rows)

    def rows(self, bank: Bank, hypothesis: int) -> NDArray[np.int64]:
        """Return the rows of the dipoles of a hypothesis' layer."""
        return self.layer_rows[bank.prior(hypothesis).layer.name]


class Assembly:
    """Assembles refitted models from the calibrated model and the hypotheses' layers.

    Parameters
    ----------
    model : FieldModel
        Calibrated.
    """

    def __init__(self, model: FieldModel) -> None:
        self.base = model
        self._modes: dict[tuple[object, ...], PosteriorModes] = {}
        self._whole: dict[tuple[object, ...], tuple[int, Uncertainty]] = {}
        self._count = 0
        self._geometry: Geometry | None = None

    def _place(self, layers: Sequence[Layer]) -> Geometry:
        """Return the dipoles with some layers, in the same arrays while the layers stay."""
        told = self._geometry
        if told is None or told.name != tuple(layer.name for layer in layers):
            told = self._geometry = Geometry.of(self.base, layers)
        return told

    def model(
        self,
        bank: Bank,
        seen: FrameEvidence,
        weights: Array,
        drift: ComplexArray,
        typical: float,
        phase: ComplexArray,
        unit: float,
        n_modes: int,
    ) -> FieldModel:
        """Return the refitted model of one frame.

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
        layers = {layer.name: layer for layer in (bank.prior(h).layer for h in active)}
        place = self._place(list(layers.values()))
        moments = np.zeros((len(place.positions), len(phase)), dtype=complex)
        moments[: len(self.base.moments)] = self.base.moments * (1.0 + drift)
        scale = phase * unit
        parts = {h: bank.moments(seen, h) * scale for h in active}
        for h, part in parts.items():
            moments[place.rows(bank, h)] += weights[h] * part
        modes, rest = self._uncertainty(bank, seen, weights, parts, typical, scale, n_modes, place)
        return replace(
            self.base,
            positions=place.positions,
            directions=place.directions,
            moments=moments,
            modes=modes,
            flux_error_t=rest,
        )

    def _uncertainty(
        self,
        bank: Bank,
        seen: FrameEvidence,
        weights: Array,
        parts: dict[int, ComplexArray],
        typical: float,
        scale: ComplexArray,
        n_modes: int,
        place: Geometry,
    ) -> Uncertainty:
        """Return all modes and the remaining error, unchanged for a while to spare receivers."""
        ranked = sorted(parts, key=lambda h: -float(weights[h]))
        rival = next((h for h in ranked[1:] if float(weights[h]) > RIVAL), None)
        steps = max(0, round(np.log(max(typical, 1.0)) / (2.0 * np.log(INFLATION_STEP))))
        level = error_level(bank, seen, ranked[0]) if ranked else None
        names = tuple(bank.prior(h).name for h in ranked[:1] + ([] if rival is None else [rival]))
        key = (bank.rows.tobytes(), names, level, steps, place.name)
        self._count += 1
        kept = self._whole.get(key)
        if kept is not None and self._count - kept[0] < KEEP_FRAMES:
            return kept[1]
        size = len(place.positions)
        shape = (size, len(scale))
        modes = [] if self.base.modes is None else [_padded(self.base.modes, size)]
        rest = 0.0
        if ranked and level is not None:
            own = np.zeros((n_modes, *shape), dtype=complex)
            rows = place.rows(bank, ranked[0])
            errors = self._error(bank, ranked[0], level, n_modes - 1)
            own[: len(errors.moments), rows] = errors.moments * (INFLATION_STEP**steps * scale)
            rest = errors.rest * INFLATION_STEP**steps * float(np.abs(scale[0]))
            if rival is not None:
                part = np.sqrt(weights[ranked[0]] * weights[rival])
                own[-1, rows] += part * parts[ranked[0]]
                own[-1, place.rows(bank, rival)] -= part * parts[rival]
            modes.append(own)
        flux_error = float(np.hypot(self.base.flux_error_t, rest))
        whole = (np.concatenate(modes) if modes else None, flux_error)
        if len(self._whole) >= MOST_MODES:
            del self._whole[next(iter(self._whole))]
        self._whole[key] = (self._count, whole)
        return whole

    def _error(self, bank: Bank, hypothesis: int, level: ErrorLevel, count: int) -> PosteriorModes:
        """Return the error of one hypothesis in units of the noise."""
        key = (bank.rows.tobytes(), bank.prior(hypothesis).name, level, count)
        if key not in self._modes:
            if len(self._modes) >= MOST_MODES:
                del self._modes[next(iter(self._modes))]
            self._modes[key] = error_modes(bank, hypothesis, level, count)
        return self._modes[key]


def _padded(modes: ComplexArray, size: int) -> ComplexArray:
    """Return modes (R, N, K) with rows of zeros for the dipoles that were added."""
    out = np.zeros((modes.shape[0], size, modes.shape[2]), dtype=complex)
    out[:, : modes.shape[1]] = modes
    return out
