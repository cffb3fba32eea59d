"""Lets a person close the loop on the page: record, diagnose, load the better model, or undo."""

import asyncio
import functools
import json
import time
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from anser_ros.cli.diagnosis_words import verdict
from anser_ros.errors import AnserError, ParameterError
from anser_ros.physics.constants import DEGREES
from anser_ros.sessions.starting_model import NOMINAL
from anser_ros.web.folder import RecordingFolder
from anser_ros.web.job import Job

CALIBRATE, DIAGNOSE = 'calibrate', 'diagnose'
SETTLING_S = 2.0
"""Time, s, after a change of the model that the figures after it leave out: warm starts and
averages of before have their end in it."""
MOST_UNDONE = 20
"""Changes of the model that can be undone, which bounds what is kept of a long day."""


class Chain(Protocol):
    """States what the page can ask of the running nodes; they refuse by `AnserError`."""

    async def trigger(self, service: str) -> str: ...
    async def model_files(self) -> dict[str, str]: ...
    async def load_model(self, files: Mapping[str, str]) -> None: ...
    async def baseline_file(self) -> str: ...


class LiveFigures(Protocol):
    """States what the page knows of the present moment."""

    def figures(self, since_s: float) -> dict[str, float | None]: ...
    def mark(self, words: str) -> None: ...


@dataclass(frozen=True)
class Found:
    """Holds what a command has found.

    ``rows`` have a label and, as text, a figure before and after, on data held out.
    """

    kind: str
    recording: str
    folder: Path
    words: str
    rows: tuple[tuple[str, str, str], ...]

    @property
    def model(self) -> Path:
        """Return the path of the model that it wrote."""
        return self.folder / 'model.yaml'


@dataclass(frozen=True)
class Loaded:
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

    def __init__(self, chain: Chain, live: LiveFigures, folder: RecordingFolder) -> None:
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
        """Return whether a command runs."""
        return self.job is not None and self.job.exit_code is None

    @property
    def can_load(self) -> bool:
        """Return whether there is a model to load that is not active."""
        return self.found is not None and str(self.found.model) != self.model

    @property
    def can_undo(self) -> bool:
        """Return whether a model was loaded here."""
        return bool(self._loaded)

    @property
    def model_name(self) -> str:
        """Return the active model: its place in the recordings' folder, else its whole path."""
        path = Path(self.model)
        inside = path.is_relative_to(self.folder.path)
        return str(path.relative_to(self.folder.path)) if inside else self.model

    @_step
    async def record(self) -> str:
        """Begin to record another bag."""
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
        """Fit a model to the chosen recording."""
        return await self._start(CALIBRATE)

    @_step
    async def diagnose(self) -> str:
        """Find what the active model lacks on the chosen recording."""
        return await self._start(DIAGNOSE)

    @_step
    async def load(self) -> str:
        """Activate the model that was found."""
        if self.found is None:
            raise ParameterError('there is no model to load yet')
        before = await self._chain.model_files()
        figures = self._live.figures(0.0)
        await self._exchange(before, dict.fromkeys(before, str(self.found.model)))
        self._loaded = [*self._loaded[-MOST_UNDONE + 1 :], Loaded(before, figures, time.time())]
        self._live.mark('model loaded')
        return 'the new model is in force'

    @_step
    async def undo(self) -> str:
        """Activate the model that was there before."""
        if not self._loaded:
            raise ParameterError('no model was loaded from this page')
        await self._exchange(await self._chain.model_files(), self._loaded[-1].before)
        self._loaded.pop()
        self._live.mark('undone')
        return 'the previous model is in force again'

    def refresh_names(self) -> None:
        """See which recordings there are."""
        self.names = tuple(self.folder.recordings())
        if self.chosen not in self.names:
            self.chosen = self.names[0] if self.names else ''

    def cancel(self) -> None:
        """End the command that runs."""
        if self.job is not None:
            self.job.cancel()

    async def look(self) -> None:
        """Ask which model is active."""
        self.model = (await self._chain.model_files()).get('field_model', '')

    # How it is done -----------------------------------------------------------------------

    async def _start(self, kind: str) -> str:
        if self.is_running:
            raise ParameterError('a command is already running')
        name = self.chosen
        bag = self.folder.recording(name)
        options: list[str] = []
        if kind == DIAGNOSE:
            await self.look()
            options += ['--model', self.model or NOMINAL]
            baseline = await self._chain.baseline_file()
            options += ['--baseline', baseline] if baseline else []
        folder = self.folder.new_result(kind, name)
        if kind == DIAGNOSE:
            options += ['--out', str(folder)]
        else:
            options += ['--out', str(folder / 'model.yaml'), '--report', str(folder)]
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
        self.found = Found(job.kind, name, job.folder, words, rows)
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
    ('tracked frames, %', 'tracked_percent', 0),
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
