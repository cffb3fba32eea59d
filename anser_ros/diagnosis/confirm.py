"""Whether an effect is the same in all parts of the data, as a real one must be.

What an unknown effect leaves is often picked up by some known one, with parameters that are
different from one part of the data to the next. So each effect is fitted again in parts of the
time and emitter by emitter, and the power that those fits take off besides is set against the
power that the effect itself takes off.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.fit import Fit, misfit
from anser_ros.diagnosis.problem import Part, Problem, State, evaluate
from anser_ros.diagnosis.refine import belongs_to
from anser_ros.effects.effect import Term
from anser_ros.effects.metal_remainder import REMAINDER

Array = NDArray[np.float64]

TIME_PARTS = 6
LARGEST_VARIATION = 0.1
"""Share of an effect's power that may vary."""
LEAST_OF_THE_REST = 0.2
"""An effect that takes off less than this share of what stays unexplained is not named."""


@dataclass(frozen=True)
class Confirmation:
    """What speaks for an effect.

    Attributes
    ----------
    power : float
        What it takes off the sum of squares.
    variation : float
        Share of that power that refits in parts of the data take off besides.
    share_of_rest : float
        Its power over the power that stays unexplained.
    """

    power: float
    variation: float
    share_of_rest: float

    @property
    def holds(self) -> bool:
        """Whether the effect may be named."""
        return self.variation < LARGEST_VARIATION and self.share_of_rest > LEAST_OF_THE_REST


def confirm(problem: Problem, fit: Fit, term: Term, noise: float) -> Confirmation:
    """Check one term of a fit; ``noise`` is the variance of the whitened noise."""
    rest = [t for t in fit.terms if t is not term and not belongs_to(t, term)]
    without = evaluate(problem, rest)
    power = without.sum_of_squares - fit.state.sum_of_squares
    left = max(fit.state.sum_of_squares - noise * fit.state.count, 0.0)
    left_tools = left if misfit(fit) > 1.02 * noise else 0.0
    columns = fit.state.design(term)
    varying = max(
        _by_time(fit.state, columns, noise),
        _by_value(fit.state, columns, noise, _emitter_of),
        _by_value(fit.state, columns, noise, _sensor_of),
    )
    return Confirmation(
        power, varying / max(power, 1e-300), power / max(left_tools, 1e-3 * fit.state.count)
    )


def doubtful(problem: Problem, fit: Fit, noise: float) -> list[tuple[Confirmation, Term]]:
    """The effects of a fit that are not confirmed, the one with the least power first."""
    checks = [
        (confirm(problem, fit, term, noise), term)
        for term in fit.terms
        if term.effect is not REMAINDER and term.theta.size
    ]
    bad = [(check, term) for check, term in checks if not check.holds]
    return sorted(bad, key=lambda pair: pair[0].power)


def _extra(normal: Array, right: Array, noise: float) -> float:
    """Power beyond chance that a refit in one part takes off."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / scale[:, None] / scale[None, :]
    inverse = np.linalg.pinv(scaled, rcond=1e-8, hermitian=True)
    b = right / scale
    return float(b @ inverse @ b - noise * right.size)


def _by_time(state: State, columns: Sequence[Array | None], noise: float) -> float:
    numbers = np.unique(np.concatenate([part.blocks for part in state.parts]))
    total = 0.0
    for group in np.array_split(numbers, TIME_PARTS):
        pieces = []
        for part, column in zip(state.parts, columns, strict=True):
            if column is not None and not part.view.is_reference:
                rows = np.isin(part.blocks, group)
                pieces.append((column[rows], part.white[rows]))
        total += _refitted(pieces, noise)
    return total


def _emitter_of(part: Part) -> NDArray[np.int64]:
    return np.asarray(np.arange(part.white.shape[1]) % part.view.flux.shape[2])


def _sensor_of(part: Part) -> NDArray[np.int64]:
    sensors, emitters = part.view.flux.shape[1:]
    return np.asarray((np.arange(part.white.shape[1]) // emitters) % sensors)


def _by_value(
    state: State,
    columns: Sequence[Array | None],
    noise: float,
    group_of: Callable[[Part], NDArray[np.int64]],
) -> float:
    """Power of refits emitter by emitter, or sensor by sensor."""
    used = [
        (part, column, group_of(part))
        for part, column in zip(state.parts, columns, strict=True)
        if column is not None and not part.view.is_reference
    ]
    total = 0.0
    for value in range(max((int(g.max()) + 1 for _, _, g in used), default=0)):
        pieces = [(c[:, g == value], part.white[:, g == value]) for part, c, g in used]
        total += _refitted(pieces, noise)
    return total


def _refitted(pieces: Sequence[tuple[Array, Array]], noise: float) -> float:
    """Power beyond chance that a refit on some rows takes off."""
    if not pieces:
        return 0.0
    size = pieces[0][0].shape[2]
    normal, right = np.zeros((size, size)), np.zeros(size)
    for column, white in pieces:
        flat = column.reshape(-1, size)
        normal += flat.T @ flat
        right += flat.T @ white.ravel()
    if not np.any(normal):
        return 0.0
    return max(_extra(normal, right, noise), 0.0)
