"""How often the 95 % intervals of Hummel's board hold the truth: simulated boards, other seeds.

The points of a board have independent errors, or a smooth distortion besides that is drawn again
for each board (a Gaussian process of the stated length, 1 mm rms a coordinate). The truth is the
mean of three thousand boards. No seed below 8999 is used here: the rule was chosen on some of
those. The table goes into docs/howto/accuracy.md.

    python test/bench/bench_intervals.py [--boards 120] [--json docs/results/intervals.json]
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import harness
import numpy as np

from anser_ros.apps.poses.assessment.distances import (
    VOLUMES,
    Grid,
    distance_errors,
    have_common_errors,
)

FIRST_SEED, TRUTH_SEED, TRUE_BOARDS = 9000, 8999, 3000
NOISE_M, DISTORTION_M = 3e-4, 1e-3
ROWS = ((90, 0.0), (12, 0.0), (90, 0.1), (90, 0.2), (90, 0.3), (25, 0.2), (12, 0.2))
"""Points of the board, and length of its distortion, m; none is zero."""
KINDS = {'5': '5 cm', '1': '15 cm', '3': '30 cm', 'a': 'accumulated'}
FIGURES = ('Mean', 'RMS')


class Boards:
    """Draws boards of one kind."""

    def __init__(self, count: int, length_m: float) -> None:
        self.grid = Grid.of(count, None, 0.05)
        rows, columns = np.meshgrid(
            np.arange(self.grid.rows), np.arange(self.grid.columns), indexing='ij'
        )
        flat = np.stack([rows, columns, 0 * rows], axis=-1).reshape(-1, 3)
        self._true = flat * self.grid.spacing_m
        self._root = np.zeros((count, count))
        if length_m:
            away = np.linalg.norm(self._true[:, None] - self._true[None], axis=2)
            covariance = np.exp(-0.5 * (away / length_m) ** 2) + 1e-9 * np.eye(count)
            self._root = DISTORTION_M * np.linalg.cholesky(covariance)

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """Return the points of one board, shape (rows, columns, 3), m."""
        noise, smooth = (rng.normal(size=self._true.shape) for _ in range(2))
        place = self._true + NOISE_M * noise + self._root @ smooth
        return place.reshape(self.grid.rows, self.grid.columns, 3)

    def sizes(self, place: np.ndarray) -> dict[str, np.ndarray]:
        """Return the sizes of the errors by kind, mm, as the protocol has them."""
        spacing, found = self.grid.spacing_m, {}
        for name, step in (('5', 1), ('1', 3), ('3', 6)):
            ways = [place[step:] - place[:-step], place[:, step:] - place[:, :-step]]
            lengths = np.concatenate([np.linalg.norm(way, axis=2).ravel() for way in ways])
            if lengths.size:
                found[name] = 1e3 * np.abs(lengths - step * spacing)
        far = np.linalg.norm(place[:, 1:] - place[:, :1], axis=2)
        found['a'] = (1e3 * np.abs(far - spacing * np.arange(1, self.grid.columns))).ravel()
        return found


def row_of(count: int, length_m: float, boards: int) -> list[str]:
    """Return the lines of the table for one kind of board."""
    drawn = Boards(count, length_m)
    rng, sums = np.random.default_rng(TRUTH_SEED), defaultdict(list)
    for _ in range(TRUE_BOARDS):
        for name, size in drawn.sizes(drawn.draw(rng)).items():
            sums[name].append((size.mean(), np.mean(size**2)))
    means = {name: np.mean(pairs, axis=0) for name, pairs in sums.items()}
    truth = {name: {'Mean': pair[0], 'RMS': np.sqrt(pair[1])} for name, pair in means.items()}
    held, widths, alike = defaultdict(list), defaultdict(list), 0
    for seed in range(FIRST_SEED, FIRST_SEED + boards):
        rng = np.random.default_rng(seed)
        place = drawn.draw(rng)
        alike += have_common_errors(place, drawn.grid)
        for group, errors in distance_errors(place, drawn.grid, rng).items():
            for figure in FIGURES:
                one, true = errors.summary[figure], truth[group[0]][figure]
                if np.isfinite(one.low):
                    held[group[0], figure].append(one.low <= true <= one.high)
                    widths[group[0], figure].append((one.high - one.low) / true)
    rows, columns = VOLUMES[count][1:]
    kind = f'{length_m:g} m' if length_m else 'none'
    lines = []
    for figure in FIGURES:
        cells = [
            f'{np.mean(held[name, figure]):.1%} ({np.median(widths[name, figure]):.1f})'
            if held[name, figure] else ''
            for name in KINDS
        ]  # fmt: skip
        head = f'| {rows} × {columns} | {kind} | {alike / boards:.0%} | {figure} '
        lines.append(head + ''.join(f'| {cell} ' for cell in cells) + '|')
    return lines


def lines(boards: int) -> Iterator[tuple[str, str]]:
    """Yield each line of the table with its name."""
    for count, length_m in ROWS:
        for figure, line in zip(FIGURES, row_of(count, length_m, boards), strict=True):
            yield f'{count} points, distortion of {length_m:g} m: {figure}', line


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[0])
    parser.add_argument('--boards', type=int, default=120, help='of each kind')
    parser.add_argument('--json', type=Path, help='file that gets the lines')
    args = parser.parse_args()
    print(f'| board | distortion | found correlated | figure | {" | ".join(KINDS.values())} |')
    print('|---' * (4 + len(KINDS)) + '|')
    harness.print_lines(lines(args.boards), args.json)


if __name__ == '__main__':
    main()
