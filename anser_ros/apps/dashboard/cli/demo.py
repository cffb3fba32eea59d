"""Runs the demo: all nodes track a simulated tool, with a table, a bag and a picture.

Two chains of field model and tracker run side by side: one refits its model to the reference
coils, the other keeps the model as calibrated. A steel disc comes from below and leaves again.
"""

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from anser_ros.apps.dashboard.extension import LIVE_VIEW
from anser_ros.arrays import Array
from anser_ros.cli.main import check_packages
from anser_ros.cli.output import add_json, add_out, make_new_folder
from anser_ros.cli.processes import (
    FROZEN_TRACKER,
    LAST_DOMAIN,
    PATIENCE_S,
    VARIABLE,
    Supervisor,
    in_namespace,
    node_command,
    own_domain,
    simulated_unit,
    tail,
)
from anser_ros.errors import ParameterError
from anser_ros.kernel_cache import compile_kernels
from anser_ros.wire.bag_writer import bag_summary
from anser_ros.wire.text_files import config_path

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


def load(path: Path) -> Results:
    with np.load(path, allow_pickle=False) as stored:
        return dict(stored)


def summarise(results: Results) -> dict[str, dict[str, Any]]:
    """Return the errors, rates and latencies of each chain over all its sensors and bodies."""
    from anser_ros.sessions.tracked_session import error_statistics

    chains: dict[str, Any] = {}
    for rank, chain in enumerate(results['chains']):
        error = _joined(results, 'error', rank)
        error = error[np.isfinite(error)]
        stamps = [results[f'stamp_{rank}_{i}'] for i in range(len(results['names']))]
        if not error.size:
            continue
        longest = max(stamps, key=len)
        span = float(longest[-1] - longest[0]) if longest.size > 1 else 0.0
        found = error_statistics('position', 'm', error)
        chains[str(chain) or LIVE] = {
            'poses': int(sum(len(s) for s in stamps)),
            'rate_hz': float((longest.size - 1) / span) if span > 0 else 0.0,
            **{f'position_{name}_m': found[f'position_{name}_m']
               for name in ('rmse', 'prc50', 'prc95')},
            'position_max_m': float(error.max()),
            'latency_prc50_s': float(np.median(_joined(results, 'latency', rank))),
        }  # fmt: skip
    return {'chains': chains}


def draw(results: Results, path: Path) -> None:
    """Write the picture: true and tracked path from above and from the side, error over time."""
    from matplotlib.figure import Figure

    from anser_ros.cli.page import save

    figure = Figure(figsize=(12, 7), layout='constrained')
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.6))
    counts = [len(results[f'stamp_0_{i}']) for i in range(len(results['names']))]
    shown = len(counts) - 1 if counts[-1] else int(np.argmax(counts))  # a body, if it has poses
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


def _chains(results: Results) -> list[tuple[int, str, str]]:
    """Return rank, name and colour of the chains; the live one is last, to be drawn on top."""
    names = [str(name) or LIVE for name in results['chains']]
    return list(zip(range(len(names)), names, COLOURS, strict=False))[::-1]


def broken(stamp_s: Array, values: Array) -> Any:
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
        from scipy.ndimage import median_filter

        at, level = broken(stamp - begin, median_filter(sigma, SMOOTH, mode='nearest'))
        words = 'half to twice the sigma, live'
        axes.fill_between(at, level / 2, 2 * level, color='k', alpha=0.15, lw=0, label=words)
    seen_s, near = results['metal'][:, 0] - begin, results['metal'][:, 1] < METAL_NEAR_M
    if near.any():
        axes.fill_between(
            seen_s, 0, 1, where=near, transform=axes.get_xaxis_transform(), color='tab:red',
            alpha=0.12, lw=0, label='metal near',
        )  # fmt: skip
    axes.set(xlabel='time, s', ylabel='position error, mm', yscale='log')
    axes.set_xlim(0.0, max(end - begin, 1.0))
    axes.grid(alpha=0.3, which='both')


def _joined(results: Results, kind: str, rank: int) -> Array:
    return np.concatenate([results[f'{kind}_{rank}_{i}'] for i in range(len(results['names']))])


SCHEMA = 'anser_demo/1'
METAL_RADIUS_M = 0.1
"""Radius of the steel disc, m: as large as the foot of a stand or the head of a C-arm."""
POLL_S = 0.05
"""Time from one look at the processes to the next, s: an ended node is noticed in it."""
DATA = 'demo.npz'  # the file that the monitor writes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = 'example: anser demo --duration 30'
    words = 'duration, from the first pose on, s'
    parser.add_argument('--duration', type=float, default=30.0, metavar='S', help=words)
    add_out(
        parser, 'a new folder with bag, picture and logs (%(default)s)', required=False,
        default=Path('recordings'), metavar='DIR',
    )  # fmt: skip
    words = 'serve the live view to a browser, too'
    parser.add_argument('--dashboard', action='store_true', help=words)
    add_json(parser, 'only the summary, as JSON')


