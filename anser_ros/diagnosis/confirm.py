"""Tests whether an effect is the same in all parts of the data, as a real one must be.

Each effect is fitted again in parts of the time, emitter by emitter and by sensor. The power that
those fits remove besides is compared with the power that the effect itself removes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis import decisions
from anser_ros.diagnosis.fit import Fit
from anser_ros.diagnosis.problem import Part, Problem, State, evaluate, parts
from anser_ros.effects.effect import INEXACT, Family, Term

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Confirmation:
    """Holds the evidence for an effect."""

    power: float  # what it takes off the sum of squares
    variation: float  # share of that power that refits in parts of the data take off besides
    share_of_rest: float  # its power over the power that stays unexplained
    # Share of its power that stays on the channels and emitters that it changes, beyond what stays
    # everywhere. Metal is exempt: its shape is never known.
    remainder: float = 0.0
    inexact: float = INEXACT  # largest remainder that the effect may leave
    alike: int = 1  # effects of the same name, or on the same single channel, whichever are more
    plausible: bool = True  # whether all parameters are in the effect's range
    # Whether it takes something off the tools' residuals, where it acts on tools.
    helps: bool = True

    @property
    def holds(self) -> bool:
        """Return whether the effect may be named."""
        return not self.reason

    @property
    def reason(self) -> str:
        """Return why it may not be named, in words; empty where it may."""
        if not self.plausible:
            return 'its parameters are outside their plausible range'
        if not self.helps:
            return 'only the references support it, and the tools contradict it'
        if self.variation >= decisions.LARGEST_VARIATION:
            return 'its parameters differ from one part of the data to the next'
        if self.remainder >= self.inexact:
            return 'too much stays unexplained where it acts'
        if self.alike >= decisions.MANY:
            return 'several effects of its kind together imitate a cause that they share'
        if self.share_of_rest <= decisions.LEAST_OF_THE_REST:
            return 'much more stays unexplained than it explains'
        return ''


def _checked(problem: Problem, fit: Fit, term: Term, noise: float) -> Confirmation:
    """Check one term of a fit; ``noise`` is the variance of the whitened noise."""
    rest = [t for t in fit.terms if t is not term and not t.belongs_to(term)]
    without = evaluate(problem, rest)
    power = without.sum_of_squares - fit.state.sum_of_squares
    left = max(fit.state.sum_of_squares - noise * fit.state.count, 0.0)
    left_tools = left if fit.misfit > decisions.SOMETHING_LEFT * noise else 0.0
    columns = fit.state.design(term)
    remainder = 0.0
    if np.isfinite(term.effect.inexact):
        remainder = _stays(fit.state, columns, noise, max(1.0, decisions.MODEL_ERROR * noise))
    return Confirmation(
        power,
        _varying(fit.state, columns, noise) / max(power, 1e-300),
        power / max(left_tools, 1e-300),
        remainder / max(power, 1e-300),
        inexact=term.effect.inexact,
        alike=_crowd(fit, term),
        plausible=_plausible(fit, term),
        helps=_helps(without, fit.state, columns),
    )


def _helps(without: State, with_it: State, columns: Sequence[Array | None]) -> bool:
    gain, acts = 0.0, False
    for before, after, column in zip(without.parts, with_it.parts, columns, strict=True):
        if column is not None and not after.view.is_reference:
            acts = True
            gain += float(np.sum(before.white**2) - np.sum(after.white**2))
    return gain > 0.0 or not acts


def _crowd(fit: Fit, term: Term) -> int:
    """Effects of a fit with the same name, or about the same channel."""
    alike = sum(t.effect is term.effect for t in fit.effects)
    about = [sum(c in _singled(t) for t in fit.effects) for c in _singled(term)]
    return max([alike, *about])


def _singled(term: Term) -> set[int]:
    """Channels that a term is about, where they are one or two."""
    return set(term.channels) if len(term.channels) <= 2 else set()


def _plausible(fit: Fit, term: Term) -> bool:
    """Whether the record's values are in the effect's ranges."""
    index = next(i for i, t in enumerate(fit.terms) if t is term)
    return term.effect.possible(term.effect.record(term, fit.covariance_of(index)))


def _stays(state: State, columns: Sequence[Array | None], noise: float, expected: float) -> float:
    """Power beyond the noise in the cells that a term changes, less what cells have in common.

    A cell is one channel's readings of one emitter; ``expected`` is the variance below which the
    residual of an effect on all cells is ignored.
    """
    own, rest, counts = [], [], []
    for part, column in zip(state.parts, columns, strict=True):
        if part.view.is_reference:
            continue
        sensors, emitters = part.view.flux.shape[1:]
        shape = (-1, 2, sensors, emitters)
        excess = part.white**2 - noise * (part.whitener.weight > 0)
        left = excess.reshape(shape).sum(axis=(0, 1))
        changed = np.zeros((sensors, emitters), dtype=bool)
        if column is not None:
            size = np.abs(column).sum(axis=2).reshape(shape).sum(axis=(0, 1))
            # The pose's marginalisation spreads a trace of every change over all channels.
            changed = size > decisions.CHANGED * size.max()
        good = (part.whitener.weight > 0).reshape(shape).sum(axis=(0, 1))
        own.append(left[changed])
        rest.append(left[~changed])
        counts.append(good[changed])
        spread = noise * np.sqrt(4.0 * part.white.shape[0])
    acted, others, values = (np.concatenate(found) for found in (own, rest, counts))
    if acted.size == 0:
        return 0.0
    if others.size < acted.size:
        # An effect on everything: what single channels keep is not its fault, nor is what the
        # field model may be wrong by, which is in the expected spread but not in the noise.
        model = max(expected - noise, 0.0) * float(np.median(values))
        stays = max(float(np.median(acted)) - model, 0.0) * acted.size
    else:
        stays = float(acted.sum() - np.median(others) * acted.size)
    return stays if stays > decisions.LEAST_POWER_SIGMAS * spread * np.sqrt(acted.size) else 0.0


def _checked_open(problem: Problem, fit: Fit, term: Term, noise: float) -> Confirmation:
    """Check a fluctuation: its likelihood speaks for it, unless much stays where it acts."""
    without = evaluate(problem, [t for t in fit.terms if t is not term])
    power = max(without.sum_of_squares - fit.state.sum_of_squares, 1e-300)
    columns = []
    for part in fit.state.parts:
        raw = term.effect.directions(term, part.view)
        columns.append(None if raw is None else parts(raw) * part.whitener.weight[..., None])
    stays = _stays(fit.state, columns, noise, noise) / power
    return Confirmation(power, 0.0, np.inf, stays, alike=_crowd(fit, term))


def doubtful(problem: Problem, fit: Fit, noise: float) -> list[tuple[Confirmation, Term]]:
    """Return a fit's effects that are not confirmed, the one with the least power first."""
    fitted = [term for term in fit.effects if term.theta.size]
    free = [term for term in fit.terms if term.effect.family is Family.FLUCTUATION]
    checks = [(_checked(problem, fit, term, noise), term) for term in fitted]
    checks += [(_checked_open(problem, fit, term, noise), term) for term in free]
    checks += _unsteady(problem, fit)
    bad = [(check, term) for check, term in checks if not check.holds]
    return sorted(bad, key=lambda pair: pair[0].power)


