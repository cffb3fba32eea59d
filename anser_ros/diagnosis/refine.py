"""Refines a metal effect: the couplings about it that the data can tell, of a size that they ask.

A simple body has few parameters; a real one has more, which a prior holds small: how small is
chosen by what predicts held-out blocks best. Place and couplings are fitted together, so a place
is as uncertain as the body's shape leaves it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.fit import Fit, fit_terms, misfit
from anser_ros.diagnosis.problem import Problem, evaluate
from anser_ros.diagnosis.rich_modes import Known, rich_modes, thinned
from anser_ros.diagnosis.scoring import joined
from anser_ros.diagnosis.structure import noise_scale
from anser_ros.effects.effect import Term, View
from anser_ros.effects.metal_path import FreePath
from anser_ros.effects.metal_remainder import REMAINDER, Couplings, Leftover, Lighting
from anser_ros.effects.moving_metal import LARGEST, MovingMetal, path_of
from anser_ros.metal.body import (
    BODIES,
    COMPACT,
    ODD,
    SPACINGS,
    ball_modes,
    body_spread,
)
from anser_ros.metal.scattering import Shapes
from anser_ros.metal.sheet import sheet_shapes, sheet_spread

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Richness:
    """How finely metal is shaped: most modes, knots that a free path may have, and the misfit over
    the noise from which they are tried."""

    modes: int
    knots: tuple[int, ...]
    left: float


COARSE, FINE = Richness(50, (17,), 1.3), Richness(90, (17, 25), 1.02)
AT_REST = ('static_metal', 'conductive_plate')
METALS = (*AT_REST, 'moving_metal')

RADII = (0.008, 0.012, 0.018, 0.027, 0.04, 0.06, 0.09)
"""Radii of bodies that are tried, m."""
PIECES = (0.01, 0.05, 0.2, 1.0)
"""Sizes of an extended body's pieces that are tried, 1e-4 m^3."""
SHEET_SHARES = (0.003, 0.01, 0.03, 0.1, 0.3)
"""Sizes that are tried of what a sheet's couplings lack, as shares of a perfect conductor's."""
ROUNDS = 2
TRIALS = 3
"""Iterations after which kinds of bodies are compared."""
AWAY = 2e-3
"""A centre that the fit moves farther than this (m) asks for new modes."""
LEFT = 1.02
"""Misfit of the tools over the noise from which a body at rest may be an extended one."""
PER_PARAMETER = 6.0


def belongs_to(remainder: Term, term: Term) -> bool:
    """Whether a term is the remainder of another."""
    return remainder.effect is REMAINDER and remainder.site['_parent'] == term.seat


def settled(
    problem: Problem,
    terms: Sequence[Term],
    blocks: NDArray[np.int64],
    folds: int,
    iterations: int,
    body: Richness = COARSE,
) -> Fit:
    """The joint fit of all effects, metal as richly shaped as the data can tell."""
    plain = [term.free() for term in terms if term.effect is not REMAINDER]
    # What moves and has its shape already is shaped anew below.
    known = any('_body' in term.site for term in plain)
    fit = fit_terms(problem, plain, blocks, 1 if known else iterations)
    for index, term in enumerate(fit.terms):
        if term.effect.name == 'moving_metal':
            fit = _shaped(fit, index, problem, blocks, folds, iterations, body)
    for index, term in enumerate(fit.terms):
        if term.effect.name in AT_REST:
            fit = _with_remainder(fit, index, problem, blocks, folds, iterations, body)
    return _held(fit, problem, blocks)


def _held(fit: Fit, problem: Problem, blocks: NDArray[np.int64]) -> Fit:
    """The same fit, metal held where it is: what is tried beside it is then cheap to fit."""
    held = [
        term.frozen(fit.covariance_of(index)) if term.effect.name in METALS else term
        for index, term in enumerate(fit.terms)
    ]
    if not any(term.effect.name in METALS for term in held):
        return fit
    return fit_terms(problem, held, blocks, 1)


