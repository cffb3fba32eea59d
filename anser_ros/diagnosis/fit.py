"""Fits all effects on fluxes jointly, metal in as much detail as the data determine."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import Array, Integers
from anser_ros.diagnosis.decisions import (
    COARSE_REMAINDER,
    PER_PARAMETER,
    SOMETHING_LEFT,
    TIME_FOLDS,
)
from anser_ros.diagnosis.engine import BlockSums, JointFit, block_sums, descended, joined
from anser_ros.diagnosis.problem import Problem, State, evaluate, tools_misfit
from anser_ros.diagnosis.screening import noise_scale
from anser_ros.effects.base import View
from anser_ros.effects.effect import BodyTerm, Family, Resting, Richness, SizedShapes, Term
from anser_ros.effects.metal_at_rest import REMAINDER, Couplings, IlluminationChange
from anser_ros.metal.body import COMPACT, SPACINGS, body_sizes
from anser_ros.metal.scattering import Shapes, both_phases
from anser_ros.parallel import in_order

Known = tuple[list[Array | None], Array]
"""Columns, one array for each part of a state, and their prior sizes."""
Unit = Callable[[View, Array], NDArray[np.inexact]]
"""Flux (F, S, K, m) of modes (c, m) of couplings in a view."""

KeyT = TypeVar('KeyT')

MOST_SIZED_MODES = 130
"""Modes, at most, of which the data are asked how large they are."""
LEAST_INFORMATION = 0.3
"""Information in the data, over that in the prior, below which a mode is left out."""
SCORED_FRAMES = 130
"""Frames of each part, about, on which sizes of couplings are compared."""


def rich_modes(
    few: State, known: Known, unit: Unit, spreads: Sequence[Array], blocks: Integers, most: int
) -> tuple[float, Array] | None:
    """Return combinations of couplings, of the size that predicts held-out blocks best.

    ``few``: at a fit without these couplings, or with others in their place; some frames do;
    ``known``: columns of what is fitted with them, and their prior sizes; ``unit``: flux (F, S, K,
    m) of modes (c, m) in a view; ``spreads`` (c,): prior sizes of the couplings that are tried.

    Returns (c, m) sum of squares of the held-out residuals, and modes of unit prior size; None
    where no size is better than none at all.
    """
    widest = np.max(spreads, axis=0)
    information = _information(few, unit, widest.size)
    values, vectors = np.linalg.eigh(information * widest[:, None] * widest)
    leading = np.argsort(values)[::-1][:MOST_SIZED_MODES]
    leading = leading[values[leading] > LEAST_INFORMATION]
    if leading.size == 0:
        return None
    vectors = vectors[:, leading]
    vectors_of = widest[:, None] * vectors
    group: list[Array | None] = [
        part.whitener.columns([both_phases(unit(part.view, vectors_of))], [2 * vectors.shape[1]])
        for part in few.parts
    ]
    columns, prior = known
    sums = block_sums(few.parts, joined([columns, group]), blocks)
    width, count = prior.size, leading.size
    least, root = sums.columns(np.arange(width)).held_out(prior, TIME_FOLDS), None
    full_prior = np.concatenate([prior, np.ones(2 * count)])
    for spread in spreads:
        turned = vectors * (spread / widest)[:, None]
        trial = np.linalg.cholesky(turned.T @ turned + 1e-12 * np.eye(count))
        left = _turned(sums, width, trial).held_out(full_prior, TIME_FOLDS)
        if left < least:
            least, root = left, trial
    if root is None:
        return None
    total = sums.normal.sum(axis=0)[width : width + count, width : width + count]
    information, turn = np.linalg.eigh(root.T @ total @ root)
    order = np.argsort(information)[::-1][:most]
    order = order[information[order] > LEAST_INFORMATION]
    if not order.size:
        return None
    return least, vectors_of @ root @ turn[:, order]


def best_modes(
    few: State,
    known: Known,
    tried: Iterable[tuple[KeyT, Unit, Sequence[Array]]],
    blocks: Integers,
    most: int,
) -> tuple[KeyT, Array] | None:
    """Return the key of the shapes that predict held-out blocks best, and their modes.

    ``tried``: key, flux and prior sizes of some shapes; all others as of `rich_modes`. Returns
    None where none is better than none at all.
    """
    best: tuple[float, KeyT, Array] | None = None
    for key, unit, sizes in tried:
        found = rich_modes(few, known, unit, sizes, blocks, most)
        if found is not None and (best is None or found[0] < best[0]):
            best = found[0], key, found[1]
    return None if best is None else best[1:]


def unit_of(body: BodyTerm, kind: str) -> Unit:
    """Return the flux of modes of a kind of body on the course of another."""
    return lambda view, modes: body.with_body(kind, modes, np.ones(modes.shape[1])).unit(view)


def _turned(sums: BlockSums, known: int, root: Array) -> BlockSums:
    """The sums with the columns after the known ones, two groups of them, turned by a matrix."""
    count = root.shape[0]
    turn = np.eye(known + 2 * count)
    for start in (known, known + count):
        turn[start : start + count, start : start + count] = root
    return BlockSums(turn.T @ sums.normal @ turn, sums.right @ turn, sums.squares)


def thinned(state: State, blocks: Integers) -> State:
    """Return the state with only some frames of every part."""
    few = []
    for part in state.parts:
        rows = np.flatnonzero(np.isin(part.blocks, blocks))
        few.append(part.frames(rows[:: max(1, round(rows.size / SCORED_FRAMES))]))
    return replace(state, parts=tuple(few))


def _information(state: State, unit: Unit, count: int) -> Array:
    """Of single couplings, (c, c), in phase (quadrature has the same), from half of the frames."""
    normal = np.zeros((count, count))
    for part in state.parts:
        half = part.frames(np.arange(0, part.view.time.size, 2))
        flux = unit(half.view, np.eye(count))
        flat = half.whitener.columns([flux.astype(complex)], [count]).reshape(-1, count)
        normal += 2 * (flat.T @ flat)
    return normal


@dataclass(frozen=True)
class Fit(JointFit[State]):
    """Holds the terms of fluxes at their joint optimum."""

    @property
    def terms(self) -> tuple[Term, ...]:
        """Return all terms with their fitted parameters."""
        return self.state.terms

    @property
    def effects(self) -> tuple[Term, ...]:
        """Return the terms that explain something of their own, without others' parts."""
        return tuple(t for t in self.terms if t.effect.family is not Family.REMAINDER)

    @property
    def newest(self) -> Term:
        """Return the term of the effect that was added last."""
        return self.effects[-1]

    def covariance_of(self, index: int) -> Array:
        """Return the covariance of one term; where it is held, what it had when it was free."""
        held = self.terms[index].held
        if held is not None and held.covariance is not None:
            return held.covariance
        return super().covariance_of(index)


