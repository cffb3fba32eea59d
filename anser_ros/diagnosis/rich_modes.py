"""Combines a metal's couplings into those that the data determine, of the size that predicts best.

Metal has many more couplings than any data can determine. The combinations that the data determine
best are its modes; the width of their prior is chosen on held-out blocks of time.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.decisions import TIME_FOLDS
from anser_ros.diagnosis.engine import BlockSums, block_sums, joined
from anser_ros.diagnosis.problem import Part, State, parts
from anser_ros.effects.view import View

Array = NDArray[np.float64]
Known = tuple[list[Array | None], Array]
"""Columns, one array for each part of a state, and their prior sizes."""
Unit = Callable[[View, Array], NDArray[np.inexact]]
"""Flux (F, S, K, m) of modes (c, m) of couplings in a view."""

MOST_SIZED_MODES = 130
"""Modes, at most, of which the data are asked how large they are: more would be slower to compare
than they could ever explain."""
LEAST_INFORMATION = 0.3
"""Information in the data, over that in the prior, below which a mode is left out: it would stay
at about zero and only take time."""
SCORED_FRAMES = 130
"""Frames of each part, about, on which sizes of couplings are compared."""


def rich_modes(
    few: State,
    known: Known,
    unit: Unit,
    spreads: Sequence[Array],
    blocks: NDArray[np.int64],
    most: int,
) -> tuple[float, Array] | None:
    """Return combinations of couplings, of the size that predicts held-out blocks best.

    ``few``: at a fit without these couplings, or with others in their place; some frames do;
    ``known``: columns of what is fitted with them, and their prior sizes; ``unit``: flux (F, S, K,
    m) of modes (c, m) in a view; ``spreads`` (c,): prior sizes of the couplings that are tried.

    Returns (c, m) sum of squares of the held-out residuals, and modes of unit prior size; None
    where no size is better than none at all.
    """
    widest = np.max(spreads, axis=0)
    values, vectors = np.linalg.eigh(
        _information(few, unit, widest.size) * widest[:, None] * widest
    )
    leading = np.argsort(values)[::-1][:MOST_SIZED_MODES]
    leading = leading[values[leading] > LEAST_INFORMATION]
    if leading.size == 0:
        return None
    vectors = vectors[:, leading]
    group = _both_phases(few, unit, widest[:, None] * vectors)
    columns, prior = known
    sums = block_sums(few.parts, joined([columns, group]), blocks)
    width, count = prior.size, leading.size
    bare = sums.columns(np.arange(width))
    best: tuple[float, Array] = (bare.held_out(prior, TIME_FOLDS), np.zeros((0, 0)))
    for spread in spreads:
        turned = vectors * (spread / widest)[:, None]
        root = np.linalg.cholesky(turned.T @ turned + 1e-12 * np.eye(count))
        left = _turned(sums, width, root).held_out(
            np.concatenate([prior, np.ones(2 * count)]), TIME_FOLDS
        )
        if left < best[0]:
            best = (left, root)
    root = best[1]
    if root.size == 0:
        return None
    total = sums.normal.sum(axis=0)[width : width + count, width : width + count]
    information, turn = np.linalg.eigh(root.T @ total @ root)
    order = np.argsort(information)[::-1][:most]
    order = order[information[order] > LEAST_INFORMATION]
    if not order.size:
        return None
    return best[0], (widest[:, None] * vectors) @ root @ turn[:, order]


def _turned(sums: BlockSums, known: int, root: Array) -> BlockSums:
    """The sums with the columns after the known ones, two groups of them, turned by a matrix."""
    count = root.shape[0]
    turn = np.eye(known + 2 * count)
    for start in (known, known + count):
        turn[start : start + count, start : start + count] = root
    return BlockSums(turn.T @ sums.normal @ turn, sums.right @ turn, sums.squares)


def thinned(state: State, blocks: NDArray[np.int64]) -> State:
    """Return the state with only some frames of every part."""
    parts_ = []
    for part in state.parts:
        rows = np.flatnonzero(np.isin(part.blocks, blocks))
        rows = rows[:: max(1, round(rows.size / SCORED_FRAMES))]
        parts_.append(
            Part(
                part.view.frames(rows), part.residual[rows], part.whitener.rows(rows),
                part.white[rows], part.blocks[rows],
            )
        )  # fmt: skip
    return replace(state, parts=tuple(parts_))


def _information(state: State, unit: Unit, count: int) -> Array:
    """Of single couplings, (c, c), from half of the frames.

    Only the in-phase half of the columns is used: the other half is the same, rotated in phase.
    """
    normal = np.zeros((count, count))
    for part in state.parts:
        rows = np.arange(0, part.view.time.size, 2)
        flux = unit(part.view.frames(rows), np.eye(count))
        white = part.whitener.rows(rows)(parts(flux.astype(complex)))
        flat = white.reshape(-1, count)
        normal += 2 * (flat.T @ flat)
    return normal


def _both_phases(state: State, unit: Unit, modes: Array) -> list[Array | None]:
    """Whitened columns of modes in phase and in quadrature, one array per part."""
    out: list[Array | None] = []
    for part in state.parts:
        flux = unit(part.view, modes)
        out.append(part.whitener(parts(np.concatenate([flux, 1j * flux], axis=-1))))
    return out
