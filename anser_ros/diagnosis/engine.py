"""Fits and selects terms of any observation: Gauss-Newton, cross-validation, forward selection.

Sums of columns over blocks come first, then states and fits, steps, scores of candidates, and the
selection. Fluxes and poses are fitted and searched by this engine alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from anser_ros.arrays import Array, Integers
from anser_ros.diagnosis.decisions import TIME_FOLDS
from anser_ros.effects.base import BaseTerm
from anser_ros.parallel import in_order, slices

Columns = Sequence[Array | None]

BLOCKS_A_THREAD = 4
"""Blocks that one thread sums up, half a millisecond's work."""


class WhitePart(Protocol):
    """One body or sensor at a state: whitened residuals (F, n), and the block of each frame."""

    @property
    def white(self) -> Array: ...
    @property
    def blocks(self) -> Integers: ...
    @property
    def count(self) -> int: ...


@dataclass(frozen=True)
class BlockSums:
    """Holds the normal equations of some columns and the residual, block by block."""

    normal: Array  # (B, q, q)
    right: Array  # (B, q)
    squares: Array  # (B,), sum of the squared residuals

    @property
    def size(self) -> int:
        """Return the number of columns."""
        return int(self.right.shape[1])

    @property
    def is_finite(self) -> bool:
        """Return whether all columns are numbers."""
        return bool(np.isfinite(self.normal).all())

    def part(self, rows: Integers) -> 'BlockSums':
        """Return the sums of some blocks, chosen by index."""
        return BlockSums(self.normal[rows], self.right[rows], self.squares[rows])

    def columns(self, keep: Integers) -> 'BlockSums':
        """Return the sums of some columns, chosen by index."""
        normal = self.normal[:, keep[:, None], keep[None, :]]
        return BlockSums(normal, self.right[:, keep], self.squares)

    def solve(self, prior: Array) -> tuple[Array, Array]:
        """Estimate and covariance with a Gaussian prior about zero (standard deviations (q,))."""
        covariance = _covariance(self.normal.sum(axis=0), prior)
        return covariance @ self.right.sum(axis=0), covariance

    def step(self, prior: Array, damping: float) -> Array:
        """Estimate with the diagonal raised by a share ``damping`` of itself (Marquardt)."""
        normal = self.normal.sum(axis=0)
        raised = normal + damping * np.diag(np.diag(normal))
        return _estimate(raised, self.right.sum(axis=0), prior)

    def explained_alone(self, prior: Array) -> Array:
        """Return what the columns explain in each block (B,), fitted to that block alone."""
        covariance = _covariance(self.normal, prior)
        return np.asarray(np.einsum('bi,bij,bj->b', self.right, covariance, self.right))

    def covariance(self, prior: Array, misfit: float) -> Array:
        """Return the covariance of all parameters, honest about errors alike within a block.

        The formal one is scaled by the misfit, the mean square of the whitened residuals; where
        the blocks' scores scatter more than it predicts (White's sandwich with blocks as
        clusters), a parameter's variance is raised accordingly.
        """
        formal = self.solve(prior)[1]
        blocks = max(self.squares.size, 2)
        scores = self.right @ formal
        robust = np.sum(scores**2, axis=0) * blocks / (blocks - 1)
        variance = np.diag(formal) * max(misfit, 1.0)
        scale = np.sqrt(np.maximum(variance, robust) / np.maximum(np.diag(formal), 1e-300))
        return np.asarray(formal * scale[:, None] * scale[None, :])

    def held_out(self, prior: Array, folds: int) -> float:
        """Return the sum of squared residuals of each fold, predicted from the others."""
        if self.size == 0:
            return float(self.squares.sum())
        total_normal, total_right = self.normal.sum(axis=0), self.right.sum(axis=0)
        left = 0.0
        number = np.arange(self.squares.size) % folds
        for fold in range(folds):
            rows = number == fold
            normal, right = self.normal[rows].sum(axis=0), self.right[rows].sum(axis=0)
            estimate = _estimate(total_normal - normal, total_right - right, prior)
            left += float(
                self.squares[rows].sum() - 2 * right @ estimate + estimate @ normal @ estimate
            )
        return left


def _scaled(normal: Array, prior: Array) -> tuple[Array, Array]:
    """Normal matrices (..., q, q) with the prior, scaled to a unit diagonal, and the scale."""
    full = normal + np.diag(1 / prior**2)
    scale = 1 / np.sqrt(np.diagonal(full, axis1=-2, axis2=-1))
    return full * scale[..., :, None] * scale[..., None, :], scale


