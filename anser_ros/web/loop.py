"""Lets a person close the loop on the page: record, diagnose, load the better model, or undo."""

import asyncio
import json
import time
from collections.abc import Mapping
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
    """States what the page can ask of the running nodes."""

    async def trigger(self, service: str) -> str:
        """Call a service and return its answer; AnserError where it refuses."""

    async def model_files(self) -> dict[str, str]:
        """Return the model file of each node that has one, ``field_model`` first."""

    async def load_model(self, files: Mapping[str, str]) -> None:
        """Give nodes other model files; AnserError where one refuses."""

    async def baseline_file(self) -> str:
        """Return the recording without metal that the nodes were started with; empty for none."""

    def figures(self, since_s: float) -> dict[str, float | None]:
        """Return ``tracked``, ``error_mm`` and ``residual_pt`` of the last seconds."""

    def mark(self, words: str) -> None:
        """Mark this moment in the curves."""


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


class CorrectionLoop:
    """Holds the loop's state, one for all pages; every step says in words how it went.

    ``names`` are the recordings, the newest first, and ``chosen`` is the one that commands work
    on; ``model`` is the active model's file, as ``field_model`` has it.
    """

    def __init__(self, chain: Chain, folder: RecordingFolder) -> None:
        self._chain, self.folder = chain, folder
        self.chosen, self.model = '', ''
        self.job: Job | None = None
        self.found: Found | None = None
        self.message, self.is_trouble = '', False
        self.names: tuple[str, ...] = ()
        self._loaded: list[Loaded] = []
        self._busy = asyncio.Lock()

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

    async def record(self) -> None:
        """Begin to record another bag."""
        await self._step(self._record())

    async def stop(self) -> None:
        """End the bag and choose it."""
        await self._step(self._stop())

    async def set_baseline(self) -> None:
        """Take what the references read now for what they read without metal."""
        await self._step(self._set_baseline())

    async def calibrate(self) -> None:
        """Fit a model to the chosen recording."""
        await self._step(self._start(CALIBRATE))

    async def diagnose(self) -> None:
        """Find what the active model lacks on the chosen recording."""
        await self._step(self._start(DIAGNOSE))

    async def load(self) -> None:
        """Activate the model that was found."""
        await self._step(self._load())

    async def undo(self) -> None:
        """Activate the model that was there before."""
        await self._step(self._undo())

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

    async def _step(self, step: Any) -> None:
        async with self._busy:  # one after the other, whoever clicks
            try:
                self.message, self.is_trouble = await step, False
            except AnserError as error:
                self.message, self.is_trouble = ' '.join(str(error).split()), True

    async def _record(self) -> str:
        return f'recording to {Path(await self._chain.trigger("recorder/start")).name}'

    async def _stop(self) -> str:
        message = await self._chain.trigger('recorder/stop')
        self.refresh_names()
        if not self.names:
            raise ParameterError(
                f'{message}; but {self.folder.path} holds no recording: give the live view and '
                'the recorder the same directory'
            )
        self.chosen = self.names[0]
        return message

    async def _set_baseline(self) -> str:
        return await self._chain.trigger('field_model/set_baseline')

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

    async def _load(self) -> str:
        if self.found is None:
            raise ParameterError('there is no model to load yet')
        before = await self._chain.model_files()
        figures = self._chain.figures(0.0)
        await self._exchange(before, dict.fromkeys(before, str(self.found.model)))
        self._loaded = [*self._loaded[-MOST_UNDONE + 1 :], Loaded(before, figures, time.time())]
        self._chain.mark('model loaded')
        return 'the new model is in force'

    async def _undo(self) -> str:
        if not self._loaded:
            raise ParameterError('no model was loaded from this page')
        last = self._loaded[-1]
        await self._exchange(await self._chain.model_files(), last.before)
        self._loaded.pop()
        self._chain.mark('undone')
        return 'the previous model is in force again'

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
        """Return rows of label, before and after: live, where a model was loaded, and held out."""
        rows = []
        if self._loaded:
            last = self._loaded[-1]
            now = self._chain.figures(last.at_s + SETTLING_S)
            for label, key, digits in LIVE_ROWS:
                before, after = last.figures.get(key), now.get(key)
                rows.append((label, _text(before, digits), _text(after, digits)))
        return rows


LIVE_ROWS = (
    ('tracked frames, %', 'tracked_percent', 0),
    ('error, mm rms', 'error_mm', 2),
    ('residual, pT rms', 'residual_pt', 0),
)
"""Figures of the last seconds, live: label, key, digits behind the point."""
_NOUN = {CALIBRATE: 'calibration', DIAGNOSE: 'diagnosis'}


def _text(value: float | None, digits: int) -> str:
    return '–' if value is None else f'{value:.{digits}f}'


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else scale * value


def _read_diagnosis(document: dict[str, Any]) -> tuple[str, tuple[tuple[str, str, str], ...]]:
    held = document['held_out']
    rows = []
    for label, key, unit, scale, digits in (
        ('residual, pT', 'flux_rms', 't', 1e12, 0),
        ('position error, mm', 'position_rmse', 'm', 1e3, 2),
        ('orientation error, deg', 'orientation_rmse', 'rad', DEGREES, 2),
    ):
        pair = [
            _text(_scaled(held[f'{key}_{when}_{unit}'], scale), digits)
            for when in ('before', 'after')
        ]
        rows.append((label, pair[0], pair[1]))
    return verdict(document), tuple(rows)


def _read_calibration(document: dict[str, Any]) -> tuple[str, tuple[tuple[str, str, str], ...]]:
    before = _scaled(document.get('nominal_flux_rmse_t'), 1e12)
    after = _scaled(document['heldout_flux_rmse_t'], 1e12)
    words = (
        f'A model of {document["n_dipoles"]} dipoles from {document["n_measurements"]} readings '
        f'per emitter; on held-out data its residual is {_text(after, 0)} pT, '
        f'{document["heldout_n_rmse_percent"]:.3f} % of the range.'
    )
    rows = (('residual, pT (before: nominal model)', _text(before, 0), _text(after, 0)),)
    return words, rows


_READ = {CALIBRATE: _read_calibration, DIAGNOSE: _read_diagnosis}
