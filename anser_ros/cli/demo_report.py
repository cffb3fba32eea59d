"""Sums a demo up and draws its picture, from the file that the monitor writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Results = dict[str, Any]
LIVE = 'live'
FROZEN = 'frozen'
MEANINGS = {
    LIVE: 'model refitted to the reference coils, gated',
    FROZEN: 'frozen model, gate off: what a tracker without a residual gate would publish',
}
COLOURS = ('tab:blue', 'tab:orange')
GAP_S = 0.1
"""Longest time between poses, s, that a line is drawn across."""
SMOOTH = 25
"""Number of poses of the running median by which the reported sigma is drawn."""
METAL_NEAR_M = 0.3
"""Distance of the disc from the board, m, up to which the picture marks the metal as near."""
VISITS_APART_S = 3.0
"""Time, s, after which metal that is near again counts as a further visit."""


def load(path: Path) -> Results:
    """Return the arrays of the file that the monitor wrote."""
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def summarise(results: Results) -> dict[str, dict[str, Any]]:
    """Return the errors, rates and latencies of each chain over all its sensors and bodies."""
    chains: dict[str, Any] = {}
    for rank, chain in enumerate(results['chains']):
        error = _joined(results, 'error', rank)
        error = error[np.isfinite(error)]
        stamps = [results[f'stamp_{rank}_{i}'] for i in range(len(results['names']))]
        if not error.size:
            continue
        longest = max(stamps, key=len)
        span = float(longest[-1] - longest[0]) if longest.size > 1 else 0.0
        chains[str(chain) or LIVE] = {
            'poses': int(sum(len(s) for s in stamps)),
            'rate_hz': float((longest.size - 1) / span) if span > 0 else 0.0,
            'position_rmse_m': float(np.sqrt(np.mean(error**2))),
            'position_prc50_m': float(np.percentile(error, 50)),
            'position_prc95_m': float(np.percentile(error, 95)),
            'position_max_m': float(error.max()),
            'latency_prc50_s': float(np.median(_joined(results, 'latency', rank))),
        }
    return {'chains': chains}


def draw(results: Results, path: Path) -> None:
    """Write the picture: true and tracked path from above and from the side, error over time."""
    from matplotlib.figure import Figure

    from anser_ros.pictures import save

    figure = Figure(figsize=(12, 7), layout='constrained')
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.6))
    shown = _shown_target(results)
    views = []
    for row, (first, second) in enumerate(((0, 1), (0, 2))):
        views.append(figure.add_subplot(grid[row, 0]))
        _draw_path(views[-1], results, shown, first, second)
    axes = figure.add_subplot(grid[:, 1])
    _draw_error(axes, results, shown)
    lines, labels = views[0].get_legend_handles_labels()
    more = axes.get_legend_handles_labels()
    figure.legend(
        [*lines, *more[0]], [*labels, *more[1]], loc='outside lower center', ncols=3,
        fontsize='small',
    )  # fmt: skip
    figure.suptitle(f'{results["names"][shown]}: simulated control unit, true and tracked')
    save(figure, path)


def _shown_target(results: Results) -> int:
    """Return the index of the last body if it has poses, else of what has the most poses."""
    counts = [len(results[f'stamp_0_{i}']) for i in range(len(results['names']))]
    return len(counts) - 1 if counts[-1] else int(np.argmax(counts))


def _chains(results: Results) -> list[tuple[int, str, str]]:
    """Return rank, name and colour of the chains; the live one is last, to be drawn on top."""
    names = [str(name) or LIVE for name in results['chains']]
    return list(zip(range(len(names)), names, COLOURS, strict=False))[::-1]


def broken(stamp_s: NDArray[np.float64], values: NDArray[np.float64]) -> Any:
    """Return stamps and values with a NaN in every gap, so that no line is drawn across it."""
    gaps = np.flatnonzero(np.diff(stamp_s) > GAP_S) + 1
    middle = (stamp_s[gaps - 1] + stamp_s[gaps]) / 2
    return np.insert(stamp_s, gaps, middle), np.insert(values, gaps, np.nan, axis=0)


def _draw_path(axes: Any, results: Results, shown: int, first: int, second: int) -> None:
    sides = [first, second]
    optical = results.get(f'optical_{results["names"][shown]}')
    if optical is not None:
        stamps, true = optical[:, 0], 1e3 * optical[:, 1:]
        tracked_s = results[f'stamp_0_{shown}']
        if tracked_s.size:
            true = true[(stamps >= tracked_s[0]) & (stamps <= tracked_s[-1])]
        axes.plot(*true[:, sides].T, color='0.6', lw=4, label='true path')
    for rank, chain, colour in _chains(results):
        stamp, position = results[f'stamp_{rank}_{shown}'], results[f'position_{rank}_{shown}']
        if len(position):
            tracked = 1e3 * broken(stamp, position)[1]
            axes.plot(*tracked[:, sides].T, lw=1.0, color=colour, label=f'tracked, {chain}')
    axes.set(xlabel=f'{"xyz"[first]}, mm', ylabel=f'{"xyz"[second]}, mm')
    axes.set_aspect('equal', adjustable='datalim')


def _draw_error(axes: Any, results: Results, shown: int) -> None:
    begin = float(results[f'stamp_0_{shown}'][0]) if len(results[f'stamp_0_{shown}']) else 0.0
    end = begin
    for rank, chain, colour in _chains(results):
        stamp = results[f'stamp_{rank}_{shown}']
        end = max(end, float(stamp[-1])) if stamp.size else end
        error, label = 1e3 * results[f'error_{rank}_{shown}'], f'error, {chain}: {MEANINGS[chain]}'
        axes.plot(stamp - begin, error, '.', ms=2.5, color=colour, label=label)
    stamp, sigma = results[f'stamp_0_{shown}'], 1e3 * results[f'sigma_0_{shown}']
    if stamp.size:
        at, level = broken(stamp - begin, _smoothed(sigma))
        words = 'half to twice the sigma, live'
        axes.fill_between(at, level / 2, 2 * level, color='k', alpha=0.15, lw=0, label=words)
    _shade_metal(axes, results['metal'], begin)
    axes.set(xlabel='time, s', ylabel='position error, mm', yscale='log')
    axes.set_xlim(0.0, max(end - begin, 1.0))
    axes.grid(alpha=0.3, which='both')


def _smoothed(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the running median over `SMOOTH` values."""
    reach = min(SMOOTH, len(values) - 1 + len(values) % 2) // 2
    padded = np.pad(values, reach, mode='edge')
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    return np.asarray(np.median(windows, axis=1))


def _shade_metal(axes: Any, metal: NDArray[np.float64], begin: float) -> None:
    near = metal[metal[:, 1] < METAL_NEAR_M, 0] - begin
    if not near.size:
        return
    visits = np.split(near, np.flatnonzero(np.diff(near) > VISITS_APART_S) + 1)
    for rank, visit in enumerate(visits):
        label = 'metal near' if rank == 0 else None
        axes.axvspan(visit[0], visit[-1], color='tab:red', alpha=0.12, label=label)


def _joined(results: Results, kind: str, rank: int) -> NDArray[np.float64]:
    parts = [results[f'{kind}_{rank}_{i}'] for i in range(len(results['names']))]
    return np.concatenate(parts) if parts else np.zeros(0)