def _unsteady(problem: Problem, fit: Fit) -> list[tuple[Confirmation, Term]]:
    """Steady effects of a coil or channel that fluctuates besides, by the share that does."""
    found = []
    for free in fit.terms:
        for term in fit.terms:
            if not free.effect.rivals(free, term):
                continue
            steady = [t for t in fit.terms if t is not free]
            alone = evaluate(problem, steady).sum_of_squares
            none = evaluate(problem, [t for t in steady if t is not term]).sum_of_squares
            power = max(none - alone, 1e-300)
            share = (alone - fit.state.sum_of_squares) / power
            found.append((Confirmation(power, 0.0, np.inf, share), term))
    return found


def _varying(state: State, columns: Sequence[Array | None], noise: float) -> float:
    """Power that refits in parts of the time, or emitter by emitter, or by sensor, take off."""
    used = [
        (part, column)
        for part, column in zip(state.parts, columns, strict=True)
        if column is not None and not part.view.is_reference
    ]
    if not used:
        return 0.0
    numbers = np.unique(np.concatenate([part.blocks for part in state.parts]))
    firsts = [group[0] for group in np.array_split(numbers, decisions.TIME_PARTS) if group.size]
    times = [np.searchsorted(firsts, part.blocks, side='right')[:, None] for part, _ in used]
    cells = [np.indices((2, *p.view.flux.shape[1:])).reshape(3, 1, -1) for p, _ in used]
    kinds = (times, [cell[1] for cell in cells], [cell[2] for cell in cells])
    return max(_refits(used, noise, labels) for labels in kinds)


def _refits(
    used: Sequence[tuple[Part, Array]], noise: float, labels: Sequence[NDArray[np.int64]]
) -> float:
    """Power beyond chance that a refit of the values of each label takes off."""
    total = 0.0
    for value in np.unique(np.concatenate([label.ravel() for label in labels])):
        normal, right = 0.0, 0.0
        for (part, column), label in zip(used, labels, strict=True):
            chosen = np.broadcast_to(label == value, part.white.shape)
            flat = column[chosen]
            normal = normal + flat.T @ flat
            right = right + flat.T @ part.white[chosen]
        if np.any(normal):
            total += max(_extra(np.asarray(normal), np.asarray(right), noise), 0.0)
    return total


def _extra(normal: Array, right: Array, noise: float) -> float:
    """Power beyond chance that a refit in one part takes off."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / scale[:, None] / scale[None, :]
    inverse = np.linalg.pinv(scaled, rcond=1e-8, hermitian=True)
    b = right / scale
    return float(b @ inverse @ b - noise * right.size)
