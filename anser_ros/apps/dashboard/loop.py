"""Lets a person close the loop on the page: record, diagnose, load the better model, or undo.

All that is read and written lies in the folder of recordings; commands of the package run as
processes of their own, whose progress is read.
"""

import asyncio
import contextlib
import functools
import json
import math
import os
import re
import signal
import sys
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from anser_ros.cli.diagnosis_words import verdict
from anser_ros.cli.output import make_new_folder
from anser_ros.errors import AnserError, BagError, ParameterError
from anser_ros.physics.constants import DEGREES
from anser_ros.wire.text_files import NOMINAL

if TYPE_CHECKING:  # the loop itself needs no ROS
    from anser_ros.apps.dashboard.nodes.dashboard import ChainClient
    from anser_ros.apps.dashboard.nodes.view_source import ViewSource

RESULTS = 'results'
"""Folder inside it, in which every calibration and diagnosis gets a folder of its own."""
SHOWN_FILES = (
    'report.html', 'choice.png', 'populations.png', 'calibration.json', 'diagnosis.json',
)  # fmt: skip
"""Files of a result that a browser may ask for."""
MOST = 100
"""Recordings that are offered, the newest: more is no list to choose from."""


class RecordingFolder:
    """Finds recordings and results by their names; no name leads out of the folder.

    The folder need not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.expanduser().resolve()

    def trouble(self) -> str:
        """Return why nothing can be written there, in words; empty where it can."""
        place = self.path
        while not place.exists():
            place = place.parent
        if not place.is_dir():
            return f'{place} is no folder'
        return '' if os.access(place, os.W_OK | os.X_OK) else f'no permission to write {place}'

    def recordings(self) -> list[str]:
        """Return names of the bags, the newest first."""
        if not self.path.is_dir():
            return []
        bags = [entry for entry in self.path.iterdir() if _is_bag(entry)]
        bags.sort(key=lambda entry: entry.stat().st_mtime, reverse=True)
        return [entry.name for entry in bags[:MOST]]

    def recording(self, name: str) -> Path:
        """Return the path of a bag.

        Raises `BagError` when the folder has no bag of that name.
        """
        path = self.path / name
        if Path(name).name != name or not _is_bag(path):
            raise BagError(f'{self.path} holds no recording {name!r}')
        return path

    def new_result(self, kind: str, recording: str) -> Path:
        return make_new_folder(self.path / RESULTS, f'{Path(recording).stem}_{kind}')

    def shown(self, result: str, name: str) -> Path | None:
        """Return the path of a result's file that may be shown, None where there is none."""
        path = self.path / RESULTS / result / name
        is_inside = Path(result).name == result and result not in ('.', '..')
        if not is_inside or name not in SHOWN_FILES or path.is_symlink() or not path.is_file():
            return None
        return path


def _is_bag(path: Path) -> bool:
    if path.is_symlink():
        return False
    if path.is_dir():
        return any(path.glob('*.mcap'))
    return path.suffix == '.mcap' and path.is_file()


NICE = 10
"""Niceness of commands: poses go before a diagnosis."""
PERCENT = re.compile(r'(\d+)%')


