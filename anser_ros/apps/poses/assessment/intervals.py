"""Computes statistics of errors, and 95 % intervals that account for correlated errors.

Errors that share points or moments are not independent: whole clusters are resampled (cluster
bootstrap), and for distances between points, the points (vertex bootstrap of Snijders and
Borgatti, Connections 22, 1999).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from anser_ros.arrays import Array, Integers

LEVEL = 0.95
"""Probability with which an interval holds what it is an interval of."""
BLOCKS = 20
"""Stretches of time whose errors count as alike. More are so short that neighbours err alike, a
hand's tilt takes about a second; with fewer the ends of an interval depend on single ones."""
DRAWS = 1000  # resamples; the ends of an interval scatter by a few hundredths of its width
CHUNK = 1_000_000  # numbers of a piece of the resamples, which takes 8 MB of memory
FEWEST_CLUSTERS = 3
"""Clusters without which nothing is resampled: two have three different resamples."""


@dataclass(frozen=True)
class IntervalEstimate:
    """Holds a figure with its interval; the ends are NaN where there is none."""

    value: float
    low: float = float('nan')
    high: float = float('nan')


def mitk_statistics(values: Array) -> dict[str, float]:
    """Return statistics under the names, and by the rules, of MITK's HummelProtocolEvaluation.

    Quartiles are elements of the sorted list: the ones at a quarter, a half, and both together of
    the number, rounded down.
    """
    ordered = np.sort(np.asarray(values, dtype=np.float64))
    count = ordered.size
    quarter, half = count // 4, count // 2
    variance = float(np.var(ordered))
    sample = variance * count / (count - 1) if count > 1 else float('nan')
    return {
        'N': float(count), 'Mean': float(ordered.mean()),
        'Min': float(ordered[0]), 'Max': float(ordered[-1]),
        'Quartile 1': float(ordered[quarter]), 'Median': float(ordered[half]),
        'Quartile 3': float(ordered[quarter + half]),
        'Variance': variance, 'Sample Variance': sample,
        'Standard Deviation': float(np.sqrt(variance)),
        'Sample Standard Deviation': float(np.sqrt(sample)),
    }  # fmt: skip


def cluster_weights(clusters: Integers, rng: np.random.Generator) -> Array:
    """Return how often each error is in each resample of whole clusters, shape (`DRAWS`, n)."""
    names, index = np.unique(clusters, return_inverse=True)
    counts = rng.multinomial(names.size, np.full(names.size, 1 / names.size), size=DRAWS)
    return np.asarray(counts[:, index], dtype=np.float64)


def vertex_weights(pairs: Integers, rng: np.random.Generator) -> Array:
    """Return how often each pair (n, 2) of points is in each resample of points, (`DRAWS`, n)."""
    count = int(pairs.max()) + 1
    counts = rng.multinomial(count, np.full(count, 1 / count), size=DRAWS)
    return np.asarray(counts[:, pairs[:, 0]] * counts[:, pairs[:, 1]], dtype=np.float64)


