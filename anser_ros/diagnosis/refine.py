"""Refines a metal effect: the modes of a cloud of scatterers about it that the data can tell."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.fit import Fit, fit_terms
from anser_ros.diagnosis.problem import Problem, State
from anser_ros.diagnosis.scoring import block_sums, joined
from anser_ros.diagnosis.whitening import parts
from anser_ros.effects.effect import Term, View
from anser_ros.effects.metal_remainder import REMAINDER
from anser_ros.effects.moving_metal import MovingMetal
from anser_ros.effects.static_metal import BALL

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class MovingBody:
    """How richly metal that moves is shaped: points a side and upwards, their spacing (m), modes,
    prior size of their amplitudes (1e-4 m^3), and how often the modes are chosen anew."""

    side: int
    height: int
    spacing: float
    modes: int
    size: float
    rounds: int


COARSE, FINE = MovingBody(5, 3, 0.04, 60, 0.2, 2), MovingBody(7, 3, 0.03, 110, 0.1, 2)
AT_REST = ('static_metal', 'conductive_plate')
METALS = (*AT_REST, 'moving_metal')
REFINEMENTS = 3
"""Iterations with a remainder, which is linear."""

SPACING = 0.03
CLEARANCE = 0.025
"""Scatterers keep this distance (m) from every sensor."""
MOST_MODES = 110
SIZES = (0.01, 0.1, 1.0, 10.0)
"""Prior sizes that are tried, 1e-4 m^3 a scatterer."""


def belongs_to(remainder: Term, term: Term) -> bool:
    """Whether a term is the remainder of another."""
    return remainder.effect is REMAINDER and remainder.site['_parent'] is term.site


def settled(
    problem: Problem,
    terms: Sequence[Term],
    blocks: NDArray[np.int64],
    folds: int,
    iterations: int,
    body: MovingBody = COARSE,
) -> Fit:
    """The joint fit of all effects, metal with a remainder each.

    Places and sizes are fitted without remainders, which could take their part; with them, they
    are held. Metal that moves shows its shape by moving, so its path stays free.
    """
    plain = [term.free() for term in terms if term.effect is not REMAINDER]
    fit = fit_terms(problem, plain, blocks, iterations)
    for index, term in enumerate(fit.terms):
        if term.effect.name == 'moving_metal':
            fit = _shaped(fit, index, problem, blocks, iterations, body)
    if not any(term.effect.name in AT_REST for term in fit.terms):
        return fit
    held = [
        term.frozen(_place_covariance(fit, i)) if term.effect.name in AT_REST else term
        for i, term in enumerate(fit.terms)
    ]
    refined = fit_terms(problem, held, blocks, 1)
    for term in refined.terms:
        if term.effect.name in AT_REST:
            more = remainder_of(refined, term, problem, blocks, folds)
            if more is not None:
                refined = fit_terms(problem, [*refined.terms, more], blocks, REFINEMENTS)
    return refined


def _place_covariance(fit: Fit, index: int) -> Array:
    """Covariance of a metal's parameters, its unknown shape included.

    A body of another shape would be placed elsewhere: the way from where a ball fits best to where
    a point fits best is taken for one standard deviation.
    """
    covariance, term = fit.covariance_of(index).copy(), fit.terms[index]
    if term.effect.name != 'static_metal':
        return covariance
    theta = term.theta
    short = theta[3:].reshape(2, -1)[:, [0, *range(2, BALL.groups)]].ravel()
    site = {**term.site, '_point': True}
    point = Term(term.effect, site, np.concatenate([theta[:3], short]))
    terms = [point if i == index else t for i, t in enumerate(fit.terms)]
    other = fit_terms(fit.state.problem, terms, np.unique(fit.state.problem.blocks[0]), 4)
    way = other.terms[index].theta[:3] - theta[:3]
    covariance[:3, :3] += np.diag(way**2 + np.sum(way**2) / 9)
    return covariance


def _shaped(
    fit: Fit,
    index: int,
    problem: Problem,
    blocks: NDArray[np.int64],
    iterations: int,
    body: MovingBody,
) -> Fit:
    """The fit with a richer body for metal that moves."""
    effect = fit.terms[index].effect
    if not isinstance(effect, MovingMetal) or fit.terms[index].site.get('_body') == body:
        return fit
    lateral = (np.arange(body.side) - (body.side - 1) / 2) * body.spacing
    upright = (np.arange(body.height) - (body.height - 1) / 2) * body.spacing
    offsets = np.array([(a, b, c) for a in lateral for b in lateral for c in upright])
    for _ in range(body.rounds):
        term = fit.terms[index]
        single = effect.with_body(term, offsets, np.eye(3 * len(offsets)), 1.0)
        modes, _ = _modes(fit.state, single, blocks, effect.unit)
        rich = effect.with_body(term, offsets, modes[:, : body.modes], body.size)
        rich = replace(rich, site={**rich.site, '_body': body})
        held = rich.frozen(np.zeros((0, 0)))
        start = fit_terms(problem, _with(fit.terms, index, held), blocks, 1)
        fit = fit_terms(
            problem, _with(start.terms, index, start.terms[index].free()), blocks, iterations
        )
    return fit


def _with(terms: Sequence[Term], index: int, term: Term) -> tuple[Term, ...]:
    return tuple(term if i == index else t for i, t in enumerate(terms))


def _cloud(term: Term, problem: Problem) -> Array:
    """Points in fg about metal at rest."""
    if term.effect.name == 'conductive_plate':
        z, edge, x, y, _ = term.theta
        steps = (np.arange(8) - 3.5) * edge / 6
        points = np.array([(x + a, y + b, z) for a in steps for b in steps])
    else:
        lateral, upright = (np.arange(5) - 2) * SPACING, (np.arange(3) - 1) * SPACING
        points = np.array([(a, b, c) for a in lateral for b in lateral for c in upright])
        points = points + term.theta[:3]
    sensors = [tool.placed()[0].reshape(-1, 3)[::7] for tool in problem.tools]
    if problem.references is not None:
        sensors.append(problem.references.readings.sensors.position)
    places = np.concatenate(sensors)
    nearest = np.array([np.linalg.norm(places - p, axis=1).min() for p in points])
    return points[nearest > CLEARANCE]


def remainder_of(
    fit: Fit, term: Term, problem: Problem, blocks: NDArray[np.int64], folds: int
) -> Term | None:
    """The remainder of a metal term that lowers the held-out misfit most; None when none does."""
    points = _cloud(term, problem)
    if points.shape[0] < 8:
        return None
    state = fit.state
    raw = REMAINDER.about(term, points, np.eye(3 * points.shape[0]), 1.0)
    modes, strength = _modes(state, raw, blocks, REMAINDER.unit)
    widest = np.flatnonzero(strength * max(SIZES) ** 2 > 1.0)[:MOST_MODES]
    if widest.size == 0:
        return None
    all_modes = REMAINDER.about(term, points, modes[:, widest], 1.0)
    columns = joined([*(state.design(t) for t in fit.terms), state.design(all_modes)])
    sums = block_sums(state, columns, blocks)
    known, count = fit.prior.size, widest.size
    best: tuple[float, float, int] | None = None
    for size in SIZES:
        keep = int(np.count_nonzero(strength[widest] * size**2 > 1.0))
        if keep == 0:
            continue
        rows = np.concatenate(
            [np.arange(known), known + np.arange(keep), known + count + np.arange(keep)]
        )
        prior = np.concatenate([fit.prior, np.full(2 * keep, size)])
        left = sums.columns(rows).held_out(prior, folds)
        if best is None or left < best[0]:
            best = (left, size, keep)
    if best is None or best[0] >= fit.held_out(folds):
        return None
    return REMAINDER.about(term, points, modes[:, : best[2]], best[1])


def _modes(
    state: State,
    raw: Term,
    blocks: NDArray[np.int64],
    unit: Callable[[Term, View], ComplexArray],
) -> tuple[Array, Array]:
    """Combinations of scatterers by falling information, (3 n, m), and that information (m,).

    Only the in-phase half of the columns is used: the other half is the same, turned.
    """
    count = 3 * raw.site['_offsets'].shape[0]
    normal = np.zeros((count, count))
    for part in state.parts:
        rows = np.flatnonzero(np.isin(part.blocks, blocks))
        step = max(1, rows.size // 70)
        few = rows[::step]
        white = part.whitener.rows(few)(parts(unit(raw, part.view.frames(few))))
        flat = white.reshape(-1, count)
        normal += step * (flat.T @ flat)
    values, vectors = np.linalg.eigh(normal)
    order = np.argsort(values)[::-1]
    return vectors[:, order], values[order]