def _covariance(normal: Array, prior: Array) -> Array:
    full, scale = _scaled(normal, prior)
    inverse = np.linalg.pinv(full, rcond=1e-13, hermitian=True)
    return np.asarray(inverse * scale[..., :, None] * scale[..., None, :])


def _estimate(normal: Array, right: Array, prior: Array) -> Array:
    """The estimate alone, by Cholesky where that goes."""
    full, scale = _scaled(normal, prior)
    try:
        factor = cho_factor(full + 1e-12 * np.eye(scale.size), check_finite=False)
    except np.linalg.LinAlgError:
        return _covariance(normal, prior) @ right
    return np.asarray(scale * cho_solve(factor, scale * right, check_finite=False))


def spans(blocks: Integers, wanted: Integers) -> list[slice | Integers]:
    """Return the rows of each wanted block; of blocks of time, which are runs, as slices."""
    if np.any(np.diff(blocks) < 0):
        return [np.flatnonzero(blocks == number) for number in wanted]
    starts = np.searchsorted(blocks, wanted, side='left')
    ends = np.searchsorted(blocks, wanted, side='right')
    return [slice(int(a), int(b)) for a, b in zip(starts, ends, strict=True)]


def block_sums(parts: Sequence[WhitePart], columns: Columns, wanted: Integers) -> BlockSums:
    """Return sums over the blocks that are wanted; columns are one (F, n, q) or None a part."""
    size = width_of(columns)
    normal = np.zeros((wanted.size, size, size))
    right = np.zeros((wanted.size, size))
    squares = np.zeros(wanted.size)
    whites = [part.white for part in parts]
    rows_of = [spans(part.blocks, wanted) for part in parts]

    def work(mine: slice) -> None:
        for residual, column, rows in zip(whites, columns, rows_of, strict=True):
            for i in range(mine.start, mine.stop):
                white = residual[rows[i]].ravel()
                squares[i] += white @ white
                if column is not None:
                    flat = column[rows[i]].reshape(-1, size)
                    normal[i] += flat.T @ flat
                    right[i] += flat.T @ white

    in_order(work, slices(wanted.size, BLOCKS_A_THREAD))
    return BlockSums(normal, right, squares)


def cross_sums(
    parts: Sequence[WhitePart],
    left: Columns,
    right: Columns,
    one: BlockSums,
    other: BlockSums,
    wanted: Integers,
) -> BlockSums:
    """Return the sums of two groups of columns side by side, from those of each."""
    a, b = one.size, other.size
    if a == 0:
        return other
    cross = np.zeros((wanted.size, a, b))
    for part, first, last in zip(parts, left, right, strict=True):
        if first is None or last is None:
            continue
        for i, rows in enumerate(spans(part.blocks, wanted)):
            cross[i] += first[rows].reshape(-1, a).T @ last[rows].reshape(-1, b)
    normal = np.block([[one.normal, cross], [cross.transpose(0, 2, 1), other.normal]])
    return BlockSums(normal, np.concatenate([one.right, other.right], axis=1), other.squares)


def joined(groups: Sequence[Columns]) -> list[Array | None]:
    """Return columns of several groups side by side; zeros where a group has none."""
    if len(groups) == 1:
        return list(groups[0])
    widths = [width_of(group) for group in groups]
    out: list[Array | None] = []
    for pieces in zip(*groups, strict=True):
        known = next((p for p in pieces if p is not None), None)
        if known is None:
            out.append(None)
            continue
        filled = [
            np.zeros((*known.shape[:2], size)) if p is None else p
            for p, size in zip(pieces, widths, strict=True)
        ]
        out.append(np.concatenate(filled, axis=2))
    return out


def width_of(group: Sequence[NDArray[Any] | None]) -> int:
    """Return the number of columns of a group, 0 where it has none in any part."""
    return next((c.shape[-1] for c in group if c is not None), 0)


TermT = TypeVar('TermT', bound=BaseTerm)

ATTEMPTS = 6
"""Dampings that are tried for a step, each ten or a hundred times the one before."""
SETTLED = 1e-5
"""Share of the sum of squares by which a step must lower it for the fit to go on: of 1e5 readings
fitted to their noise it is one, so that the next step is far less than a standard deviation."""
MOST_COLUMNS = 60
"""Columns that an active term may have to be fitted again with each candidate: a term with more
is what metal left, no effect."""
PartT = TypeVar('PartT', bound=WhitePart)