class Job:
    """Runs a command once.

    What it prints goes to ``output.txt`` in the folder of its results. ``exit_code`` is None while
    it runs; ``share`` is how much is done, 0 to 1, and NaN where it does not say.
    """

    def __init__(self, kind: str, arguments: Sequence[str], folder: Path) -> None:
        self.kind, self.folder = kind, folder
        self._arguments = [str(argument) for argument in arguments]
        self.exit_code: int | None = None
        self.share, self.stage = math.nan, ''
        self._last_line = ''
        self._began_s, self._took_s = time.monotonic(), math.nan
        self._process: asyncio.subprocess.Process | None = None
        self._is_ended = False

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._began_s if math.isnan(self._took_s) else self._took_s

    @property
    def failure(self) -> str:
        """Return why it failed, in a line; empty while it runs and when it did not."""
        if self.exit_code in (None, 0):
            return ''
        if self._is_ended:
            return f'{self.kind} was cancelled'
        return self._last_line or f'{self.kind} ended with {self.exit_code}'

    async def run(self) -> None:
        command = [sys.executable, '-P', '-m', 'anser_ros.cli.main', self.kind, *self._arguments]
        with (self.folder / 'output.txt').open('wb') as output:
            self._process = await asyncio.create_subprocess_exec(
                'nice', '-n', str(NICE), *command, stdin=asyncio.subprocess.DEVNULL,
                stdout=output, stderr=asyncio.subprocess.PIPE, start_new_session=True,
            )  # fmt: skip
        try:
            await self._listen(self._process.stderr)
            code = await self._process.wait()
        finally:
            self.end()
            self._took_s = time.monotonic() - self._began_s
        self.exit_code = code

    async def _listen(self, stream: asyncio.StreamReader | None) -> None:
        while stream is not None:
            try:
                line = await stream.readline()
            except ValueError:  # longer than a line may be
                continue
            if not line:
                return
            self.take_line(line.decode(errors='replace').strip())

    def take_line(self, line: str) -> None:
        """Take a line of progress, ``what: stage, 43%, about 5 s left``, or of complaint."""
        if not line:
            return
        self._last_line = line
        words, found = line.partition(': ')[2], PERCENT.search(line)
        self.share = int(found[1]) / 100 if found else math.nan
        self.stage = words or line

    def cancel(self) -> None:
        self._is_ended = self._is_ended or self.exit_code is None
        self.end()

    def end(self) -> None:
        process = self._process
        if process is not None and process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)


CALIBRATE, DIAGNOSE = 'calibrate', 'diagnose'
SETTLING_S = 2.0
"""Time, s, after a change of the model that the figures after it leave out: warm starts and
averages of before have their end in it."""
PAUSE = 'poses pause until all nodes have taken it'
TRACKED, DROP_PERCENT = 'tracked_percent', 10.0
"""Key of the share of tracked frames, and how far, %, it may fall before Undo is offered."""


class Found(NamedTuple):
    """Holds what a command has found.

    ``rows`` have a label and, as text, a figure before and after, on data held out.
    """

    kind: str
    recording: str
    folder: Path
    words: str
    rows: tuple[tuple[str, str, str], ...]
    passing: tuple[str, ...] = ()  # effects that belong to the time of the recording

    @property
    def model(self) -> Path:
        return self.folder / 'model.yaml'


class Loaded(NamedTuple):
    """Remembers a change of the model: what was there before, and how well it went with that."""

    before: dict[str, str]
    figures: dict[str, float | None]
    at_s: float


def _step(
    step: Callable[['CorrectionLoop'], Awaitable[str]],
) -> Callable[['CorrectionLoop'], Awaitable[None]]:
    """Make a method one step, which says in words how it went: one at a time, whoever clicks."""

    @functools.wraps(step)
    async def stepped(loop: 'CorrectionLoop') -> None:
        async with loop.busy:
            try:
                loop.message, loop.is_trouble = await step(loop), False
            except AnserError as error:
                loop.message, loop.is_trouble = ' '.join(str(error).split()), True

    return stepped