@dataclass(frozen=True)
class Fitter:
    """States what effects are fitted on, and how."""

    problem: Problem
    blocks: Integers  # of time, those that take part
    iterations: int  # most steps of a fit

    def fit(self, terms: Sequence[Term], iterations: int | None = None) -> Fit:
        """Fit all parameters of some terms together, from their values."""
        steps = self.iterations if iterations is None else iterations
        return Fit(*descended(evaluate(self.problem, terms), self.blocks, steps))


TRIALS = 3
"""Iterations after which kinds of bodies are compared; the best one is fitted on."""
EVERY_OTHER = 2
"""Every so many frames are used to compare kinds of bodies: it takes half the time."""
MODE_ROUNDS = 2
"""Times that modes are made about where the metal then is; the second hardly ever moves it."""
NEW_MODES_M = 2e-3
"""A centre that a fit moves farther than this (m) asks for new modes."""


@dataclass(frozen=True)
class Shaping:
    """Shapes metal in a fit: body and course where it moves, what it leaves where it rests."""

    fitter: Fitter
    richness: Richness  # how many modes and knots it may have

    def shaped(self, fit: Fit, index: int) -> Fit:
        """Return the fit with one moving metal shaped; the same fit for any other effect."""
        body = _body(fit.terms[index])
        if body is None or body.richness == self.richness:
            return fit
        return self.with_freer_course(self._bodied(fit, index, body), index)

    def with_freer_course(self, fit: Fit, index: int) -> Fit:
        """Return the fit with a freer path, as long as its parameters are worth it."""
        for knots in self.richness.knots:
            body = _body(fit.terms[index])
            if body is None or fit.misfit < self.richness.left * noise_scale(fit.state) ** 2:
                break
            freer = body.freer(knots)
            if freer is None:
                continue
            other = self.fitter.fit(_with(fit.terms, index, freer))
            price = PER_PARAMETER * (freer.placed - body.placed) * max(other.misfit, 1.0)
            if fit.held_out() - other.held_out() < price:
                break
            fit = other
        return fit

    def _bodied(self, fit: Fit, index: int, first: BodyTerm) -> Fit:
        """The fit with a richer body, also from its start: a simple one may have gone astray."""
        if first.richness is not None:
            return self.shaped_as(fit, index, first, [first.kind]) or fit
        half = self.fitter.problem.in_blocks(self.fitter.blocks, EVERY_OTHER)
        trial = replace(self, fitter=replace(self.fitter, problem=half, iterations=TRIALS))
        starts, families = [trial.fitter.fit(fit.terms, 0)], [[COMPACT], [*SPACINGS]]
        restarted = first.restarted()
        if restarted is not None:
            linear = trial.fitter.fit(_with(fit.terms, index, restarted.hold()), 1)
            starts.append(trial.fitter.fit([t.free() for t in linear.terms], 0))

        def shape(pair: tuple[Fit, list[str]]) -> Fit | None:
            start, kinds = pair
            body = _body(start.terms[index])
            return None if body is None else trial.shaped_as(start, index, body, kinds)

        found = in_order(shape, product(starts, families))
        shaped = [fit for fit in found if fit is not None]
        if not shaped:
            return fit
        best = min(shaped, key=Fit.held_out)
        body = _body(best.terms[index])
        assert body is not None
        best = self.fitter.fit(best.terms, 0)
        return self.shaped_as(best, index, body, [body.kind]) or best

    def shaped_as(self, fit: Fit, index: int, body: BodyTerm, kinds: Sequence[str]) -> Fit | None:
        """Return the fit with the best of some kinds of bodies; None if no body is better."""
        fitter = self.fitter
        course = body.theta.copy()
        course[body.effect.amounts(body)] = 0.0
        bare = evaluate(fitter.problem, _with(fit.terms, index, body.with_theta(course)))
        few = thinned(bare, fitter.blocks)
        known = self._known(fit, index, body)
        tried = ((kind, unit_of(body, kind), body_sizes(kind)) for kind in kinds)
        best = best_modes(few, known, tried, fitter.blocks, self.richness.modes)
        if best is None:
            return None
        rich = body.shaped(*best, self.richness)
        start = fitter.fit(_with(fit.terms, index, rich.hold()), 1)
        return fitter.fit(_with(start.terms, index, start.terms[index].free()))

    def _known(self, fit: Fit, index: int, body: BodyTerm) -> Known:
        """Columns of all terms, of the metal that moves only those of its course."""
        few = thinned(fit.state, self.fitter.blocks)
        groups, priors = [], []
        for i, term in enumerate(fit.terms):
            columns, prior = few.design(term), term.effect.prior(term)
            if i == index:
                columns = [None if c is None else c[..., : body.placed] for c in columns]
                prior = prior[: body.placed]
            groups.append(columns)
            priors.append(prior)
        return joined(groups), np.concatenate(priors)

    def with_remainder(self, fit: Fit, index: int) -> Fit:
        """Return the fit with what one metal at rest leaves; the same fit for any other effect."""
        plain = fit.terms
        if plain[index].effect.resting(plain[index]) is None:
            return fit
        for _ in range(MODE_ROUNDS):
            term = fit.terms[index]
            before = _resting(term)
            own = self._couplings(fit, term, plain, before.near)
            if own is None:
                return fit
            start = _with(plain, index, term)
            emitters = self.fitter.problem.apparatus.emitters
            light = REMAINDER.of(term, IlluminationChange([term, own], emitters))
            fit = self.fitter.fit([*start, own, light])
            if np.linalg.norm(_resting(fit.terms[index]).centre - before.centre) < NEW_MODES_M:
                break
        return self._extended(fit, index)

    def _extended(self, fit: Fit, index: int) -> Fit:
        """The fit with a body as large as its distance, where much is left."""
        term = fit.terms[index]
        extended = _resting(term).extended
        if not extended or tools_misfit(fit.state) <= SOMETHING_LEFT * noise_scale(fit.state) ** 2:
            return fit
        more = self._couplings(fit, term, fit.terms, extended)
        if more is None:
            return fit
        held = term.hold(fit.covariance_of(index))
        return self.fitter.fit([*_with(fit.terms, index, held), more])

    def _couplings(
        self, fit: Fit, term: Term, beside: Sequence[Term], shapes: Sequence[SizedShapes]
    ) -> Term | None:
        """The couplings about metal at rest that predict best, given the other terms."""
        fitter, few = self.fitter, thinned(fit.state, self.fitter.blocks)
        centre = _resting(term).centre
        known = few.designs(beside), few.prior(beside)

        def unit_of_shapes(kind: Shapes) -> Unit:
            return lambda view, modes: Couplings(kind, centre, modes).unit(view)

        tried = ((kind, unit_of_shapes(kind), sizes) for kind, sizes in shapes)
        best = best_modes(few, known, tried, fitter.blocks, self.richness.modes)
        if best is None:
            return None
        kind, modes = best
        return REMAINDER.of(term, Couplings(kind, centre, modes))


