"""Runs the loop: an effect in simulated samples is found blind, corrected and measured again."""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from anser_ros.cli import missing
from anser_ros.cli.folders import make_new_folder
from anser_ros.cli.loop_result import parameter_errors, second_run, table, verdict
from anser_ros.cli.loop_run import AFTER, LoopFiles, Run, make_world, record
from anser_ros.cli.output import say_written, write_files
from anser_ros.cli.ros_domain import LAST_DOMAIN, own_domain
from anser_ros.cli.stated_values import add_json, add_out
from anser_ros.cli.warm_up import compile_kernels
from anser_ros.effects.correction import Correction
from anser_ros.errors import DiagnosisError, ParameterError
from anser_ros.sessions.model_file import load_model
from anser_ros.sessions.recorded_health import first_warnings, kept_share, overload
from anser_ros.sessions.session import load_session
from anser_ros.settings import Accuracy
from anser_ros.simulation.effect_draw import CATALOGUE, NONE, RANDOM
from anser_ros.stamps import NANO

SCHEMA = 'anser_loop/1'
ALL = 'all'
CLEAN_S = 6.0
"""Duration of the clean recording, s: 150 frames, whose mean is the references' baseline."""
SECOND_SHARE = 0.6
"""Duration of the second run as a fraction of the first one's."""
OTHER_PATH_RAD = 2.0
"""Phase of the second run's path, rad, so that the correction is tested at other poses."""
LEAST_KEPT = 0.85
"""Fraction of whole frames below which a recording shows the load of the machine rather than the
effect."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.epilog = 'example: anser loop --effect sensor_gain --seed 31'
    known = ', '.join(sorted(CATALOGUE))
    parser.add_argument(
        '--effect', nargs='+', default=[RANDOM], metavar='NAME',
        choices=[RANDOM, ALL, NONE, *sorted(CATALOGUE)],
        help=f'{RANDOM}, {ALL} (one after the other), {NONE}, or some of: {known}',
    )  # fmt: skip
    parser.add_argument('--seed', type=int, help='seed of the effect; random by default')
    parser.add_argument(
        '--duration', type=float, default=30.0, metavar='S', help='duration of the first run'
    )
    parser.add_argument(
        '--clean', type=float, default=CLEAN_S, metavar='S',
        help='duration of the clean recording that is the baseline of the references; 0 for none',
    )  # fmt: skip
    parser.add_argument(
        '--watch', action='store_true', help='also report what the watcher found in the first run'
    )
    add_out(
        parser, 'a new folder with all results (%(default)s)', required=False,
        default=Path('recordings'), metavar='DIR',
    )  # fmt: skip
    add_json(parser, 'only the result, as JSON')


def run(args: argparse.Namespace) -> int:
    """Run the loop and return the exit code.

    Raises `ParameterError` when the duration or the seed is out of range, `DiagnosisError` when a
    run records nothing or a diagnosis fails.
    """
    seed = int(np.random.default_rng().integers(1, 2**31)) if args.seed is None else args.seed
    effects = [*sorted(CATALOGUE), NONE] if ALL in args.effect else list(args.effect)
    _check(args, seed)
    missing.check('recorder')
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    # A ROS system that runs already must neither receive nor be received by what is simulated
    # here.
    ours = os.getpid() % LAST_DOMAIN
    domains = [1 + (ours + k) % LAST_DOMAIN for k in range(LAST_DOMAIN)]
    with own_domain(domains):
        return _run(args, effects, seed)


def _run(args: argparse.Namespace, effects: list[str], seed: int) -> int:
    folder = make_new_folder(args.out, time.strftime('loop_%Y%m%d_%H%M%S'))
    say = Console(stderr=True, highlight=False)
    compile_kernels(say.print)
    world, clean = make_world(folder), None
    if args.clean:
        say.print(f'a clean recording, {args.clean:g} s')
        clean = record(Run(folder / 'clean', world.setup, args.clean))
    rounds: list[dict[str, Any]] = []
    document = {'schema': SCHEMA, 'data': 'simulated', 'folder': str(folder), 'rounds': rounds}
    for count, effect in enumerate(effects):
        say_of = partial(_say_of, say, f'round {count + 1} of {len(effects)}: ')
        found = _round(
            folder / f'{count + 1:02d}', world, clean, effect, seed + count, args.duration,
            args.watch, say_of,
        )  # fmt: skip
        rounds.append(found)
        write_files(folder, {'loop.json': document})
    if args.json:
        print(json.dumps(document, indent=1))
    else:
        table(rounds, Console(width=None if os.isatty(1) else 200))
        say_written(folder)
    return 0


def _say_of(console: Console, where: str, text: str) -> None:
    console.print(where + text)


def _check(args: argparse.Namespace, seed: int) -> None:
    if not 10.0 <= args.duration <= 600.0:
        raise ParameterError(f'--duration must be 10 to 600 s, got {args.duration:g}')
    if args.clean and not 2.0 <= args.clean <= 600.0:
        raise ParameterError(f'--clean must be 0 or 2 to 600 s, got {args.clean:g}')
    if seed < 1:
        raise ParameterError(f'--seed must be at least 1, got {seed}')


def _round(
    folder: Path,
    world: LoopFiles,
    clean: Path | None,
    effect: str,
    seed: int,
    duration_s: float,
    is_watched: bool,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Run the loop for one effect, from the raw samples to the error of the second run."""
    model, truth_file = world.model, folder / 'truth.json'
    folder.mkdir()
    unit = {'effect': effect, 'effect_seed': seed, 'effect_file': truth_file}
    say(f'{duration_s:g} s with an effect that only truth.json knows')
    noisy = {'optical_noise_m': Accuracy.optical_position_m, 'seed': 2}
    watched = None
    if is_watched:
        watched = {'model_file': model} | ({'baseline_file': clean} if clean else {})
    first = record(
        Run(folder / 'first', world.setup, duration_s, {**unit, **noisy}, watched=watched)
    )
    say('diagnosis')
    began_s = time.monotonic()
    diagnosis = _diagnose(first, clean, model, folder / 'diagnosis')
    took_s = time.monotonic() - began_s
    corrected = folder / 'diagnosis' / 'model.yaml'
    second_s = SECOND_SHARE * duration_s
    follows = clean is not None and _drifts(corrected, first)
    say(f'the corrected model is served, {second_s:g} s on another path')
    other = {'path_phase_rad': OTHER_PATH_RAD, 'seed': 3}
    baseline = clean if follows else None
    unit |= other
    second = record(
        Run(folder / 'second', world.setup, second_s, unit, corrected, baseline, model)
    )
    truth = json.loads(truth_file.read_text(encoding='utf-8'))  # not before all is analysed
    return {
        'truth': truth,
        'found': diagnosis['effects'],
        'verdict': verdict(truth, diagnosis),
        'parameters': parameter_errors(truth, diagnosis),
        'unexplained': diagnosis['unexplained'],
        'first_run_held_out': diagnosis['held_out'],
        'second_run_live': second_run(
            load_session(second), load_model(corrected), load_model(model)
        ),
        'follows_references': follows,
        'diagnosis_s': took_s,
        **_recorded(first, second),
    }


