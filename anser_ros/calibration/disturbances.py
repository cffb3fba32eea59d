"""Finds what disturbs a scan: moving metal, reflected poses, emitters whose strength changes.

Frames that no steady field and pose explain are left out. A change of an emitter's strength
changes all references' readings of it by one factor, and nothing else; metal changes each of them
by another one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import binary_propagation
from scipy.spatial import cKDTree

from anser_ros.arrays import Array, Booleans, ComplexArray, Integers
from anser_ros.field.measurements import Measurements
from anser_ros.settings import RefitSettings

BIN_S = 0.5
"""Length of the stretches, s, in which changes are looked for: metal comes and goes in seconds."""
BIN_FRAMES = 4
"""Frames of a stretch at least: their mean has half the noise of one."""
GLITCH = 6.0
"""Robust standard deviations of a pose from where the fluxes put it, from which on it is left out:
a Gaussian is that far off once in a billion."""
LEFT_OVER = 25.0
"""Power that no pose explains, in a stretch against the median stretch and against where the tool
was near the same place, from which on something moved; what a model misses at the edge of a scan
is a few times the noise."""
SHORTEST_S = 2.0
"""Time, s, for which a tool must see that something moves: four stretches."""
SEEN = 8.0
"""Power of the references' deviation, in standard deviations beyond the noise's, from which on
something moved; noise reaches it once in 1e15 stretches."""
EDGE = 3.0
"""The same, beside a stretch that something moved in: it comes and goes gradually, and noise alone
reaches it in one stretch of 700."""
QUIET_ROUNDS = 6
"""Rounds in which the quiet stretches are distinguished from the others."""


@dataclass(frozen=True)
class Span:
    """Marks a part of a session in which the field was not steady."""

    # start_s, end_s: s since the session's start
    start_s: float
    end_s: float

    def holds(self, time: Array) -> Booleans:
        """Return a mask of the times, s, that lie in the span."""
        return np.asarray((time >= self.start_s) & (time <= self.end_s))


def glitches(steps: Array, usable: Booleans, stated: Array) -> Booleans:
    """Return which frames' poses are far from where their fluxes put them, shape (F,).

    ``steps`` (F, 6): from each optical pose to where the fluxes put it, m and rad. ``usable``
    (F,): frames to judge by. ``stated`` (6,): jitter that the optical tracker is said to have, m
    and rad. A deviation that is usual for it is not taken for a wrong pose where its jitter shows
    to be less: then what the field's model misses near the board stands out first.
    """
    if usable.sum() < BIN_FRAMES:
        return np.zeros(len(steps), dtype=bool)
    middle = np.median(steps[usable], axis=0)
    spread = 1.4826 * np.median(np.abs(steps[usable] - middle), axis=0)
    return np.asarray((np.abs(steps - middle) > GLITCH * np.maximum(spread, stated)).any(axis=1))


def stretches(time: Array) -> Integers:
    """Return the number of the stretch of time that each frame is in, shape (F,)."""
    if time.size < 2:
        return np.zeros(time.size, dtype=np.int64)
    length = max(BIN_S, BIN_FRAMES * float(np.median(np.diff(time))))
    return np.asarray(np.floor((time - time[0]) / length), dtype=np.int64)


def unsteady_references(reference: Measurements) -> Booleans:
    """Return which frames' references differ from their steady readings, shape (F,).

    The noise is that of differences between frames; the steady readings are those on which most
    stretches agree.
    """
    good = reference.valid.all(axis=0)
    bins = stretches(reference.time)
    count = int(bins.max()) + 1 if bins.size else 0
    out = np.zeros(reference.time.size, dtype=bool)
    if not good.any() or count < 3:
        return out
    flux = reference.flux[:, good].reshape(reference.time.size, -1)
    values = np.concatenate([flux.real, flux.imag], axis=1)
    noise = np.median(np.abs(np.diff(values, axis=0)), axis=0) / 0.6745 / np.sqrt(2.0)
    values = values / np.maximum(noise, 1e-15)
    size = np.bincount(bins, minlength=count)
    sums = np.stack([np.bincount(bins, v, count) for v in values.T], axis=1)
    means = np.asarray(sums / np.maximum(size, 1)[:, None], dtype=np.float64)
    steady = np.median(means[size > 0], axis=0)
    excess = np.zeros(count)
    for _ in range(QUIET_ROUNDS):
        power = np.asarray(((means - steady) ** 2).mean(axis=1) * size, dtype=np.float64)
        quiet_power = np.median(power[size > 0])
        scatter = max(1.4826 * float(np.median(np.abs(power - quiet_power))), 1e-6)
        # The least scatter is that of so many squares of Gaussian numbers.
        scatter = max(scatter, np.sqrt(2.0 / values.shape[1]))
        excess = (power - quiet_power) / scatter
        quiet = (excess < EDGE) & (size > 0)
        if quiet.sum() < 2:
            break
        steady = np.average(means[quiet], axis=0, weights=size[quiet])
    return np.asarray(binary_propagation(excess > SEEN, mask=excess > EDGE)[bins])


def unsteady_tool(time: Array, place: Array, power: Array, usable: Booleans) -> Booleans:
    """Return which frames lie in stretches that no pose explains, shape (F,).

    ``time`` (F,): s, ascending. ``place`` (F, 3): of the body, m. ``power`` (F,): mean square of
    what no pose explains in each frame. ``usable`` (F,): frames to judge by.
    """
    bins = stretches(time)
    count = int(bins.max()) + 1 if bins.size else 0
    size = np.bincount(bins[usable], minlength=count)
    if (size > 0).sum() < 3:
        return np.zeros(time.size, dtype=bool)
    total = np.bincount(bins[usable], power[usable], count)
    mean = np.asarray(total / np.maximum(size, 1), dtype=np.float64)
    ratio = mean / max(float(np.median(mean[size > 0])), 1e-300)
    # With the stretches on the edge of it, as far as they adjoin.
    grown = binary_propagation(ratio > LEFT_OVER, mask=ratio > np.sqrt(LEFT_OVER))
    found = np.asarray(grown[bins])
    quiet = usable & ~found
    for span in spans_of(time, found):
        rows = np.flatnonzero(span.holds(time) & usable)
        if not rows.size or not quiet.any() or span.end_s - span.start_s < SHORTEST_S:
            found[span.holds(time)] = False
            continue
        # A field that is missed in a place is missed there at other times as well.
        _, nearest = cKDTree(place[quiet]).query(place[rows])
        beside = float(power[quiet][nearest].mean())
        if float(power[rows].mean()) < np.sqrt(LEFT_OVER) * beside:
            found[span.holds(time)] = False
    return found


def spans_of(time: Array, unsteady: Booleans) -> list[Span]:
    """Return the spans that a mask covers; gaps shorter than two stretches are closed."""
    spans: list[Span] = []
    step = float(np.median(np.diff(time))) if time.size > 1 else 0.0
    for index in np.flatnonzero(unsteady):
        start, end = float(time[index]) - step / 2.0, float(time[index]) + step / 2.0
        if spans and start - spans[-1].end_s <= 2.0 * BIN_S:
            spans[-1] = Span(spans[-1].start_s, end)
        else:
            spans.append(Span(start, end))
    return spans


def outside(time: Array, spans: Sequence[Span]) -> Booleans:
    """Return which times lie in none of the spans."""
    out = np.ones(time.size, dtype=bool)
    for span in spans:
        out &= ~span.holds(time)
    return out


FEWEST_SENSORS = RefitSettings.min_references
"""References that have to be read throughout: with fewer, metal may look like a strength."""
LEAST_DRIFT = 2e-4
"""Change of a strength (rms, relative) from which on it is one; it moves a pose by a hundredth of
a millimetre."""
CERTAIN = 5.0
"""The same in standard deviations of what noise makes of it."""
COMMON = 0.995
"""Share of the power of an emitter's changes that one factor must explain: all of a drift, but of
a large metal body that comes up from below up to 97 %."""


def emitter_strength(reference: Measurements) -> ComplexArray:
    """Return each emitter's strength relative to that at a scan's start, shape (F, K), complex.

    That is the one state which other sessions have too: a scan's median is that of warm emitters.

    It is one for emitters that do not drift, and for all emitters if there are too few references.

    ``reference``: F frames of the R references.
    """
    count, emitters = len(reference.time), reference.flux.shape[2]
    out = np.ones((count, emitters), dtype=np.complex128)
    good = reference.valid.all(axis=0)
    bins = stretches(reference.time)
    size = np.bincount(bins)
    if good.sum() < FEWEST_SENSORS or (size > 0).sum() < FEWEST_SENSORS:
        return out
    flux = reference.flux[:, good]
    noise = np.median(np.abs(np.diff(flux, axis=0)) ** 2, axis=0) / np.log(2.0) / 2.0
    seen = np.flatnonzero(size)
    means = np.array([flux[bins == b].mean(axis=0) for b in seen])
    middle = np.array([reference.time[bins == b].mean() for b in seen])
    for k in range(emitters):
        own = means[:, :, k]
        steady = np.median(own.real, axis=0) + 1j * np.median(own.imag, axis=0)
        weight = 1.0 / np.maximum(noise[:, k], 1e-30)
        total = float((weight * np.abs(steady) ** 2).sum())
        gain = (own * (weight * steady.conj())).sum(axis=1) / max(total, 1e-300)
        change = own - steady
        power = float((weight * np.abs(change) ** 2 * size[seen, None]).sum())
        common = float((total * np.abs(gain - 1.0) ** 2 * size[seen]).sum())
        drift = float(np.sqrt(np.mean(np.abs(gain - 1.0) ** 2)))
        by_noise = np.sqrt(1.0 / max(total * float(np.mean(size[seen])), 1e-300))
        is_drift = drift >= max(LEAST_DRIFT, CERTAIN * by_noise)
        if is_drift and common > COMMON * (power - float(change.size)):
            course = CubicSpline(middle, gain)
            out[:, k] = course(reference.time) / course(middle[0])
    return out


def at_strength(measurements: Measurements, time: Array, strength: ComplexArray) -> Measurements:
    """Return measurements as emitters of constant strength would have given them.

    ``time`` (G,): s, ascending. ``strength`` (G, K): of the emitters at these times, as of
    `emitter_strength`.
    """
    now = np.stack([np.interp(measurements.time, time, column) for column in strength.T], axis=1)
    return replace(measurements, flux=measurements.flux / now[:, None, :])