@dataclass(frozen=True)
class JointState(Generic[TermT, PartT]):
    """Holds a problem with a list of active terms."""

    problem: Any
    terms: tuple[TermT, ...]
    parts: tuple[PartT, ...]
    folds: ClassVar[int] = TIME_FOLDS

    def design(self, term: TermT, probe: bool = False) -> list[Array | None]:
        """Return whitened columns of a term, one array (F, n, q) a part, None for no columns."""
        raise NotImplementedError

    def moved(self, terms: Sequence[TermT]) -> Self:
        """Return the state of the same problem with other terms."""
        raise NotImplementedError

    @cached_property
    def sum_of_squares(self) -> float:
        """Return the sum of squares of the whitened residuals."""
        return float(sum(np.sum(part.white**2) for part in self.parts))

    @property
    def penalty(self) -> float:
        """Return what freedom that is left to each frame costs."""
        return 0.0

    @property
    def count(self) -> int:
        """Return the number of values that have a weight, over all parts."""
        return sum(part.count for part in self.parts)

    @property
    def misfit(self) -> float:
        """Return the mean square of the whitened residuals; one where only noise is left."""
        return self.sum_of_squares / max(self.count, 1)

    def prior(self, terms: Sequence[TermT] | None = None) -> Array:
        """Return the standard deviations of the terms' parameters, by default of all, (q,)."""
        chosen = self.terms if terms is None else terms
        return np.concatenate([term.effect.prior(term) for term in chosen] or [np.zeros(0)])

    def sums(self, blocks: Integers) -> BlockSums:
        """Return the normal equations of all terms, block by block."""
        return block_sums(self.parts, self.designs(self.terms), blocks)

    def designs(self, terms: Sequence[TermT]) -> list[Array | None]:
        """Return whitened columns of terms side by side, one array (F, n, q) a part, or None."""
        groups = [self.design(term) for term in terms]
        return joined(groups) if groups else [None] * len(self.parts)


StateT = TypeVar('StateT', bound=JointState[Any, Any])


@dataclass(frozen=True)
class JointFit(Generic[StateT]):
    """Holds a state at the joint optimum of its terms."""

    state: StateT
    blocks: Integers  # of time, those that take part
    made: BlockSums | None = None  # the state's sums, where the last step has made them

    @cached_property
    def sums(self) -> BlockSums:
        """Return the normal equations at the optimum, made when they are first asked for."""
        return self.state.sums(self.blocks) if self.made is None else self.made

    @cached_property
    def prior(self) -> Array:
        """Return the standard deviations of all terms' parameters, shape (q,)."""
        return self.state.prior()

    @property
    def misfit(self) -> float:
        """Return the mean square of the whitened residuals; one where only noise is left."""
        return self.state.misfit

    @cached_property
    def covariance(self) -> Array:
        """Return the covariance (q, q) of all terms' parameters, in their order."""
        if not self.prior.size:
            return np.zeros((0, 0))
        return self.sums.covariance(self.prior, self.misfit)

    def rows(self, index: int) -> slice:
        """Return where a term's parameters stand among all."""
        edges = np.cumsum([0] + [t.theta.size for t in self.state.terms]).tolist()
        return [slice(a, b) for a, b in pairwise(edges)][index]

    def covariance_of(self, index: int) -> Array:
        """Return the covariance of one term's parameters."""
        return self.covariance[self.rows(index), self.rows(index)]

    def held_out(self) -> float:
        """Return the cross-validated squares, linear about the optimum, plus what freedom cost.

        Infinite where there is no derivative, as of metal in an emitter's dipole.
        """
        if not self.sums.is_finite:
            return np.inf
        return self.sums.held_out(self.prior, self.state.folds) + self.state.penalty


FitT = TypeVar('FitT', bound=JointFit[Any])


def descended(
    state: StateT, blocks: Integers, iterations: int
) -> tuple[StateT, Integers, BlockSums | None]:
    """Lower a sum of squares by damped Gauss-Newton steps until it has settled.

    ``iterations``: steps at most. Returns the state, ``blocks``, and the state's sums over these
    if they were made.
    """
    damping = 0.0
    for _ in range(iterations if state.prior().size else 0):
        sums = state.sums(blocks)
        if not sums.is_finite:
            return state, blocks, sums
        better, damping = _better(state, sums, state.prior(), damping)
        if better is None:
            return state, blocks, sums
        before, state = state.sum_of_squares, better
        if before - state.sum_of_squares < SETTLED * before:
            break
    return state, blocks, None