def _recorded(first: Path, second: Path) -> dict[str, Any]:
    """Return what the watcher reported in the first run, and how the machine kept up."""
    bags = {'first': first, 'second': second}
    sessions = {name: load_session(bag) for name, bag in bags.items()}
    kept = {name: kept_share(session) for name, session in sessions.items()}
    return {
        'watcher_said_after_s': {
            name: NANO * (warned_ns - sessions['first'].start_ns)
            for name, warned_ns in first_warnings(first, f'{AFTER}/watcher'.strip('/')).items()
        },
        'kept_share': kept,
        'too_busy': min(kept.values()) < LEAST_KEPT,
        'machine': {name: signs for name, bag in bags.items() if (signs := overload(bag))},
    }


def _drifts(model_file: Path, session: Path) -> bool:
    """Return whether a model has effects that vary, so that only references can follow them."""
    model, sensors = load_model(model_file), load_session(session).tools[0].sensors
    return bool(Correction.of(model.effects, sensors, model.frequencies_hz).drifting)


def _diagnose(bag: Path, clean: Path | None, model: Path, out: Path) -> dict[str, Any]:
    """Run the diagnosis in another process, which knows only the bags and the model."""
    command = [
        sys.executable, '-P', '-m', 'anser_ros.cli.main', 'diagnose', str(bag),
        '--model', str(model), '--out', str(out),
    ]  # fmt: skip
    if clean is not None:
        command += ['--baseline', str(clean)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise DiagnosisError(f'the diagnosis failed: {done.stderr.strip()[-500:]}')
    document = json.loads((out / 'diagnosis.json').read_text(encoding='utf-8'))
    assert isinstance(document, dict)
    return document
