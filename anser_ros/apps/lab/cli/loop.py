"""Runs the loop: an effect in simulated samples is found blind, corrected and measured again. A
run (`record`) starts a simulated control unit, acquisition, trackers and a recorder.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array
from anser_ros.cli.main import check_packages
from anser_ros.cli.output import add_json, add_out, make_new_folder, say_written, write_files
from anser_ros.cli.processes import (
    FROZEN_TRACKER,
    LAST_DOMAIN,
    PATIENCE_S,
    Supervisor,
    in_namespace,
    own_domain,
    simulated_unit,
    tail,
)
from anser_ros.cli.processes import node_command as node
from anser_ros.effects.correction import Correction
from anser_ros.errors import AnserError, BagError, DiagnosisError, ParameterError, SetupError
from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.kernel_cache import compile_kernels
from anser_ros.physics.constants import DEGREES
from anser_ros.physics.rotations import axis_angles, rotation_angles
from anser_ros.pose_states import FRAMES_IN, OK
from anser_ros.sessions.prepared import PreparedSession, prepare, with_truth
from anser_ros.sessions.session import Session, load_session
from anser_ros.sessions.starting_model import load_model, save_model
from anser_ros.sessions.tracked_session import error_statistics
from anser_ros.settings import Accuracy
from anser_ros.simulation.effects import CATALOGUE, NONE, RANDOM
from anser_ros.stamps import NANO
from anser_ros.wire.bag import MessageDecoder, Salvage, iter_messages, published_poses, read_bag
from anser_ros.wire.recorded import PoseStream
from anser_ros.wire.setup import dump_setup, parse_setup, topic_of
from anser_ros.wire.text_files import config_path, read_config

POLL_S = 0.2
"""Time from one look at the processes to the next, s; a run takes tens of seconds."""
RATE_HZ = 25.0
"""Rate of the fluxes, Hz; low enough for all processes together on two cores."""
AFTER, BEFORE, UNGATED = '/anser', '/anser/before', '/anser/ungated'
"""Namespaces of the trackers: with the corrected model, with the model as it was, and with the
latter without residual gate, whose error shows what the gate withholds."""

TONES_HZ = tuple(5025.0 + 100.0 * mark for mark in (0, 1, 4, 9, 15, 22, 32, 34))
"""Drive tones, Hz, at the marks of a Golomb ruler (no two pairs are equally far apart) in steps of
100 Hz. Where a channel compresses, the third-order products of the tones, also those that the
converter's rate of 20 kHz folds back, then fall between the tones, whole cycles of a 20 ms window
away."""


class LoopFiles(NamedTuple):
    """The files of setup and uncorrected model, which all runs of a loop share."""

    setup: Path
    model: Path


def make_world(folder: Path) -> LoopFiles:
    """Write the demo's setup and model with the loop's tones.

    The field without metal does not depend on the tones, so that the model stays right. Raises
    `SetupError` when the demo's setup has another number of coils than there are tones.
    """
    setup = parse_setup(read_config('demo_setup.yaml'))
    if len(setup.emitter.coils) != len(TONES_HZ):
        raise SetupError(f'the loop has {len(TONES_HZ)} tones, the setup another number of coils')
    coils = tuple(
        replace(coil, frequency_hz=tone)
        for coil, tone in zip(setup.emitter.coils, TONES_HZ, strict=True)
    )
    world = LoopFiles(folder / 'setup.yaml', folder / 'model.yaml')
    changed = replace(setup, emitter=replace(setup.emitter, coils=coils))
    world.setup.write_text(dump_setup(changed), encoding='utf-8')
    model = load_model(config_path('demo_model.yaml'))
    save_model(world.model, replace(model, frequencies_hz=TONES_HZ))
    return world


@dataclass(frozen=True)
class Run:
    """Holds the settings of one run: what is simulated, and which nodes track it."""

    folder: Path  # for the bag and the logs
    setup: Path  # of the unit and of all nodes
    duration_s: float  # from the first flux on
    unit: Mapping[str, object] = field(default_factory=dict)  # parameters of the simulated unit
    served: Path | None = None  # model whose poses are judged; no tracker in its chain without it
    baseline: Path | None = None  # clean recording; with it the model follows the references
    known: Path | None = None  # uncorrected model of the trackers beside; none without it


def record(run: Run) -> Path:
    """Record a run and return the folder of its bag.

    The unit is started once all nodes are ready: drifts begin with its first start, which is then
    the first frame of the recording and of every tracker. Raises `DiagnosisError` when a process
    ends, or no flux arrives in time.
    """
    ports = Path(tempfile.mkdtemp(prefix='anser_loop_'))
    bag = run.folder / 'bag'
    try:
        with Supervisor(run.folder / 'logs') as supervisor:
            commands = _commands(run, ports / 'cu')
            for name, command in commands.items():
                supervisor.start(name, command)
            ours = ('acquisition', 'recorder', 'tracker')
            listeners = [f'{AFTER}/{name}' for name in ours if name in commands]
            listeners += [f'{apart}/tracker' for apart in _beside(run)]
            _wait(supervisor, run, lambda: _unready(bag, listeners))
            unit = simulated_unit(ports / 'cu', setup_file=run.setup, metal=False, **run.unit)
            supervisor.start('cu_simulator', unit)
            _wait(supervisor, run, lambda: _without_flux(bag))
            end = time.monotonic() + run.duration_s
            while time.monotonic() < end:
                _check(supervisor)
                time.sleep(POLL_S)
    finally:
        shutil.rmtree(ports, ignore_errors=True)
    return bag


def _commands(run: Run, port: Path) -> dict[str, list[str]]:
    commands = {
        'acquisition': node('acquisition', device=port, setup_file=run.setup, rate_hz=RATE_HZ),
        'recorder': node('recorder', directory=run.folder, name='bag'),
    }
    if run.served is not None:
        follows: dict[str, object] = {'refit': False}
        if run.baseline is not None:
            follows = {'refit': True, 'baseline_file': run.baseline}
        commands['field_model'] = node('field_model', model_file=run.served, **follows)
        commands['tracker'] = node('tracker', model_file=run.served)
    for namespace, settings in _beside(run).items():
        name = f'tracker_{namespace.rsplit("/", 1)[-1]}'
        beside = in_namespace(namespace)
        commands[name] = node('tracker', *beside, model_file=run.known, **settings)
    return commands


def _beside(run: Run) -> dict[str, dict[str, object]]:
    """Return the namespaces and settings of the trackers with the uncorrected model."""
    return {} if run.known is None else {BEFORE: {}, UNGATED: dict(FROZEN_TRACKER)}


def _wait(supervisor: Supervisor, run: Run, missing: Callable[[], str]) -> None:
    """Wait until nothing is missing any more."""
    end = time.monotonic() + PATIENCE_S
    while what := missing():
        _check(supervisor)
        if time.monotonic() > end:
            raise DiagnosisError(f'{what} after {PATIENCE_S:g} s; logs: {run.folder / "logs"}')
        time.sleep(POLL_S)


def _check(supervisor: Supervisor) -> None:
    ended = supervisor.ended()
    if ended is not None:
        raise DiagnosisError(f'{ended.name} ended with {ended.process.returncode}: {tail(ended)}')


def _unready(bag: Path, names: Sequence[str]) -> str:
    """Return a message with the nodes that have not reported, or that lack a model."""
    reported = last_words(bag)
    missing = [
        name.strip('/')
        for name in names
        if name.strip('/') not in reported
        or ('tracker' in name and 'dipoles' not in reported[name.strip('/')])
    ]
    return f'{", ".join(missing)} not ready' if missing else ''


def _without_flux(bag: Path) -> str:
    try:
        return '' if read_bag(bag).tool is not None else 'no tool flux was recorded'
    except AnserError as error:
        return f'nothing was recorded: {error}'


def live_errors(prepared: PreparedSession, namespace: str) -> tuple[Array, Array]:
    """Return errors (n,), m and rad, of all poses that the tracker of a namespace published.

    They are those of a coil's place and axis, and of a body's place and turn.
    The recording has optical poses, and is prepared with the tracker's model, whose corrections of
    the clock, the optical frame and the sensors are made. Raises `BagError` when the recording has
    no optical poses.
    """
    session = prepared.session
    names = [name for tool in session.tools for name in (*tool.sensors.name, tool.body)]
    topics = {name: f'{namespace}/{topic_of(name)}/pose' for name in names}
    received = published_poses(session.path, list(topics.values()))
    errors = []
    for tool in session.tools:
        true = with_truth(tool, prepared.correction)
        for column, name in (*enumerate(tool.sensors.name), (None, tool.body)):
            errors.append(_compared(session, true, received[topics[name]], column))
    position, orientation = map(np.concatenate, zip(*errors, strict=True))
    return position, orientation


def _compared(
    session: Session, tool: Measurements, poses: PoseStream, column: int | None
) -> tuple[Array, Array]:
    """Errors of one sensor (by its column), or of the body."""
    if tool.track is None:
        raise BagError(f'{session.path}: no optical poses of {tool.body}')
    time = np.asarray((poses.stamp_ns - session.start_ns) * NANO, dtype=np.float64)
    position, rotation, valid = tool.track.at(time)
    if not valid.any():
        return np.zeros(0), np.zeros(0)
    turned = Rotation.from_quat(poses.quaternion[valid]).as_matrix()
    if column is None:
        truth = position[valid]
        turn = rotation_angles(rotation[valid].transpose(0, 2, 1) @ turned)
    else:
        centres, axes = tool.sensors.placed(position[valid], rotation[valid])
        truth = centres[:, column]
        turn = axis_angles(turned[:, :, 2], axes[:, column])
    return np.linalg.norm(poses.position[valid] - truth, axis=1), turn


TOPIC = '/diagnostics'


def last_words(path: str | os.PathLike[str]) -> dict[str, Mapping[str, str]]:
    """Return the last values of every status by its name.

    A bag without diagnostics, or one that cannot be read yet, gives an empty mapping.
    """
    decoder = MessageDecoder()
    words: dict[str, Mapping[str, str]] = {}
    try:
        for raw in iter_messages(path, Salvage()):
            if raw.topic == TOPIC:
                for status in decoder.decode(raw).status:
                    words[status.name] = {item.key: item.value for item in status.values}
    except BagError:
        return {}
    return words


def ok_share(words: Mapping[str, Mapping[str, str]], tracker: str) -> float:
    """Return the share of poses in state ok among all that a tracker judged; 0 if it judged none.

    Frames that it never saw, because the machine was too slow for them, do not count. The statuses
    of its sensors and bodies, of `last_words`, are named ``NODE: SENSOR``.
    """
    ok = judged = 0
    for name, values in words.items():
        if name.startswith(f'{tracker}: '):
            counts = {key: int(n) for key, n in values.items() if key.startswith(FRAMES_IN)}
            ok += counts.get(f'{FRAMES_IN}{OK}', 0)
            judged += sum(counts.values())
    return ok / judged if judged else 0.0


def kept_share(session: Session) -> float:
    """Return the share of frames with tool readings, of those that their period lets expect."""
    shares = [0.0]
    for tool in session.tools:
        if tool.time.size > 1:
            period = float(np.median(np.diff(tool.time)))
            expected = 1 + round(float(tool.time[-1] - tool.time[0]) / period)
            shares.append(float(np.any(tool.valid, axis=1).sum()) / expected)
    return min(1.0, max(shares))


NAMED, PARTLY, UNEXPLAINED = 'named', 'named in part', 'said unexplained'
MISSED, WRONG = 'missed', 'wrong name'
SITES = ('channel', 'channels', 'coil', 'coils')
TRACKERS = ('ungated', 'before', 'after')
LIVE_FIGURES = (
    'position_rmse_m', 'position_prc95_m', 'orientation_rmse_rad', 'orientation_prc95_rad',
)  # fmt: skip


def verdict(truth: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> str:
    """Return how right a diagnosis is; empty for a clean run that was found clean.

    An effect that the diagnosis knows must be named, at its site, and nothing else. One that it
    does not know must be reported as unexplained: completely, or in part among other names.

    ``truth`` has name, parameters and answers of the effect that was put in, ``diagnosis`` is the
    document of the diagnosis.
    """
    names = [effect['name'] for effect in diagnosis['effects']]
    unexplained = diagnosis['unexplained']['fraction'] > 0.0
    answers = list(truth['answers'])
    if truth['name'] == 'none':
        return WRONG if names else ''
    if answers and names and set(names) <= set(answers):
        put_in = truth['parameters']
        same = all(
            effect['parameters'].get(key, put_in[key]) == put_in[key]
            for effect in diagnosis['effects']
            for key in SITES
            if key in put_in
        )
        return NAMED if same else WRONG
    if not names:
        return UNEXPLAINED if unexplained else MISSED
    return PARTLY if unexplained and not answers else WRONG


def parameter_errors(truth: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> dict[str, Any]:
    """Return each parameter that truth and finding share, with its error and standard deviation.

    The error of a list is its largest difference, that of a position the distance.
    """
    out: dict[str, Any] = {}
    for effect in diagnosis['effects']:
        if effect['name'] not in truth['answers']:
            continue
        for key, put_in in truth['parameters'].items():
            found = effect['parameters'].get(key)
            if key in SITES or found is None or np.shape(found) != np.shape(put_in):
                continue
            difference = np.asarray(found, float) - np.asarray(put_in, float)
            size = np.linalg.norm if key == 'position_m' else lambda d: np.abs(d).max()
            out[key] = {
                'put_in': put_in,
                'found': found,
                'error': float(size(difference)),
                'sigma': effect['uncertainty'].get(key),
            }
    return out


def second_run(session: Session, corrected: FieldModel, known: FieldModel) -> dict[str, Any]:
    """Return each tracker's live errors over all sensors and bodies, and its share of poses.

    A tracker with a wrong model withholds the poses that its gate catches, so that its error must
    be judged together with the share of poses that it published of those that it judged;
    `ungated` has the withheld poses as well.
    """
    figures, words = {}, last_words(session.path)
    for name, namespace, model in (
        ('ungated', UNGATED, known), ('before', BEFORE, known), ('after', AFTER, corrected)
    ):  # fmt: skip
        share = ok_share(words, f'{namespace}/tracker'.strip('/'))
        place, turn = live_errors(prepare(session, model), namespace)
        found = error_statistics('position', 'm', place)
        found |= error_statistics('orientation', 'rad', turn)
        figures[name] = {'published_share': share, **{key: found[key] for key in LIVE_FIGURES}}
    return figures


def table(rounds: list[dict[str, Any]], console: Console) -> None:
    """Print a line for every round."""
    out = Table(title='live error of the second run, on another path (simulated)')
    for heading in ('put in', 'found', 'verdict', 'parameters'):
        out.add_column(heading, overflow='fold')
    for heading in ('no gate\nmm', 'before\nmm', 'after\nmm', 'before\ndeg', 'after\ndeg'):
        out.add_column(heading, justify='right')
    for heading in ('published\nbefore', 'published\nafter', 'unexplained'):
        out.add_column(heading, justify='right')
    for one in rounds:
        live, hidden = one['second_run_live'], one['too_busy']
        out.add_row(
            one['truth']['name'],
            ', '.join(effect['name'] for effect in one['found']) or '-',
            'machine too busy' if hidden else one['verdict'],
            '\n'.join(_parameter(key, value) for key, value in one['parameters'].items()),
            *(_number(live[n]['position_rmse_m'], 1e3, hidden) for n in TRACKERS),
            *(_number(live[n]['orientation_rmse_rad'], DEGREES, hidden) for n in TRACKERS[1:]),
            *(f'{100 * live[n]["published_share"]:.1f} %' for n in TRACKERS[1:]),
            f'{100 * one["unexplained"]["fraction"]:.2g} %',
        )
    console.print(out)


def _number(value: float | None, scale: float, hidden: bool) -> str:
    return '-' if value is None or hidden else f'{scale * value:.3f}'


def _parameter(key: str, value: Mapping[str, Any]) -> str:
    error, sigma = value['error'], value['sigma']
    if np.ndim(value['found']):
        return f'{key}: off by {error:.2g}'
    text = f'{key}: {value["put_in"]:.5g} put in, {value["found"]:.5g} found'
    return text + (f' (1 sigma {sigma:.1g})' if isinstance(sigma, float) else '')


SCHEMA = 'anser_loop/1'
ALL = 'all'
CLEAN_S = 6.0
"""Duration of the clean recording, s: 150 frames, whose mean is the references' baseline."""
SECOND_SHARE = 0.6
"""Duration of the second run as a fraction of the first one's."""
OTHER_PATH_RAD = 2.0
"""Phase of the second run's path, rad, so that the correction is tested at other poses."""
LEAST_KEPT = 0.85
"""Fraction of whole frames below which a recording shows the load of the machine instead."""


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
    if not 10.0 <= args.duration <= 600.0:
        raise ParameterError(f'--duration must be 10 to 600 s, got {args.duration:g}')
    if seed < 1:
        raise ParameterError(f'--seed must be at least 1, got {seed}')
    check_packages('recorder')
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
    world = make_world(folder)
    say.print(f'a clean recording, {CLEAN_S:g} s')
    clean = record(Run(folder / 'clean', world.setup, CLEAN_S))
    rounds: list[dict[str, Any]] = []
    document = {'schema': SCHEMA, 'data': 'simulated', 'folder': str(folder), 'rounds': rounds}
    for count, effect in enumerate(effects):
        where = f'round {count + 1} of {len(effects)}:'
        found = _round(
            folder / f'{count + 1:02d}', world, clean, effect, seed + count, args,
            partial(say.print, where),
        )  # fmt: skip
        rounds.append(found)
        write_files(folder, {'loop.json': document})
    if args.json:
        print(json.dumps(document, indent=1))
    else:
        table(rounds, Console(width=None if os.isatty(1) else 200))
        say_written(folder)
    return 0


