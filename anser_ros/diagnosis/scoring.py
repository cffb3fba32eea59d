"""Sums up columns and residuals over blocks of time or space, and cross-validates by the sums."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from anser_ros.parallel import in_order, slices

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Columns = Sequence[Array | None]

BLOCKS_A_THREAD = 4
"""Blocks that one thread sums up, half a millisecond's work."""


class WhitePart(Protocol):
    """One body or sensor at a state: whitened residuals (F, n), and the block of each frame."""

    @property
    def white(self) -> Array: ...
    @property
    def blocks(self) -> Ints: ...
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


def spans(blocks: Ints, wanted: Ints) -> list[slice | Ints]:
    """Return the rows of each wanted block; of blocks of time, which are runs, as slices."""
    if np.any(np.diff(blocks) < 0):
        return [np.flatnonzero(blocks == number) for number in wanted]
    starts = np.searchsorted(blocks, wanted, side='left')
    ends = np.searchsorted(blocks, wanted, side='right')
    return [slice(int(a), int(b)) for a, b in zip(starts, ends, strict=True)]


def block_sums(parts: Sequence[WhitePart], columns: Columns, wanted: Ints) -> BlockSums:
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
    wanted: Ints,
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


def width_of(group: Columns) -> int:
    """Return the number of columns of a group, 0 where it has none in any part."""
    return next((c.shape[2] for c in group if c is not None), 0)