def _with_remainder(
    fit: Fit,
    index: int,
    problem: Problem,
    blocks: NDArray[np.int64],
    folds: int,
    iterations: int,
    body: Richness,
) -> Fit:
    """The fit with what one metal at rest leaves, about where it then is."""
    plain = fit.terms
    for _ in range(ROUNDS):
        term = fit.terms[index]
        centre = _centre(term)
        own = _couplings(fit, term, plain, _shapes_of(term), blocks, folds, body)
        if own is None:
            return fit
        start = [t if i != index else term for i, t in enumerate(plain)]
        light = REMAINDER.of(term, Lighting([term, *own], problem.apparatus.emitters))
        fit = fit_terms(problem, [*start, *own, light], blocks, iterations)
        if np.linalg.norm(_centre(fit.terms[index]) - centre) < AWAY:
            break
    if term.effect.name == 'static_metal' and _left(fit) > LEFT:
        more = _couplings(fit, fit.terms[index], fit.terms, _lattices(), blocks, folds, body)
        if more is not None:
            held = fit.terms[index].frozen(fit.covariance_of(index))
            fit = fit_terms(problem, [*_with(fit.terms, index, held), *more], blocks, iterations)
    return fit


def _left(fit: Fit) -> float:
    """Misfit of the tools over their noise."""
    tools = [part for part in fit.state.parts if not part.view.is_reference]
    squares = sum(float(np.sum(part.white**2)) for part in tools)
    count = sum(part.count for part in tools)
    return squares / max(count, 1) / noise_scale(fit.state) ** 2


def _couplings(
    fit: Fit,
    term: Term,
    beside: Sequence[Term],
    shapes: Sequence[tuple[Shapes, list[Array]]],
    blocks: NDArray[np.int64],
    folds: int,
    body: Richness,
) -> list[Term] | None:
    """The couplings about metal at rest that predict best beside other terms, in a list."""
    few = thinned(fit.state, blocks)
    centre = _centre(term)
    known = (
        joined([few.design(t) for t in beside]),
        np.concatenate([t.effect.prior(t) for t in beside]),
    )
    best: tuple[float, Leftover] | None = None
    for kind, spreads in shapes:

        def unit(view: View, modes: Array, kind: Shapes = kind) -> NDArray[np.inexact]:
            return Couplings(kind, centre, modes).unit(view)

        found = rich_modes(few, known, unit, spreads, blocks, folds, body.modes)
        if found is not None and (best is None or found[0] < best[0]):
            best = (found[0], Couplings(kind, centre, found[1]))
    return None if best is None else [REMAINDER.of(term, best[1])]


def _centre(term: Term) -> Array:
    """Of metal at rest, m."""
    if term.effect.name == 'conductive_plate':
        return term.theta[[2, 3, 0]]
    return term.theta[:3]


def _shapes_of(term: Term) -> list[tuple[Shapes, list[Array]]]:
    """Shapes about metal at rest that tell its place, and the sizes of their couplings."""
    if term.effect.name == 'conductive_plate':
        edge = float(term.theta[1])
        return [(sheet_shapes(edge), [sheet_spread(edge, share) for share in SHEET_SHARES])]
    return [(BODIES[COMPACT](), _spreads(COMPACT))]


def _lattices() -> list[tuple[Shapes, list[Array]]]:
    return [(BODIES[kind](), _spreads(kind)) for kind in SPACINGS]


def _spreads(kind: str) -> list[Array]:
    if kind == COMPACT:
        return [body_spread(radius, ODD) for radius in RADII]
    return [np.full(BODIES[kind]().size, size) for size in PIECES]


def _shaped(
    fit: Fit,
    index: int,
    problem: Problem,
    blocks: NDArray[np.int64],
    folds: int,
    iterations: int,
    body: Richness,
) -> Fit:
    """The fit with a richer body for metal that moves, and a freer path where that pays."""
    effect = fit.terms[index].effect
    if not isinstance(effect, MovingMetal) or fit.terms[index].site.get('_body') == body:
        return fit
    fit = _bodied(fit, index, problem, blocks, folds, iterations, body)
    for count in body.knots:
        term = fit.terms[index]
        path = path_of(term)
        if misfit(fit) < body.left * noise_scale(fit.state) ** 2:
            break
        if isinstance(path, FreePath) and len(path.knots) >= count:
            continue
        time = np.linspace(0.0, problem.apparatus.duration, 6 * count)
        freer, course = FreePath.through(
            np.linspace(0.0, problem.apparatus.duration, count), time, effect.centres(term, time)
        )
        trial = _with(fit.terms, index, effect.with_path(term, freer, course))
        other = fit_terms(problem, trial, blocks, iterations)
        more = PER_PARAMETER * (freer.count - path.count) * max(misfit(other), 1.0)
        if fit.held_out(folds) - other.held_out(folds) < more:
            break
        fit = other
    return fit


