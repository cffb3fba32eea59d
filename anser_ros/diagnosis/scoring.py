"""Scores groups of columns by cross-validation, from sums over time blocks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from anser_ros.diagnosis.decisions import TIME_FOLDS
from anser_ros.diagnosis.problem import State
from anser_ros.effects.term import Term
from anser_ros.parallel import in_order, slices

Array = NDArray[np.float64]
Columns = Sequence[Array | None]

BLOCKS_A_THREAD = 4
"""Blocks that one thread sums up, half a millisecond's work."""
MOST_COLUMNS = 60
"""Columns that a term in force may have to be fitted again with each candidate. A term with more
is what metal left, and no effect's rival."""


@dataclass(frozen=True)
class BlockSums:
    """Holds the normal equations of some columns and the residual, block by block.

    Attributes
    ----------
    normal : ndarray, shape (B, q, q)
    right : ndarray, shape (B, q)
    squares : ndarray, shape (B,)
        Sum of the squared residuals.
    """

    normal: Array
    right: Array
    squares: Array

    @property
    def size(self) -> int:
        """Return the number of columns."""
        return int(self.right.shape[1])

    def part(self, rows: NDArray[np.int64]) -> 'BlockSums':
        """Return the sums of some blocks, chosen by index."""
        return BlockSums(self.normal[rows], self.right[rows], self.squares[rows])

    def columns(self, keep: NDArray[np.int64]) -> 'BlockSums':
        """Return the sums of some columns, chosen by index."""
        normal = self.normal[:, keep[:, None], keep[None, :]]
        return BlockSums(normal, self.right[:, keep], self.squares)

    def solve(self, prior: Array) -> tuple[Array, Array]:
        """Estimate and covariance with a Gaussian prior about zero (standard deviations (q,))."""
        return _solve(self.normal.sum(axis=0), self.right.sum(axis=0), prior)

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


def _solve(normal: Array, right: Array, prior: Array) -> tuple[Array, Array]:
    """Estimate and covariance."""
    covariance = _covariance(normal, prior)
    return covariance @ right, covariance


def _estimate(normal: Array, right: Array, prior: Array) -> Array:
    """The estimate alone, by Cholesky where that goes."""
    full, scale = _scaled(normal, prior)
    try:
        factor = cho_factor(full + 1e-12 * np.eye(scale.size), check_finite=False)
    except np.linalg.LinAlgError:
        return _solve(normal, right, prior)[0]
    return np.asarray(scale * cho_solve(factor, scale * right, check_finite=False))


def spans(blocks: NDArray[np.int64], wanted: NDArray[np.int64]) -> list[slice]:
    """Return rows of each wanted block; frames are in the order of time, so a block is one run."""
    starts = np.searchsorted(blocks, wanted, side='left')
    ends = np.searchsorted(blocks, wanted, side='right')
    return [slice(int(a), int(b)) for a, b in zip(starts, ends, strict=True)]


def block_sums(state: State, columns: Columns, block_numbers: NDArray[np.int64]) -> BlockSums:
    """Sums over the blocks that are listed.

    Parameters
    ----------
    state : State
    columns : one array (F, n, q) or None a part of the state
    block_numbers : ndarray, shape (B,)
    """
    widths = [c.shape[2] for c in columns if c is not None]
    size = widths[0] if widths else 0
    normal = np.zeros((block_numbers.size, size, size))
    right = np.zeros((block_numbers.size, size))
    squares = np.zeros(block_numbers.size)
    rows_of = [spans(part.blocks, block_numbers) for part in state.parts]

    def work(mine: slice) -> None:
        for part, column, rows in zip(state.parts, columns, rows_of, strict=True):
            for i in range(mine.start, mine.stop):
                white = part.white[rows[i]].ravel()
                squares[i] += white @ white
                if column is not None:
                    flat = column[rows[i]].reshape(-1, size)
                    normal[i] += flat.T @ flat
                    right[i] += flat.T @ white

    in_order(work, slices(block_numbers.size, BLOCKS_A_THREAD))
    return BlockSums(normal, right, squares)


def joined(groups: Sequence[Columns]) -> list[Array | None]:
    """Return columns of several groups side by side; zeros where a group has none."""
    if len(groups) == 1:
        return list(groups[0])
    out: list[Array | None] = []
    for pieces in zip(*groups, strict=True):
        known = [p for p in pieces if p is not None]
        if not known:
            out.append(None)
            continue
        rows = known[0].shape[:2]
        widths = [_width(group) for group in groups]
        out.append(
            np.concatenate(
                [
                    np.zeros((*rows, width)) if p is None else p
                    for p, width in zip(pieces, widths, strict=True)
                ],
                axis=2,
            )
        )
    return out


def _width(group: Columns) -> int:
    return next((c.shape[2] for c in group if c is not None), 0)


@dataclass(frozen=True)
class Score:
    """Scores one candidate, given the effects that are in force.

    Attributes
    ----------
    held_out : float
        Sum of squares of the held-out residuals with the candidate.
    solution : ndarray, shape (q,)
        The candidate's columns' coefficients, the effects in force refitted.
    own : BlockSums
        Of the candidate alone.
    """

    held_out: float
    solution: Array
    own: BlockSums


class Scorer:
    """Scores candidates against one state; the sums of the effects in force are made once."""

    def __init__(self, state: State, blocks: NDArray[np.int64]) -> None:
        self.state, self.blocks = state, blocks
        # Terms of very many columns stay as they are: they are what metal left, not effects.
        terms = [t for t in state.terms if t.theta.size <= MOST_COLUMNS]
        self._active = joined([state.design(t) for t in terms]) if terms else None
        self.prior = np.concatenate([t.effect.prior(t) for t in terms] or [np.zeros(0)])
        empty: list[Array | None] = [None] * len(state.parts)
        self.sums = block_sums(state, self._active or empty, blocks)
        self.held_out = self.sums.held_out(self.prior, TIME_FOLDS) + state.penalty

    def score(self, term: 'Term') -> Score | None:
        """Return the worth of a candidate; None when it touches no value, or is at a dipole's own
        place.
        """
        probe = self.state.design(term, probe=True)
        width = _width(probe)
        if width == 0:
            return None
        own = block_sums(self.state, probe, self.blocks)
        if not np.any(own.normal) or not np.isfinite(own.normal).all():
            return None
        sums = self._beside(probe, own)
        scale = np.sqrt(np.diag(own.normal.sum(axis=0)))
        prior = np.where(scale > 0, 1e4 / np.maximum(scale, 1e-300), 1.0)
        full_prior = np.concatenate([self.prior, prior])
        estimate, _ = sums.solve(full_prior)
        left = sums.held_out(full_prior, TIME_FOLDS) + self.state.penalty
        return Score(left, estimate[-width:], own)

    def _beside(self, probe: Columns, own: BlockSums) -> BlockSums:
        active = self.sums
        a, b = active.size, own.size
        if a == 0:
            return own
        cross = np.zeros((self.blocks.size, a, b))
        for part, left, right in zip(self.state.parts, self._active or [], probe, strict=True):
            if left is None or right is None:
                continue
            for i, rows in enumerate(spans(part.blocks, self.blocks)):
                cross[i] += left[rows].reshape(-1, a).T @ right[rows].reshape(-1, b)
        normal = np.concatenate(
            [
                np.concatenate([active.normal, cross], axis=2),
                np.concatenate([cross.transpose(0, 2, 1), own.normal], axis=2),
            ],
            axis=1,
        )
        return BlockSums(normal, np.concatenate([active.right, own.right], axis=1), own.squares)
