"""Determines what metal does at rest from how it moves, for a field calibrated with it nearby.

While it moves, tools and references sense the difference between the metal at its present place
and at its place of rest. Body and path are fitted to that difference as to any moving metal. A
path starts straight away from where the metal is strongest, with the progress taken from the
change of the references, and the best of several is refined.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

import numpy as np

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.diagnosis.choice import course_of
from anser_ros.diagnosis.decisions import SOMETHING_LEFT
from anser_ros.diagnosis.engine import Scorer
from anser_ros.diagnosis.fit import Fit, Fitter, Known, Shaping, best_modes, unit_of
from anser_ros.diagnosis.problem import Problem, State, evaluate, test_blocks, train_blocks
from anser_ros.diagnosis.screening import without_outliers
from anser_ros.effects.base import View
from anser_ros.effects.effect import Richness
from anser_ros.effects.moving_metal import DepartedMetal, DepartedTerm, FreePath
from anser_ros.metal.body import COMPACT, SPACINGS, body_sizes

FIRST_KNOTS = 9
"""Knots of a path at first, three seconds apart in half a minute."""
FINE_KNOTS = 17
"""Knots at last: with nine the metal at rest was half again too strong, with 17 and 25 right."""
PATH_LENGTHS_M = (0.12, 0.24)
"""Lengths of the ways that are tried, m: a hand's way, and the width of the volume."""
SLOPE = 0.57
"""Share of a way to the side that goes down, the sine of 35 deg: metal hardly ever goes level."""
SIDE_DIRECTIONS = 8
"""Directions to the side in which a way is tried, one in 45 deg; time grows with their number."""
FEW_FRAMES, SOME_FRAMES, MANY_FRAMES = 25, 60, 300
"""Frames of a tool, about, on which ways are compared, refined, and fitted at last."""
BODY = Richness(90, (25,), SOMETHING_LEFT)
"""How finely the body is shaped, and the path divided beyond `FINE_KNOTS` where much is left."""
DEPARTURE_STEPS = 6
"""Steps of a fit at most; a path that creeps for longer is judged by what it predicts."""
EXPLAINED = 0.1
"""Share of the power in unseen blocks, beyond the noise's, that may stay. Its root, a third, is
what is then wrong of the metal's field, as much as `KNOWN` allows."""
NEAR_NOISE = 2.0
"""Mean whitened square of the median frame (one for noise alone) below which the metal is known
whatever it was before."""
KNOWN = 0.3
"""Standard deviation of what the metal does at rest, relative to that, from which on it is not
taken off: a third stays at most, and a field gets worse less than once in a thousand times."""


@dataclass(frozen=True)
class Departure:
    """Holds metal that moved during a scan, and where it rested."""

    fit: Fit  # its body and path
    before: float  # mean whitened square of the median frame in unseen blocks, without and with it
    after: float

    @property
    def term(self) -> DepartedTerm:
        """Return the metal with its body and path, as it was fitted."""
        return cast(DepartedTerm, self.fit.terms[0])

    @property
    def is_predictive(self) -> bool:
        """Return whether body and path predict the held-out blocks."""
        return self.after < max(NEAR_NOISE, EXPLAINED * self.before)

    def rest_flux(self, view: View) -> tuple[ComplexArray, Array]:
        """Return what resting metal adds to a view (F, S, K), and its standard deviation, T."""
        columns = self.term.rest_columns(view)
        variance = np.einsum(
            'fskp,pq,fskq->fsk', columns, self.fit.covariance, columns.conj(), optimize=True
        )
        sigma = np.sqrt(np.maximum(variance.real, 0.0) / 2.0)
        return self.term.rest_flux(view), sigma


def departure(problem: Problem, rest_s: float) -> Departure | None:
    """Find metal that moves in a problem whose model and baseline have it at rest.

    ``problem``: of the time in which something moves; ``rest_s``: when the metal rests, s. Returns
    None without references, or where no body explains anything.
    """
    if problem.references is None:
        return None
    blocks = train_blocks()
    effect = DepartedMetal(rest_s=rest_s)
    few, some = (problem.in_blocks(blocks).thinned(count) for count in (FEW_FRAMES, SOME_FRAMES))
    starts = _best_starts(few, effect, blocks)
    fits = [_refined(some, start, kind, blocks) for start, kind in starts]
    known = [fit for fit in fits if fit is not None]
    if not known:
        return None
    fitter = Fitter(some, blocks, DEPARTURE_STEPS)
    best = Shaping(fitter, BODY).with_freer_course(min(known, key=Fit.held_out), 0)
    cleaned = without_outliers(problem, best.terms)
    last = Fitter(cleaned.in_blocks(blocks).thinned(MANY_FRAMES), blocks, DEPARTURE_STEPS)
    fit = last.fit(best.terms)
    unseen = cleaned.in_blocks(test_blocks())
    return Departure(fit, _power(evaluate(unseen, ())), _power(evaluate(unseen, fit.terms)))