def run(args: argparse.Namespace) -> int:
    """Run the demo and return the exit code; raises `ParameterError` on what cannot be run."""
    if not 1.0 <= args.duration <= 3600.0:
        raise ParameterError(f'--duration must be 1 to 3600 s, got {args.duration:g}')
    for node in ('recorder', 'dashboard') if args.dashboard else ('recorder',):
        check_packages(node)
    stopped: list[int] = []
    before = {
        number: signal.signal(number, lambda got, _: stopped.append(got))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    is_stated = VARIABLE in os.environ
    try:
        with own_domain(range(LAST_DOMAIN + 1)) as domain:
            if domain and not is_stated:
                _say(f'another demo runs: this one has {VARIABLE}={domain}', args)
            folder = make_new_folder(args.out, time.strftime('demo_%Y%m%d_%H%M%S'))
            return _run_in(folder, args, stopped)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run_in(folder: Path, args: argparse.Namespace, stopped: list[int]) -> int:
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    ports = Path(tempfile.mkdtemp(prefix='anser_demo_'))
    failed = ''
    try:
        with Supervisor(folder / 'logs') as supervisor:
            compile_kernels(lambda text: _say(text, args), lambda: bool(stopped))
            if stopped:
                return _report(folder, args, interrupted=True)
            for name, command in _commands(folder, ports / 'cu', args).items():
                supervisor.start(name, command)
            if args.dashboard:
                _say(f'live view: http://127.0.0.1:{LIVE_VIEW}/', args)
            _say(f'{FROZEN}: {MEANINGS[FROZEN]}', args)
            command = node_command(
                'monitor', duration_s=float(args.duration), patience_s=PATIENCE_S, compare=FROZEN,
                output=folder / DATA,
            )  # fmt: skip
            monitor = supervisor.start('monitor', command, on_terminal=not args.json)
            while not stopped:
                ended = supervisor.ended()
                if ended is not None:
                    if ended is not monitor or monitor.process.returncode:
                        failed = f'{ended.name} ended with {ended.process.returncode}'
                        failed += f'\n{tail(ended)}'
                    break
                time.sleep(POLL_S)
    finally:
        shutil.rmtree(ports, ignore_errors=True)
    if failed:
        print(f'anser demo: {failed}\nlogs: {folder / "logs"}', file=sys.stderr)
        return 1
    return _report(folder, args, interrupted=bool(stopped))


def _say(text: str, args: argparse.Namespace) -> None:
    if not args.json:
        print(text, flush=True)


def _report(folder: Path, args: argparse.Namespace, *, interrupted: bool) -> int:
    """Sum the demo up, and draw its picture unless somebody waits for its end."""
    bag, data = folder / 'bag', folder / DATA
    there = bag.is_dir()
    summary: dict[str, object] = {
        'schema': SCHEMA, 'bag': str(bag) if there else None, 'interrupted': interrupted,
        **(bag_summary(bag) if there else {}),
    }  # fmt: skip
    has_poses = False
    if data.is_file():
        results = load(data)
        figures = summarise(results)
        has_poses = LIVE in figures['chains']
        summary |= figures
        if not interrupted:  # it takes longer than someone who interrupts wants to wait
            draw(results, folder / 'demo.png')
            summary['picture'] = str(folder / 'demo.png')
        if there:
            summary['evaluate'] = (
                f'anser evaluate {bag} --model {config_path("demo_model.yaml")} '
                f'--out {folder / "evaluation"}'
            )
    if args.json:
        print(json.dumps(summary, indent=1))
    else:
        _print(summary)
    if interrupted or not data.is_file() or has_poses:
        return 0
    print('anser demo: the live chain gave no pose; the table says why', file=sys.stderr)
    return 1


def _print(summary: dict[str, object]) -> None:
    chains = summary.get('chains')
    if isinstance(chains, dict):
        for chain, figures in chains.items():
            print(
                f'{chain:>8}: {figures["poses"]} poses at {figures["rate_hz"]:.1f} Hz, '
                f'error RMSE {1e3 * figures["position_rmse_m"]:.2f} mm, '
                f'95 % below {1e3 * figures["position_prc95_m"]:.2f} mm, '
                f'worst {1e3 * figures["position_max_m"]:.2f} mm; '
                f'latency {1e3 * figures["latency_prc50_s"]:.1f} ms from the middle of a window'
            )
            print(f'{"":>8}  ({MEANINGS[chain]})')
    elif summary['interrupted']:
        print('interrupted before the first pose')
    if summary['bag'] is None:
        print(f'{"bag":>8}: none, nothing was recorded')
    else:
        is_whole = 'complete' if summary.get('closed') else 'cut off'
        print(
            f'{"bag":>8}: {summary["bag"]} ({summary.get("duration_s", 0.0):.1f} s, '
            f'{summary.get("messages", 0)} messages, {is_whole})'
        )
    for key in ('picture', 'evaluate'):
        if key in summary:
            print(f'{key:>8}: {summary[key]}')


def _commands(folder: Path, port: Path, args: argparse.Namespace) -> dict[str, list[str]]:
    model = config_path('demo_model.yaml')
    apart = in_namespace(f'/anser/{FROZEN}')
    page = {'dashboard': node_command('dashboard', directory=folder)} if args.dashboard else {}
    return {
        'cu_simulator': simulated_unit(port, metal_radius_m=METAL_RADIUS_M),
        'live': node_command(
            'live', acquisition__device=port, field_model__model_file=model,
            field_model__baseline_at_start=True,
        ),
        'field_model_frozen': node_command('field_model', *apart, model_file=model),
        'tracker_frozen': node_command('tracker', *apart, **FROZEN_TRACKER),
        'recorder': node_command('recorder', directory=folder, name='bag'),
        **page,
    }  # fmt: skip
