"""Summary and picture of a demo, from the file that the monitor leaves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Results = dict[str, Any]
LIVE = 'live'
COLOURS = ('tab:blue', 'tab:orange')
METAL_NEAR_M = 0.3


def load(path: Path) -> Results:
    """Return the arrays of the monitor's file."""
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def summarise(results: Results) -> dict[str, object]:
    """Figures of each chain, over all its sensors and bodies together."""
    chains: dict[str, object] = {}
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
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 7), layout='constrained')
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.6))
    shown = _shown_target(results)
    for row, (first, second) in enumerate(((0, 1), (0, 2))):
        axes = figure.add_subplot(grid[row, 0])
        _draw_path(axes, results, shown, first, second)
    axes = figure.add_subplot(grid[:, 1])
    _draw_error(axes, results, shown)
    names = results['names']
    figure.suptitle(f'{names[shown]}: simulated control unit, true and tracked')
    figure.savefig(path, dpi=110)


def _shown_target(results: Results) -> int:
    """The last body if there is one with poses, else whatever has most poses."""
    counts = [len(results[f'stamp_0_{i}']) for i in range(len(results['names']))]
    return len(counts) - 1 if counts[-1] else int(np.argmax(counts))


def _draw_path(axes: Any, results: Results, shown: int, first: int, second: int) -> None:
    letters = 'xyz'
    name = str(results['names'][shown])
    if f'optical_{name}' in results:
        true = 1e3 * results[f'optical_{name}'][:, 1:]
        axes.plot(true[:, first], true[:, second], color='0.6', lw=3, label='true')
    for rank, chain in enumerate(results['chains']):
        tracked = 1e3 * results[f'position_{rank}_{shown}']
        if len(tracked):
            label = f'tracked, {chain}' if chain else 'tracked'
            axes.plot(
                tracked[:, first], tracked[:, second], lw=0.8, color=COLOURS[rank], label=label
            )
    axes.set_xlabel(f'{letters[first]}, mm')
    axes.set_ylabel(f'{letters[second]}, mm')
    axes.set_aspect('equal', adjustable='datalim')
    axes.legend(fontsize='small')


def _draw_error(axes: Any, results: Results, shown: int) -> None:
    begin = min(
        (results[f'stamp_{r}_{shown}'][0] for r in range(len(results['chains']))
         if len(results[f'stamp_{r}_{shown}'])),
        default=0.0,
    )  # fmt: skip
    for rank, chain in enumerate(results['chains']):
        stamp = results[f'stamp_{rank}_{shown}'] - begin
        error = 1e3 * results[f'error_{rank}_{shown}']
        label = f'error, {chain} model' if chain else 'error, model refitted live'
        axes.plot(stamp, error, '.', ms=2, color=COLOURS[rank], label=label)
        if rank == 0:
            sigma = 1e3 * results[f'sigma_{rank}_{shown}']
            axes.plot(stamp, sigma, color='k', lw=0.8, label='sigma')
    _shade_metal(axes, results['metal'], begin)
    axes.set_yscale('log')
    axes.set_xlabel('time, s')
    axes.set_ylabel('position error, mm')
    axes.grid(alpha=0.3, which='both')
    axes.legend(fontsize='small')


def _shade_metal(axes: Any, metal: NDArray[np.float64], begin: float) -> None:
    near = metal[metal[:, 1] < METAL_NEAR_M, 0] - begin
    if not near.size:
        return
    breaks = np.flatnonzero(np.diff(near) > 3.0)
    starts = near[np.concatenate([[0], breaks + 1])]
    ends = near[np.concatenate([breaks, [near.size - 1]])]
    for rank, (start, end) in enumerate(zip(starts, ends, strict=True)):
        label = 'metal near' if rank == 0 else None
        axes.axvspan(start, end, color='tab:red', alpha=0.12, label=label)


def _joined(results: Results, kind: str, rank: int) -> NDArray[np.float64]:
    parts = [results[f'{kind}_{rank}_{i}'] for i in range(len(results['names']))]
    return np.concatenate(parts) if parts else np.zeros(0)