def _body(term: Term) -> BodyTerm | None:
    return term.effect.body(term)


def _with(terms: Sequence[Term], index: int, term: Term) -> tuple[Term, ...]:
    return tuple(term if i == index else t for i, t in enumerate(terms))


def _resting(term: Term) -> Resting:
    """Where a term of metal at rest is."""
    found = term.effect.resting(term)
    assert found is not None, f'{term.label} is not metal at rest'
    return found


COARSE = Richness(50, (17,), COARSE_REMAINDER)
"""How finely metal is shaped during the search: by half of the modes that data determine."""
FINE = Richness(90, (17, 25), SOMETHING_LEFT)
"""How finely metal is shaped in the last fit, which is made once."""


def settled(fitter: Fitter, terms: Sequence[Term], richness: Richness = COARSE) -> Fit:
    """Return the joint fit of some effects, metal shaped and then held where it is.

    ``terms``: start values; remainders of metal among them are made again.
    """
    plain = [term.free() for term in terms if term.effect.family is not Family.REMAINDER]
    bodies = [term.effect.body(term) for term in plain]
    # What moves and has its shape already is reshaped below.
    known = any(body is not None and body.richness is not None for body in bodies)
    fit = fitter.fit(plain, 1 if known else None)
    shaping = Shaping(fitter, richness)
    for index in range(len(fit.terms)):
        fit = shaping.shaped(fit, index)
    for index in range(len(fit.terms)):
        fit = shaping.with_remainder(fit, index)
    return _held(fit, fitter)


def _held(fit: Fit, fitter: Fitter) -> Fit:
    """The same fit, metal held where it is: what is tried with it is then cheap to fit."""
    if not any(term.effect.family.is_metal for term in fit.terms):
        return fit
    terms = fit.terms
    for index, term in enumerate(fit.terms):
        if term.effect.family.is_metal:
            terms = _with(terms, index, term.hold(fit.covariance_of(index)))
    return fitter.fit(terms, 1)
