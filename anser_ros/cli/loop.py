"""Put a random effect into simulated raw samples, find it blind, correct it, measure again."""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from anser_ros.cli.demo import BOARD_SEED, FROZEN, NO_GATE, SAMPLE_RATE_HZ, SHARED_TOPICS
from anser_ros.cli.demo import node_command as node
from anser_ros.cli.kernels import compile_kernels
from anser_ros.cli.supervisor import Supervisor, tail
from anser_ros.effects.correction import Correction
from anser_ros.errors import AnserError, DiagnosisError, ParameterError
from anser_ros.sessions.model_file import load_model
from anser_ros.sessions.recorded_poses import position_errors
from anser_ros.sessions.session import load_session
from anser_ros.wire.bag import read_bag
from anser_ros.wire.config_folder import config_path

CLEAN_S = 6.0
PATIENCE_S = 180.0
OPTICAL_NOISE_M = 0.07e-3
CHAINS = {'after': '/anser', 'before': f'/anser/{FROZEN}'}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument('--effect', default='random', help='random, or a name of the simulator')
    parser.add_argument('--seed', type=int, help='of the effect; another one every time without')
    parser.add_argument('--duration', type=float, default=30.0, metavar='S', help='of each run')
    parser.add_argument('--out', type=Path, default=Path('recordings'), metavar='DIR')
    parser.add_argument('--json', action='store_true', help='print only the summary, as JSON')


def run(args: argparse.Namespace) -> int:
    """Run the loop; the exit code.

    Raises
    ------
    ParameterError
        When the duration or the seed is out of range.
    DiagnosisError
        When a run records nothing, or the diagnosis fails.
    """
    if not 10.0 <= args.duration <= 600.0:
        raise ParameterError(f'--duration must be 10 to 600 s, got {args.duration:g}')
    seed = int(np.random.default_rng().integers(1, 2**31)) if args.seed is None else args.seed
    if seed < 1:
        raise ParameterError(f'--seed must be at least 1, got {seed}')
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    folder = args.out / time.strftime('loop_%Y%m%d_%H%M%S')
    folder.mkdir(parents=True, exist_ok=True)
    say = Console(stderr=True)
    model = config_path('demo_model.yaml')
    with Supervisor(folder / 'logs') as supervisor:
        failed = compile_kernels(supervisor, say.print, lambda: False)
        if failed is not None:
            raise DiagnosisError(f'no kernels: {tail(failed)}')
    say.print(f'1 of 4: a clean recording, {CLEAN_S:g} s')
    clean = _record(folder / 'clean', CLEAN_S, 'none', seed, model, model)
    say.print(f'2 of 4: {args.duration:g} s with an effect that only truth.json knows')
    first = _record(folder / 'first', args.duration, args.effect, seed, model, model)
    say.print('3 of 4: diagnosis')
    diagnosis = _diagnose(first, clean, model, folder / 'diagnosis')
    corrected = folder / 'diagnosis' / 'model.yaml'
    say.print('4 of 4: the corrected model is served, a second recording')
    second = _record(folder / 'second', args.duration, args.effect, seed, corrected, model)
    summary = _summary(folder, second, corrected, diagnosis)
    (folder / 'loop.json').write_text(json.dumps(summary, indent=1) + '\n', encoding='utf-8')
    if args.json:
        print(json.dumps(summary, indent=1))
    else:
        _show(summary)
    return 0