class CorrectionLoop:
    """Holds the loop's state, one for all pages; every step says in words how it went.

    ``names`` are the recordings, the newest first, and ``chosen`` is the one that commands work
    on; ``model`` is the active model's file, as ``field_model`` has it.
    """

    def __init__(self, chain: 'ChainClient', live: 'ViewSource', folder: RecordingFolder) -> None:
        self._chain, self._live, self.folder = chain, live, folder
        self.chosen, self.model = '', ''
        self.job: Job | None = None
        self.found: Found | None = None
        self.message, self.is_trouble = '', False
        self.names: tuple[str, ...] = ()
        self._loaded: list[Loaded] = []
        self.busy = asyncio.Lock()

    # What can be done ---------------------------------------------------------------------

    @property
    def is_running(self) -> bool:
        return self.job is not None and self.job.exit_code is None

    def obstacles(self, status: Mapping[str, Any]) -> dict[str, str]:
        """Return for each button why it cannot be used now, in words; empty where it can.

        ``status`` is that of `ViewSource`.
        """
        found, recording = self.found, status['recording']
        runs = 'a command is already running' if self.is_running else ''
        command = runs or ('' if self.chosen else 'there is no recording yet')
        return {
            'record': 'it records already' if recording else _there(status, 'recorder'),
            'stop': '' if recording else 'nothing is recorded',
            'baseline': _there(status, 'field_model'),
            'calibrate': command,
            'diagnose': command,
            'report': '' if found else 'nothing was calibrated or diagnosed yet',
            'load': self._why_not_load(),
            'undo': '' if self._loaded else 'no model was loaded from this page',
        }

    def _why_not_load(self) -> str:
        if self.found is None:
            return 'there is no model to load yet'
        if self.found.passing:
            names = ', '.join(self.found.passing)
            return f'{names} belongs to the time of that recording and corrects no other'
        return 'this model is active' if str(self.found.model) == self.model else ''

    @property
    def warning(self) -> str:
        """Return that fewer frames are tracked since a model was loaded; empty otherwise."""
        if not self._loaded:
            return ''
        last = self._loaded[-1]
        before = last.figures.get(TRACKED)
        now = self._live.figures(last.at_s + SETTLING_S).get(TRACKED)
        if before is None or now is None or before - now < DROP_PERCENT:
            return ''
        return f'tracked frames fell from {before:.0f} to {now:.0f} % with this model: Undo?'

    @property
    def model_name(self) -> str:
        """Return the active model: its place in the recordings' folder, else its whole path."""
        path = Path(self.model)
        inside = path.is_relative_to(self.folder.path)
        return str(path.relative_to(self.folder.path)) if inside else self.model

    @_step
    async def record(self) -> str:
        return f'recording to {Path(await self._chain.trigger("recorder/start")).name}'

    @_step
    async def stop(self) -> str:
        """End the bag and choose it."""
        message = await self._chain.trigger('recorder/stop')
        self.refresh_names()
        if not self.names:
            raise ParameterError(
                f'{message}; but {self.folder.path} holds no recording: give the live view and '
                'the recorder the same directory'
            )
        self.chosen = self.names[0]
        return message

    @_step
    async def set_baseline(self) -> str:
        """Take what the references read now for what they read without metal."""
        return await self._chain.trigger('field_model/set_baseline')

    @_step
    async def calibrate(self) -> str:
        return await self._start(CALIBRATE)

    @_step
    async def diagnose(self) -> str:
        """Find what the active model lacks on the chosen recording."""
        return await self._start(DIAGNOSE)

    @_step
    async def load(self) -> str:
        why = self._why_not_load()
        if self.found is None or why:
            raise ParameterError(why)
        before = await self._chain.model_files()
        figures = self._live.figures(0.0)
        await self._exchange(before, dict.fromkeys(before, str(self.found.model)))
        self._loaded.append(Loaded(before, figures, time.time()))
        self._live.mark('model loaded')
        return f'the new model is active; {PAUSE}'

    @_step
    async def undo(self) -> str:
        if not self._loaded:
            raise ParameterError('no model was loaded from this page')
        await self._exchange(await self._chain.model_files(), self._loaded[-1].before)
        self._loaded.pop()
        self._live.mark('undone')
        return f'the previous model is active again; {PAUSE}'

    def refresh_names(self) -> None:
        self.names = tuple(self.folder.recordings())
        if self.chosen not in self.names:
            self.chosen = self.names[0] if self.names else ''

    def cancel(self) -> None:
        if self.job is not None:
            self.job.cancel()

    async def look(self) -> None:
        self.model = (await self._chain.model_files()).get('field_model', '')

    # How it is done -----------------------------------------------------------------------

    async def _start(self, kind: str) -> str:
        if self.is_running:
            raise ParameterError('a command is already running')
        name = self.chosen
        bag = self.folder.recording(name)
        if kind == DIAGNOSE:
            await self.look()
            baseline = await self._chain.baseline_file()
            folder = self.folder.new_result(kind, name)
            options = ['--model', self.model or NOMINAL]
            options += ['--baseline', baseline] if baseline else []
            options += ['--out', str(folder)]
        else:
            folder = self.folder.new_result(kind, name)
            options = ['--out', str(folder / 'model.yaml'), '--report', str(folder)]
        self.job = job = Job(kind, [str(bag), *options, '--json'], folder)
        self._running = asyncio.create_task(self._finish(job, name))
        return f'{kind} {name}'

    async def _finish(self, job: Job, name: str) -> None:
        await job.run()
        if job.failure:
            self.message, self.is_trouble = job.failure, True
            return
        document = json.loads((job.folder / f'{_NOUN[job.kind]}.json').read_text('utf-8'))
        words, rows = _READ[job.kind](document)
        self.found = Found(job.kind, name, job.folder, words, rows, _passing(document))
        self.message, self.is_trouble = f'{job.kind} {name}: done in {job.seconds:.0f} s', False

    async def _exchange(self, present: Mapping[str, str], wanted: Mapping[str, str]) -> None:
        """Give the nodes other models; where one refuses, all keep what they had."""
        try:
            await self._chain.load_model(wanted)
        except AnserError:
            await self._chain.load_model(present)
            raise
        finally:
            await self.look()

    # What is shown ------------------------------------------------------------------------

    def comparison(self) -> list[tuple[str, str, str]]:
        """Return rows of label, before and after, live, where a model was loaded."""
        if not self._loaded:
            return []
        before = self._loaded[-1]
        now = self._live.figures(before.at_s + SETTLING_S)
        return [
            (label, _text(before.figures.get(key), digits), _text(now.get(key), digits))
            for label, key, digits in LIVE_ROWS
        ]


