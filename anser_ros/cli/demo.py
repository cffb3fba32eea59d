"""Runs the demo: all nodes track a simulated tool, with a table, a bag and a picture.

Two chains of field model and tracker run side by side: one refits its model to the reference
coils, the other keeps the model as calibrated. A steel disc comes from below and leaves again.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path

from anser_ros.cli import missing
from anser_ros.cli.demo_report import FROZEN, LIVE, MEANINGS, draw, load, summarise
from anser_ros.cli.folders import make_new_folder
from anser_ros.cli.ros_domain import LAST_DOMAIN, VARIABLE, own_domain
from anser_ros.cli.stated_values import add_json, add_out
from anser_ros.cli.supervisor import Supervisor, tail
from anser_ros.cli.warm_up import compile_kernels
from anser_ros.errors import ParameterError
from anser_ros.tracking.estimate import NO_GATE
from anser_ros.wire.bag_metadata import bag_summary
from anser_ros.wire.config_folder import config_path
from anser_ros.wire.tcp_ports import LIVE_VIEW

SCHEMA = 'anser_demo/1'
PATIENCE_S = 180.0
"""Longest wait for all nodes and the first pose, s; kernels may have to be compiled meanwhile."""
# The board of the bags in bags/, from which config/demo_model.yaml is calibrated:
# anser calibrate bags/scan.mcap --out config/demo_model.yaml
BOARD_SEED = 1
# Half the usual rate, so that all processes together fit on two cores.
SAMPLE_RATE_HZ = 20e3
METAL_RADIUS_M = 0.1
"""Radius of the steel disc, m: as large as the foot of a stand or the head of a C-arm."""
# The frozen chain shows the poses of a tracker without residual gate. With one it would withhold
# them near metal, and nobody would see the error that the refit avoids.
FROZEN_TRACKER = {'gate': NO_GATE, 'adaptive': False}
POLL_S = 0.05
"""Time from one look at the processes to the next, s: an ended node is noticed in it."""
# The file that the monitor writes.
DATA = 'demo.npz'
SHARED_TOPICS = ('setup', 'tool/flux', 'reference/flux')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command line of the demo."""
    parser.epilog = 'example: anser demo --duration 30'
    words = 'duration, from the first pose on, s'
    parser.add_argument('--duration', type=float, default=30.0, metavar='S', help=words)
    add_out(
        parser, 'a new folder with bag, picture and logs (%(default)s)', required=False,
        default=Path('recordings'), metavar='DIR',
    )  # fmt: skip
    parser.add_argument('--rate', type=float, default=50.0, metavar='HZ', help='poses a second')
    words = 'serve the live view to a browser, too'
    parser.add_argument('--dashboard', action='store_true', help=words)
    parser.add_argument('--no-metal', action='store_true', help='simulate no steel disc')
    parser.add_argument('--no-picture', action='store_true', help='draw no picture at the end')
    words = 'only draw the picture of an interrupted demo, from the folder of its results'
    parser.add_argument('--draw', type=Path, metavar='DIR', help=words)
    add_json(parser, 'only the summary, as JSON')


def run(args: argparse.Namespace) -> int:
    """Run the demo and return the exit code.

    Raises `ParameterError` when the duration or the rate is out of range, the folder to draw from
    has no demo, or another demo has the stated ROS domain.
    """
    if args.draw is not None:
        if not (args.draw / DATA).is_file():
            raise ParameterError(f'{args.draw} holds no {DATA} of a demo that showed poses')
        return _report(args.draw, args, interrupted=False)
    if not 1.0 <= args.duration <= 3600.0:
        raise ParameterError(f'--duration must be 1 to 3600 s, got {args.duration:g}')
    if not 1.0 <= args.rate <= 200.0:
        raise ParameterError(f'--rate must be 1 to 200 Hz, got {args.rate:g}')
    missing.check('dashboard' if args.dashboard else 'recorder')
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
            monitor = supervisor.start(
                'monitor', _monitor(folder / DATA, args), on_terminal=not args.json
            )
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
        if interrupted:  # drawing takes longer than someone who interrupts wants to wait
            summary['draw'] = f'anser demo --draw {folder}'
        elif not args.no_picture:
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
    if interrupted or args.draw or not data.is_file() or has_poses:
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
    for key in ('picture', 'draw', 'evaluate'):
        if key in summary:
            print(f'{key:>8}: {summary[key]}')


def node_command(name: str, /, *words: str, **parameters: object) -> list[str]:
    """Return the command line of a node, with further ROS arguments and its parameters.

    ``NODE__NAME`` is a parameter of one of several nodes in one process.
    """
    command = [sys.executable, '-P', '-m', f'anser_ros.nodes.{name}', '--ros-args', *words]
    for key, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        command += ['-p', f'{key.replace("__", ":")}:={text}']
    return command


def in_namespace(namespace: str) -> list[str]:
    """Return the ROS arguments of a node beside the others, which takes their setup and fluxes."""
    remaps = [f'{topic}:=/anser/{topic}' for topic in SHARED_TOPICS]
    return [word for remap in (f'__ns:={namespace}', *remaps) for word in ('-r', remap)]


def simulated_unit(port: Path, **parameters: object) -> list[str]:
    """Return the command line of the simulated control unit."""
    return node_command(
        'cu_simulator', link=port, board_seed=BOARD_SEED, sample_rate_hz=SAMPLE_RATE_HZ,
        **parameters,
    )  # fmt: skip


def _commands(folder: Path, port: Path, args: argparse.Namespace) -> dict[str, list[str]]:
    """The command line of each process by its name."""
    model = config_path('demo_model.yaml')
    apart = in_namespace(f'/anser/{FROZEN}')
    commands = {
        'cu_simulator': simulated_unit(
            port, metal=not args.no_metal, metal_radius_m=METAL_RADIUS_M
        ),
        'live': node_command(
            'live', acquisition__device=port, acquisition__rate_hz=float(args.rate),
            field_model__model_file=model, field_model__baseline_at_start=True,
        ),
        'field_model_frozen': node_command('field_model', *apart, model_file=model),
        'tracker_frozen': node_command('tracker', *apart, **FROZEN_TRACKER),
        'recorder': node_command('recorder', directory=folder, name='bag'),
    }  # fmt: skip
    if args.dashboard:
        commands['dashboard'] = node_command('dashboard', directory=folder, port=LIVE_VIEW)
    return commands


def _monitor(data: Path, args: argparse.Namespace) -> list[str]:
    return node_command(
        'monitor',
        duration_s=float(args.duration),
        patience_s=PATIENCE_S,
        compare=FROZEN,
        compare_note=f'"{MEANINGS[FROZEN]}"',  # quoted: a colon has a meaning to ROS
        output=data,
    )