def _record(
    folder: Path, duration_s: float, effect: str, seed: int, served: Path, known: Path
) -> Path:
    """Run the chain, with a second one that keeps the model known before; the bag's folder."""
    ports = Path(tempfile.mkdtemp(prefix='anser_loop_'))
    apart = ['-r', f'__ns:={CHAINS["before"]}']
    for topic in SHARED_TOPICS:
        apart += ['-r', f'{topic}:=/anser/{topic}']
    commands = {
        'cu_simulator': node(
            'cu_simulator',
            link=ports / 'cu',
            metal=False,
            board_seed=BOARD_SEED,
            sample_rate_hz=SAMPLE_RATE_HZ,
            optical_noise_m=OPTICAL_NOISE_M,
            effect=effect,
            effect_seed=seed,
            effect_file=folder.parent / 'truth.json' if effect != 'none' else '',
            seed=len(folder.name),
        ),
        'acquisition': node('acquisition', device=ports / 'cu', rate_hz=25.0),
        'field_model': node('field_model', model_file=served, refit=False),
        'tracker': node('tracker', model_file=served),
        'field_model_before': node('field_model', *apart, model_file=known, refit=False),
        'tracker_before': node('tracker', *apart, model_file=known, **NO_GATE),
        'recorder': node('recorder', directory=folder, name='bag'),
    }
    bag = folder / 'bag'
    try:
        with Supervisor(folder / 'logs') as supervisor:
            for name, command in commands.items():
                supervisor.start(name, command)
            begin, end = time.monotonic(), None
            while end is None or time.monotonic() < end:
                ended = supervisor.ended()
                if ended is not None:
                    raise DiagnosisError(
                        f'{ended.name} ended with {ended.process.returncode}: {tail(ended)}'
                    )
                if end is None and _has_flux(bag):
                    end = time.monotonic() + duration_s
                if end is None and time.monotonic() - begin > PATIENCE_S:
                    raise DiagnosisError(f'no flux was recorded; logs: {folder / "logs"}')
                time.sleep(0.2)
    finally:
        shutil.rmtree(ports, ignore_errors=True)
    return bag


def _has_flux(bag: Path) -> bool:
    try:
        return read_bag(bag).tool is not None
    except AnserError:
        return False


def _diagnose(bag: Path, clean: Path, model: Path, out: Path) -> dict[str, Any]:
    """Run the diagnosis in a process of its own, which knows the bags and the model alone."""
    command = [
        sys.executable, '-P', '-m', 'anser_ros.cli.main', 'diagnose', str(bag),
        '--model', str(model), '--baseline', str(clean), '--out', str(out),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise DiagnosisError(f'the diagnosis failed: {done.stderr.strip()[-500:]}')
    document = json.loads((out / 'diagnosis.json').read_text(encoding='utf-8'))
    assert isinstance(document, dict)
    return document


def _summary(
    folder: Path, second: Path, corrected: Path, diagnosis: dict[str, Any]
) -> dict[str, Any]:
    """What was put in, what was found, and the live errors of the second run, in one document."""
    session, model = load_session(second), load_model(corrected)
    correction = Correction.of(model.effects, session.tools[0].sensors, model.frequencies_hz)
    errors = position_errors(session, CHAINS, correction)
    figures = {
        name: {
            'poses': int(error.size),
            'position_rmse_m': float(np.sqrt(np.mean(error**2))) if error.size else None,
            'position_prc95_m': float(np.percentile(error, 95)) if error.size else None,
        }
        for name, error in errors.items()
    }
    truth = json.loads((folder / 'truth.json').read_text(encoding='utf-8'))
    return {
        'data': 'simulated',
        'truth': truth,
        'found': [
            {'name': effect['name'], 'parameters': effect['parameters']}
            for effect in diagnosis['effects']
        ],
        'unexplained': diagnosis['unexplained'],
        'first_run_held_out': diagnosis['held_out'],
        'second_run_live': figures,
        'folder': str(folder),
    }


def _show(summary: dict[str, Any]) -> None:
    table = Table('', 'poses', 'RMSE mm', 'PRC95 mm', title='second run, live (simulated)')
    for name in ('before', 'after'):
        row = summary['second_run_live'][name]
        cells = [
            '-' if row[key] is None else f'{1e3 * row[key]:.3f}'
            for key in ('position_rmse_m', 'position_prc95_m')
        ]
        table.add_row(name, str(row['poses']), *cells)
    console = Console()
    console.print(table)
    print(f'put in: {json.dumps(summary["truth"])}')
    for effect in summary['found']:
        print(f' found: {json.dumps(effect)}')
    if not summary['found']:
        print(' found: no effect of the catalogue')
    print(f'unexplained: {json.dumps(summary["unexplained"])}')
    print(f'folder: {summary["folder"]}')