LIVE_ROWS = (
    ('tracked frames, %', TRACKED, 0),
    ('error, mm rms', 'error_mm', 2),
    ('residual, pT rms', 'residual_pt', 0),
)
"""Figures of the last seconds, live: label, key, digits behind the point."""
_NOUN = {CALIBRATE: 'calibration', DIAGNOSE: 'diagnosis'}


def _text(value: float | None, digits: int, scale: float = 1.0) -> str:
    return '–' if value is None else f'{scale * value:.{digits}f}'


def _read_diagnosis(document: dict[str, Any]) -> tuple[str, tuple[tuple[str, str, str], ...]]:
    held, rows = document['held_out'], []
    for label, key, unit, scale, digits in (
        ('residual, pT', 'flux_rms', 't', 1e12, 0),
        ('position error, mm', 'position_rmse', 'm', 1e3, 2),
        ('orientation error, deg', 'orientation_rmse', 'rad', DEGREES, 2),
    ):
        before, after = held[f'{key}_before_{unit}'], held[f'{key}_after_{unit}']
        rows.append((label, _text(before, digits, scale), _text(after, digits, scale)))
    return verdict(document), tuple(rows)


def _there(status: Mapping[str, Any], node: str) -> str:
    return '' if status[node] else f'no {node} runs'


def _passing(document: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the effects that have a beginning, an end or a path in the recording's time."""
    bound = 't_start_s', 't_end_s', 'path'
    return tuple(
        effect['name'] for effect in document.get('effects', ())
        if any(key in effect['parameters'] for key in bound)
    )  # fmt: skip


def _read_calibration(document: dict[str, Any]) -> tuple[str, tuple[tuple[str, str, str], ...]]:
    before = _text(document.get('nominal_flux_rmse_t'), 0, 1e12)
    after = _text(document['heldout_flux_rmse_t'], 0, 1e12)
    words = (
        f'A model of {document["n_dipoles"]} dipoles from {document["n_measurements"]} readings '
        f'per emitter; on held-out data its residual is {after} pT, '
        f'{document["heldout_n_rmse_percent"]:.3f} % of the range.'
    )
    return words, (('residual, pT (before: nominal model)', before, after),)


_READ = {CALIBRATE: _read_calibration, DIAGNOSE: _read_diagnosis}