def summarised(values: Array, weights: Array, clusters: int) -> dict[str, IntervalEstimate]:
    """Return mean, root mean square, deviation, median and 95th percentile with intervals.

    ``values`` (n,): errors; ``weights`` (draws, n): of the resamples; ``clusters``: independent
    pieces that were drawn. The fewer, the wider the interval is made (Student's t for the normal,
    and the degree of freedom that the mean takes).
    """
    order = np.argsort(values)
    whole = _statistics(values[order], np.ones((1, values.size)))
    if clusters < FEWEST_CLUSTERS or values.size < FEWEST_CLUSTERS:
        return {name: IntervalEstimate(float(v[0])) for name, v in whole.items()}
    step = max(1, CHUNK // values.size)
    pieces = [
        _statistics(values[order], weights[k : k + step][:, order])
        for k in range(0, len(weights), step)
    ]
    wider = np.sqrt(clusters / (clusters - 1))
    wider *= stats.t.ppf(0.5 + LEVEL / 2, clusters - 1) / stats.norm.ppf(0.5 + LEVEL / 2)
    found = {}
    for name, middle in whole.items():
        drawn = np.concatenate([piece[name] for piece in pieces])
        drawn = drawn[np.isfinite(drawn)]
        low, high = np.quantile(drawn, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
        value = float(middle[0])
        low, high = value + wider * (low - value), value + wider * (high - value)
        if name != 'Mean' or values.min() >= 0:  # sizes are not negative
            low = max(low, 0.0)
        found[name] = IntervalEstimate(value, float(min(low, value)), float(max(high, value)))
    return found


def widest(found: Sequence[dict[str, IntervalEstimate]]) -> dict[str, IntervalEstimate]:
    """Return the same figures from several ways of drawing again, with the ends farthest out."""
    widened = {}
    for name, first in found[0].items():
        low = np.array([one[name].low for one in found])
        high = np.array([one[name].high for one in found])
        known = np.isfinite(low)
        if known.any():
            first = IntervalEstimate(
                first.value, float(low[known].min()), float(high[known].max())
            )
        widened[name] = first
    return widened


def _statistics(ordered: Array, weights: Array) -> Mapping[str, Array]:
    total = np.maximum(weights.sum(axis=1), 1e-300)
    mean = weights @ ordered / total
    square = weights @ ordered**2 / total
    reached = np.cumsum(weights, axis=1) / total[:, None]
    empty = weights.sum(axis=1) == 0
    found = {
        'Mean': mean, 'RMS': np.sqrt(square),
        'Standard Deviation': np.sqrt(np.maximum(square - mean**2, 0.0)),
        'Median': ordered[np.argmax(reached >= 0.5, axis=1)],
        'P95': ordered[np.argmax(reached >= 0.95 - 1e-12, axis=1)],
    }  # fmt: skip
    return {name: np.where(empty, np.nan, values) for name, values in found.items()}


def independent_for_variance(values: Array) -> float:
    """Return how many independent values determine a variance: ``n / (1 + 2 sum rho^2)``."""
    return _independent(values, 2)


def independent_for_mean(values: Array) -> float:
    """Return how many independent values determine a mean: ``n / (1 + 2 sum rho)``."""
    return _independent(values, 1)


def _independent(values: Array, power: int) -> float:
    """The count over the sum of a power of the autocorrelation, up to where it has gone under."""
    rest = values - values.mean()
    count = rest.size
    square = float(rest @ rest)
    if count < 4 or square <= 0.0:
        return float(count)
    size = 1 << int(2 * count - 1).bit_length()
    spectrum = np.fft.rfft(rest, size)
    correlation = np.fft.irfft(spectrum * spectrum.conj(), size)[: count // 2] / square
    under = np.flatnonzero(correlation[1:] < 2 / np.sqrt(count))
    last = int(under[0]) if under.size else correlation.size - 1
    together = 1 + 2 * float(np.sum(correlation[1 : last + 1] ** power))
    return float(np.clip(count / together, 2.0, count))


def deviation_interval(value: float, freedoms: float) -> IntervalEstimate:
    """Return a standard deviation with its chi-square interval by degrees of freedom."""
    low, high = np.sqrt(freedoms / stats.chi2.ppf([0.5 + LEVEL / 2, 0.5 - LEVEL / 2], freedoms))
    return IntervalEstimate(value, value * low, value * high)


def blocks_of_time(time: Array) -> Integers:
    """Return the number of the equal stretch of time, of `BLOCKS`, that each moment (n,) is in."""
    return equal_parts(time, BLOCKS)


def equal_parts(values: Array, count: int) -> Integers:
    """Return which of so many parts of equal extent each value (n,) is in."""
    extent = max(float(np.ptp(values)), 1e-9)
    numbers = (count * (values - values.min()) / extent).astype(np.int64)
    return np.asarray(np.minimum(numbers, count - 1), dtype=np.int64)
