"""Tests whether grown residuals are noise: alike in all frames, readings and sizes, and normal.

Hum, a common disturbance, rounding or a gain that rattles raise the residual's spread as noise
does. Noise is uncorrelated in time and between readings, does not grow with the reading, and is
normally distributed.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.decisions import LEAST_CORRELATION, NOT_NORMAL, SHARED, WITH_SIZE
from anser_ros.diagnosis.problem import Part, State

Array = NDArray[np.float64]

LAGS = 12
"""Frames back to which a memory is looked for: half a second at 25 Hz. Fewer overlook a slow
course, and each further one is one more chance for noise to pass the bound."""
OUTLYING = 4.5
"""Standard deviations beyond which a value is not used here, once in 150,000: outliers are judged
elsewhere, and one alone would make a kurtosis."""


@dataclass(frozen=True)
class Whiteness:
    """Holds the strongest structure of each kind that is no noise; zero where none is found."""

    memory: float
    shared: float
    with_size: float
    kurtosis: float

    @property
    def holds(self) -> bool:
        """Return whether the residuals may be called noise."""
        return not self.depends_on

    @property
    def depends_on(self) -> tuple[str, ...]:
        """Return what they depend on, in the words of `docs/interfaces.md`."""
        found: list[str] = []
        if self.memory > LEAST_CORRELATION:
            found.append('time')
        if self.shared > SHARED:
            found += ['channel', 'emitter']
        if self.with_size > WITH_SIZE or abs(self.kurtosis) > NOT_NORMAL:
            found.append('amplitude')
        return tuple(found)


def whiteness(state: State) -> Whiteness:
    """Test the tools' whitened residuals, each value over the spread of its own kind."""
    tools = [p for p in state.parts if not p.view.is_reference and p.white.shape[0] > 2 * LAGS]
    if not tools:
        return Whiteness(0.0, 0.0, 0.0, 0.0)
    values = [_scaled(part) for part in tools]
    return Whiteness(
        max(_memory(part, v) for part, v in zip(tools, values, strict=True)),
        max(_shared(v) for v in values),
        max(_with_size(part, v) for part, v in zip(tools, values, strict=True)),
        _kurtosis(values),
    )


def _scaled(part: Part) -> Array:
    """Residuals over the spread of their column; NaN where there is none or it stands out."""
    good = part.whitener.weight > 0
    white = np.where(good, part.white, np.nan)
    count = np.maximum(good.sum(axis=0), 1)
    size = np.sqrt(np.nansum(white**2, axis=0) / count)
    out = white / np.where(size > 0, size, 1.0)
    return np.where(np.abs(out) < OUTLYING, out, np.nan)


def _memory(part: Part, values: Array) -> float:
    """Largest correlation with an earlier frame, over lags and all columns pooled."""
    step = np.median(np.diff(part.view.time))
    known = np.nan_to_num(values)
    most = 0.0
    for lag in range(1, LAGS + 1):
        near = np.abs(part.view.time[lag:] - part.view.time[:-lag] - lag * step) < 0.5 * step
        if near.sum() < LAGS:
            continue
        one, other = known[lag:][near], known[:-lag][near]
        power = np.sqrt(float(np.sum(one**2)) * float(np.sum(other**2)))
        most = max(most, abs(float(np.sum(one * other))) / max(power, 1e-300))
    return most


def _shared(values: Array) -> float:
    """Largest eigenvalue of the correlations over Marchenko and Pastur's upper edge."""
    used = values[:, np.isfinite(values).mean(axis=0) > 0.5]
    frames, count = used.shape
    if count < 2 or frames < 8:
        return 0.0
    known = np.nan_to_num(used)
    known = known / np.sqrt(np.maximum(np.mean(known**2, axis=0), 1e-300))
    gram = known @ known.T if frames < count else known.T @ known
    largest = float(np.linalg.eigvalsh(gram / frames)[-1])
    return largest / float(1 + np.sqrt(count / frames)) ** 2


def _with_size(part: Part, values: Array) -> float:
    """Correlation of squared residuals with squared readings, each over its column's mean."""
    flux = part.view.flux
    flat = np.concatenate([np.abs(flux).reshape(flux.shape[0], -1) ** 2] * 2, axis=1)
    known = np.isfinite(values)
    size = flat / np.maximum(flat.mean(axis=0), 1e-300)
    a, b = values[known] ** 2, size[known]
    a, b = a - a.mean(), b - b.mean()
    power = np.sqrt(float(a @ a) * float(b @ b))
    return float(float(a @ b) / power) if power > 0 else 0.0


def _kurtosis(values: list[Array]) -> float:
    known = np.concatenate([v[np.isfinite(v)] for v in values])
    # A normal distribution cut at OUTLYING has a kurtosis of 2.99.
    return float(np.mean(known**4) / np.mean(known**2) ** 2 - 2.99)