def _bodied(
    fit: Fit,
    index: int,
    problem: Problem,
    blocks: NDArray[np.int64],
    folds: int,
    iterations: int,
    body: Richness,
) -> Fit:
    """The fit with a richer body for metal that moves.

    A simple body in place of an extended one may have gone astray: where it started counts too.
    """
    first = fit.terms[index]
    if '_body' in first.site:
        kind = [first.site['_kind']]
        again = _shaped_as(fit, index, problem, blocks, folds, iterations, body, kind)
        return again or fit
    half = problem.in_blocks(blocks, 2)
    starts, families = [fit_terms(half, fit.terms, blocks, 0)], [[COMPACT], [*SPACINGS]]
    if '_course' in first.site:
        course = first.site['_course']
        moved = first.with_theta(np.concatenate([course, first.theta[course.size :]]))
        held = _with(fit.terms, index, moved.frozen(np.zeros((0, 0))))
        linear = fit_terms(half, held, blocks, 1)
        starts.append(fit_terms(half, [t.free() for t in linear.terms], blocks, 0))
    shaped = [
        other
        for start in starts
        for kinds in families
        if (other := _shaped_as(start, index, half, blocks, folds, TRIALS, body, kinds))
    ]
    if not shaped:
        return fit
    best = min(shaped, key=lambda f: f.held_out(folds))
    kind = [best.terms[index].site['_kind']]
    best = fit_terms(problem, best.terms, blocks, 0)
    again = _shaped_as(best, index, problem, blocks, folds, iterations, body, kind)
    return again or best


def _shaped_as(
    fit: Fit,
    index: int,
    problem: Problem,
    blocks: NDArray[np.int64],
    folds: int,
    iterations: int,
    body: Richness,
    kinds: Sequence[str],
) -> Fit | None:
    """The fit with the best of some kinds of bodies; None where none is better than nothing."""
    term = fit.terms[index]
    effect = term.effect
    assert isinstance(effect, MovingMetal)
    bare = _with(fit.terms, index, term.with_theta(_without_amounts(term)))
    few = thinned(evaluate(problem, bare), blocks)
    known = _known(fit, index, blocks)
    best: tuple[float, str, Array] | None = None
    for kind in kinds:

        def unit(view: View, modes: Array, kind: str = kind) -> NDArray[np.inexact]:
            return effect.unit(effect.with_body(term, kind, modes, np.ones(modes.shape[1])), view)

        found = rich_modes(few, known, unit, _spreads(kind), blocks, folds, body.modes)
        if found is not None and (best is None or found[0] < best[0]):
            best = (found[0], kind, found[1])
    if best is None:
        return None
    _, kind, modes = best
    spread = np.ones(modes.shape[1])
    if kind == COMPACT:
        modes = np.concatenate([ball_modes(), modes], axis=1)
        spread = np.concatenate([np.full(ball_modes().shape[1], LARGEST), spread])
    rich = effect.with_body(term, kind, modes, spread)
    rich = replace(rich, site={**rich.site, '_body': body})
    start = fit_terms(problem, _with(fit.terms, index, rich.frozen(np.zeros((0, 0)))), blocks, 1)
    free = _with(start.terms, index, start.terms[index].free())
    return fit_terms(problem, free, blocks, iterations)


def _without_amounts(term: Term) -> Array:
    theta = term.theta.copy()
    theta[term.effect.amounts(term)] = 0.0
    return theta


def _known(fit: Fit, index: int, blocks: NDArray[np.int64]) -> Known:
    """Columns of all terms, of the metal that moves only those of its path."""
    few = thinned(fit.state, blocks)
    groups, priors = [], []
    for i, term in enumerate(fit.terms):
        columns, prior = few.design(term), term.effect.prior(term)
        if i == index:
            count = path_of(term).count
            columns = [None if c is None else c[..., :count] for c in columns]
            prior = prior[:count]
        groups.append(columns)
        priors.append(prior)
    return joined(groups), np.concatenate(priors)


def _with(terms: Sequence[Term], index: int, term: Term) -> tuple[Term, ...]:
    return tuple(term if i == index else t for i, t in enumerate(terms))


__all__ = ['COARSE', 'FINE', 'METALS', 'Richness', 'belongs_to', 'settled']
