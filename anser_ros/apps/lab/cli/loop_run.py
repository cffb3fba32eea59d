"""Runs a loop once with simulated control unit, acquisition, trackers and recorder."""

import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from anser_ros.cli.demo import FROZEN_TRACKER, PATIENCE_S, in_namespace, simulated_unit
from anser_ros.cli.demo import node_command as node
from anser_ros.cli.processes import Supervisor, tail
from anser_ros.errors import AnserError, DiagnosisError, SetupError
from anser_ros.sessions.recorded_health import last_words
from anser_ros.sessions.starting_model import load_model, save_model
from anser_ros.wire.bag import read_bag
from anser_ros.wire.setup import dump_setup, parse_setup
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

    The field without metal does not depend on the tones, so that the model stays right.

    Raises `SetupError` when the demo's setup has another number of coils than there are tones.
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
    watched: Mapping[str, object] | None = None  # parameters of a watcher; none without them


def record(run: Run) -> Path:
    """Record a run and return the folder of its bag.

    The unit is started once all nodes are ready: drifts begin with its first start, which is then
    the first frame of the recording and of every tracker.

    Raises `DiagnosisError` when a process ends, or no flux arrives in time.
    """
    ports = Path(tempfile.mkdtemp(prefix='anser_loop_'))
    bag = run.folder / 'bag'
    try:
        with Supervisor(run.folder / 'logs') as supervisor:
            for name, command in _commands(run, ports / 'cu').items():
                supervisor.start(name, command)
            listeners = [f'{AFTER}/acquisition', f'{AFTER}/recorder']
            listeners += [f'{AFTER}/tracker'] if run.served is not None else []
            listeners += [f'{AFTER}/watcher'] if run.watched is not None else []
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
    if run.watched is not None:
        commands['watcher'] = node('watcher', **run.watched)
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