def _round(
    folder: Path,
    world: LoopFiles,
    clean: Path,
    effect: str,
    seed: int,
    args: argparse.Namespace,
    say: Callable[[str], None],
) -> dict[str, Any]:
    """Run the loop for one effect, from the raw samples to the error of the second run."""
    model, truth_file, duration_s = world.model, folder / 'truth.json', args.duration
    folder.mkdir()
    unit = {'effect': effect, 'effect_seed': seed, 'effect_file': truth_file}
    say(f'{duration_s:g} s with an effect that only truth.json knows')
    noisy = {'optical_noise_m': Accuracy.optical_position_m, 'seed': 2}
    first = record(Run(folder / 'first', world.setup, duration_s, unit | noisy))
    say('diagnosis')
    began_s = time.monotonic()
    diagnosis = _diagnose(first, clean, model, folder / 'diagnosis')
    took_s = time.monotonic() - began_s
    corrected = folder / 'diagnosis' / 'model.yaml'
    second_s = SECOND_SHARE * duration_s
    served, sensors = load_model(corrected), load_session(first).tools[0].sensors
    # Only references can follow effects that vary.
    follows = bool(Correction.of(served.effects, sensors, served.frequencies_hz).drifting)
    say(f'the corrected model is served, {second_s:g} s on another path')
    unit |= {'path_phase_rad': OTHER_PATH_RAD, 'seed': 3}
    baseline = clean if follows else None
    second = record(
        Run(folder / 'second', world.setup, second_s, unit, corrected, baseline, model)
    )
    runs = {'first': load_session(first), 'second': load_session(second)}
    kept = {name: kept_share(session) for name, session in runs.items()}
    truth = json.loads(truth_file.read_text(encoding='utf-8'))  # not before all is analysed
    return {
        'truth': truth,
        'found': diagnosis['effects'],
        'verdict': verdict(truth, diagnosis),
        'parameters': parameter_errors(truth, diagnosis),
        'unexplained': diagnosis['unexplained'],
        'first_run_held_out': diagnosis['held_out'],
        'second_run_live': second_run(runs['second'], load_model(corrected), load_model(model)),
        'follows_references': follows,
        'diagnosis_s': took_s,
        'kept_share': kept,
        'too_busy': min(kept.values()) < LEAST_KEPT,
    }


def _diagnose(bag: Path, clean: Path, model: Path, out: Path) -> dict[str, Any]:
    """Run the diagnosis in another process, which knows only the bags and the model."""
    command = [
        sys.executable, '-P', '-m', 'anser_ros.cli.main', 'diagnose', str(bag),
        '--model', str(model), '--out', str(out), '--baseline', str(clean),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise DiagnosisError(f'the diagnosis failed: {done.stderr.strip()[-500:]}')
    document = json.loads((out / 'diagnosis.json').read_text(encoding='utf-8'))
    assert isinstance(document, dict)
    return document