def _better(
    state: StateT, sums: BlockSums, prior: Array, damping: float
) -> tuple[StateT | None, float]:
    """A state with a lower sum of squares, and the damping (Marquardt's) that found it."""
    for attempt in range(ATTEMPTS):
        trial = state.moved(stepped(state.terms, sums.step(prior, damping)))
        if trial.sum_of_squares < state.sum_of_squares:
            return trial, damping / 30 if damping > 1e-6 else 0.0
        damping = max(1e-5, 10 ** (attempt % 2 + 1) * damping)
    return None, damping


def stepped(terms: Sequence[TermT], step: Array) -> list[TermT]:
    """Return terms with a step added to all their parameters."""
    out, start = [], 0
    for term in terms:
        part = step[start : start + term.theta.size]
        start += term.theta.size
        out.append(term.effect.bounded(term.with_theta(term.theta + part)))
    return out


def is_covered(candidate: BaseTerm, active: Sequence[BaseTerm]) -> bool:
    """Return whether an active term stands for a candidate already."""
    return any(one.effect.covers(one, candidate) for one in active)


@dataclass(frozen=True)
class Score:
    """Scores one candidate, given the active effects."""

    held_out: float  # sum of squares of the held-out residuals with the candidate
    solution: Array  # (q,), the candidate's coefficients, the active effects refitted
    own: BlockSums  # of the candidate alone


class Scorer(Generic[StateT]):
    """Scores candidates against one state; the sums of the active effects are made once."""

    def __init__(self, state: StateT, blocks: Integers) -> None:
        self.state, self.blocks = state, blocks
        terms = [t for t in state.terms if t.theta.size <= MOST_COLUMNS]
        self._active = state.designs(terms)
        self.prior = state.prior(terms)
        self.sums = block_sums(state.parts, self._active, blocks)
        self.held_out = self.sums.held_out(self.prior, state.folds) + state.penalty

    def score(self, term: BaseTerm, prior: Array | None = None) -> Score | None:
        """Return the worth of a candidate; None where it has no finite effect on any value.

        Without a prior (q,) its coefficients are free.
        """
        probe = self.state.design(term, probe=True)
        width = width_of(probe)
        if width == 0:
            return None
        own = block_sums(self.state.parts, probe, self.blocks)
        if not np.any(own.normal) or not np.isfinite(own.normal).all():
            return None
        sums = cross_sums(self.state.parts, self._active, probe, self.sums, own, self.blocks)
        if prior is None:
            scale = np.sqrt(np.diag(own.normal.sum(axis=0)))
            prior = np.where(scale > 0, 1e4 / np.maximum(scale, 1e-300), 1.0)
        full_prior = np.concatenate([self.prior, prior])
        estimate, _ = sums.solve(full_prior)
        left = sums.held_out(full_prior, self.state.folds) + self.state.penalty
        return Score(left, estimate[-width:], own)


class ForwardSelection(Generic[FitT]):
    """Adds effects one by one, the best first, while each pays for itself, and removes the others.

    What pays, and what is superfluous beside the others, an observation says.
    """

    most = 6  # effects after which the search ends: more would be stand-ins

    def addition(self, fit: FitT) -> FitT | None:
        """Return the fit with the effect that is worth most, or None when none pays."""
        raise NotImplementedError

    def taken(self, fit: FitT) -> FitT:
        """Return a fit with an effect more, the earlier ones reconsidered."""
        return fit

    def is_lost(self, fit: FitT) -> bool:
        """Return whether further effects would only stand in for another cause."""
        return False

    def superfluous(self, fit: FitT) -> FitT | None:
        """Return the fit without one effect that the others explain away; None for none."""
        raise NotImplementedError

    def grown(self, fit: FitT) -> FitT:
        """Return the fit with all effects that pay."""
        for _ in range(self.most):
            better = self.addition(fit)
            if better is None:
                break
            fit = self.taken(better)
            if self.is_lost(fit):
                break
        return fit

    def thinned(self, fit: FitT) -> FitT:
        """Return the fit without what the others explain away."""
        while (without := self.superfluous(fit)) is not None:
            fit = without
        return fit