def _power(state: State) -> float:
    """Mean whitened square of the median frame of the tools and references."""
    each = np.concatenate([part.rms(1)[part.whitener.weight.any(axis=1)] for part in state.parts])
    return float(np.median(each**2))


def _best_starts(
    problem: Problem, effect: DepartedMetal, blocks: Integers
) -> list[tuple[DepartedTerm, str]]:
    """The start that predicts left-out blocks best with a compact body, and with pieces."""
    state = evaluate(problem, ())
    none: Known = [np.zeros((*part.white.shape, 0)) for part in state.parts], np.zeros(0)
    starts = [
        (start, kind) for start, kinds in _starts(problem, state, effect, blocks) for kind in kinds
    ]
    compact = [pair for pair in starts if pair[1] == COMPACT]
    best = []
    for group in (compact, [pair for pair in starts if pair[1] != COMPACT]):
        tried = ((pair, unit_of(*pair), body_sizes(pair[1])) for pair in group)
        found = best_modes(state, none, tried, blocks, BODY.modes)
        if found is not None:
            best.append(found[0])
    return best


def _starts(
    problem: Problem, state: State, effect: DepartedMetal, blocks: Integers
) -> Iterator[tuple[DepartedTerm, list[str]]]:
    """Paths to try: along the best places block by block, and ways away from the strongest one."""
    duration, still = problem.apparatus.duration, effect.still
    assert still is not None and problem.references is not None
    knots = np.linspace(0.0, duration, FIRST_KNOTS)
    scorer = Scorer(state, blocks)
    scored = [
        (term, score)
        for term in still.candidates(problem.apparatus)
        if (score := scorer.score(term)) is not None
    ]
    found = course_of(scored)
    if found is None:
        return
    course, solution = found
    time = (blocks + 0.5) * duration / (blocks.max() + 1)
    path, theta = FreePath.through(knots, time, course)
    yield effect.starting(path, theta, duration, solution), [COMPACT]
    readings = problem.references.readings
    change = np.abs(readings.flux - problem.references.baseline)
    size = np.sqrt(np.where(readings.valid[..., None], change**2, 0.0).mean(axis=(1, 2)))
    near = np.sqrt(size / max(float(size.max()), 1e-300))
    closest = course[int(np.argmax(np.interp(time, readings.time, near)))]
    for way in _ways():
        centres = closest + (1.0 - near)[:, None] * way
        path, theta = FreePath.through(knots, readings.time, centres)
        yield effect.starting(path, theta, duration, solution), [COMPACT, *SPACINGS]


def _ways() -> list[Array]:
    """Ways from where metal is strongest to where it rests, m."""
    level = np.sqrt(1.0 - SLOPE**2)
    turns = 2.0 * np.pi * np.arange(SIDE_DIRECTIONS) / SIDE_DIRECTIONS
    aside = [np.array([level * np.cos(a), level * np.sin(a), -SLOPE]) for a in turns]
    return [
        length * way for way in (np.array([0.0, 0.0, -1.0]), *aside) for length in PATH_LENGTHS_M
    ]


def _refined(problem: Problem, start: DepartedTerm, kind: str, blocks: Integers) -> Fit | None:
    """Body and path together, first coarsely; the body is reshaped for the finer path."""
    fitter = Fitter(problem, blocks, DEPARTURE_STEPS)
    shaping = Shaping(fitter, BODY)
    fit = shaping.shaped_as(fitter.fit([start.hold()], 0), 0, start, [kind])
    if fit is None:
        return None
    coarse = cast(DepartedTerm, fit.terms[0].free())
    fine = coarse.freer(FINE_KNOTS) or coarse
    fit = fitter.fit([fine])
    return shaping.shaped_as(fit, 0, fine.with_theta(fit.terms[0].theta), [kind])
