"""Refines a metal effect: the modes of a cloud of scatterers about it that the data can tell."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.fit import Fit, fit_terms
from anser_ros.diagnosis.problem import Problem, State
from anser_ros.diagnosis.scoring import block_sums, joined
from anser_ros.diagnosis.whitening import parts
from anser_ros.effects.effect import Term
from anser_ros.effects.metal_remainder import REMAINDER

Array = NDArray[np.float64]

METALS = ('static_metal', 'conductive_plate', 'moving_metal')
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
    problem: Problem, terms: Sequence[Term], blocks: NDArray[np.int64], folds: int, iterations: int
) -> Fit:
    """The joint fit of all effects, metal with a remainder each.

    Places and sizes are fitted without remainders, which could take their part; with them, they are
    held.
    """
    plain = [term.frozen(False) for term in terms if term.effect is not REMAINDER]
    fit = fit_terms(problem, plain, blocks, iterations)
    metals = [term for term in fit.terms if term.effect.name in METALS]
    if not metals:
        return fit
    held = [term.frozen(True) if term.effect.name in METALS else term for term in fit.terms]
    refined = fit_terms(problem, held, blocks, 1)
    for term in refined.terms:
        if term.effect.name in METALS:
            more = remainder_of(refined, term, problem, blocks, folds)
            if more is not None:
                refined = fit_terms(problem, [*refined.terms, more], blocks, iterations)
    return refined


def _cloud(term: Term, problem: Problem) -> Array:
    """Points in fg, or from the centre for metal that moves."""
    if term.effect.name == 'conductive_plate':
        z, edge, x, y, _ = term.theta
        steps = (np.arange(8) - 3.5) * edge / 6
        points = np.array([(x + a, y + b, z) for a in steps for b in steps])
    else:
        lateral, upright = (np.arange(5) - 2) * SPACING, (np.arange(3) - 1) * SPACING
        points = np.array([(a, b, c) for a in lateral for b in lateral for c in upright])
        if term.effect.moving:
            return points
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
    modes, strength = _modes(state, raw, blocks)
    best: tuple[float, Term] | None = None
    for size in SIZES:
        keep = np.flatnonzero(strength * size**2 > 1.0)[:MOST_MODES]
        if keep.size == 0:
            continue
        trial = REMAINDER.about(term, points, modes[:, keep], size)
        columns = joined([*(state.design(t) for t in fit.terms), state.design(trial)])
        prior = np.concatenate([fit.prior, REMAINDER.prior(trial)])
        left = block_sums(state, columns, blocks).held_out(prior, folds)
        if best is None or left < best[0]:
            best = (left, trial)
    if best is None or best[0] >= fit.held_out(folds):
        return None
    return best[1]


def _modes(state: State, raw: Term, blocks: NDArray[np.int64]) -> tuple[Array, Array]:
    """Combinations of scatterers by falling information, (3 n, m), and that information (m,).

    Only the in-phase half of the columns is used: the other half is the same, turned.
    """
    count = raw.theta.size // 2
    normal = np.zeros((count, count))
    for part in state.parts:
        rows = np.flatnonzero(np.isin(part.blocks, blocks))
        step = max(1, rows.size // 90)
        few = rows[::step]
        unit = REMAINDER.columns(raw, part.view.frames(few))
        if unit is None:
            continue
        white = part.whitener.rows(few)(parts(unit[..., :count]))
        flat = white.reshape(-1, count)
        normal += step * (flat.T @ flat)
    values, vectors = np.linalg.eigh(normal)
    order = np.argsort(values)[::-1]
    return vectors[:, order], values[order]
