"""Makes a refit in the background, while the callbacks go on.

Its tables, seconds of work, need the model and the references' places only, so they are begun
before there is a baseline, and kept on disk. What a baseline adds is half a second more, for each
baseline again.
"""

import contextlib
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import FieldModel
from anser_ros.physics.sensor import SensorTable
from anser_ros.physics.tracks import loop_field
from anser_ros.refit import tables
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.sessions.drawing import NominalBoard
from anser_ros.sessions.kept_tables import KeptTables, ReadAhead
from anser_ros.sessions.volume import stated_volume
from anser_ros.wire.setup import Setup

WORKER = 'refit_start'
"""Name of the thread that makes a refit."""


def warm_up() -> None:
    """Let the compiler load what it needs for its first kernel, half a second, while the graph is
    still being discovered.
    """
    loop_field(np.eye(3), np.ones((1, 3)), 1.0)


class _EndedError(Exception):
    """The tables are no longer needed."""


class RefitStart:
    """Makes the refits of one model in a thread of its own.

    An emitter that can't be drawn from the setup has to do with the model's own dipoles. Tables
    are kept in a ``folder``, which ``ahead`` belongs to; None where they are not. With tools as
    witnesses, ``witness_noise_t`` is the noise of a component of what they read, T.
    """

    def __init__(
        self,
        setup: Setup,
        model: FieldModel,
        references: SensorTable,
        folder: Path | None = None,
        ahead: ReadAhead | None = None,
        witness_noise_t: float | None = None,
    ) -> None:
        self._setup, self._model, self._references = setup, model, references
        self._folder, self._ahead, self._witness_noise_t = folder, ahead, witness_noise_t
        self._worker = ThreadPoolExecutor(1, thread_name_prefix=WORKER)
        self._tables: Future[tables.RefitTables] | None = None
        self._made: Future[LiveRefit] | None = None
        self._kept: Future[None] | None = None
        self._share, self._is_over = 0.0, False

    def prepare(self) -> None:
        """Begin with what needs no baseline, unless that is done."""
        if self._tables is None:
            self._tables = self._worker.submit(self._work_tables_out)

    def begin(self, baseline: NDArray[np.complex128]) -> None:
        """Begin to make the refit to what differs from a baseline, in place of one being made.

        The baseline, shape (R, K), T, is what the references read without metal.
        """
        self.prepare()
        if self._made is not None:
            self._made.cancel()
        self._made = self._worker.submit(self._make, baseline)
        if self._kept is None and self._folder is not None:
            self._kept = self._worker.submit(self._keep, self._folder)  # nobody waits for it

    def taken(self) -> LiveRefit | None:
        """Return the refit once, as soon as it is made.

        Raises
        ------
        FitError
            When no refit can be made for this model, these references or this baseline.
        """
        made = self._made
        if made is None or not made.done():
            return None
        self._made = None
        return made.result()

    def wait(self) -> None:
        """Wait until the refit is made that is being made, if there is one."""
        if self._made is not None:
            wait([self._made])

    @property
    def is_making(self) -> bool:
        """Return whether a refit is being made, for which there is a baseline."""
        return self._made is not None

    @property
    def words(self) -> str:
        """Return how far it is; empty while none is being made."""
        return f'refit being prepared, {self._share:.0%}' if self.is_making else ''

    def end(self, longest_s: float = 0.0) -> bool:
        """Give the work up; return whether it ended within some seconds."""
        self._is_over = True
        self._worker.shutdown(wait=False, cancel_futures=True)
        works: tuple[Future[Any] | None, ...] = (self._tables, self._made, self._kept)
        # What was given up before it began is done, but `wait` would wait for it.
        going_on = [work for work in works if work is not None and not work.done()]
        return not wait(going_on, longest_s).not_done

    def _file(self, folder: Path) -> KeptTables:
        return KeptTables(folder, self._setup, self._model, self._references, self._ahead)

    def _work_tables_out(self) -> tables.RefitTables:
        kept = None if self._folder is None else self._file(self._folder).read()
        if kept is not None:
            return kept
        drawing, volume = NominalBoard.of(self._setup).field, stated_volume(self._setup)
        settings = self._setup.refit
        return tables.build_tables(
            self._model, self._references, settings, drawing, volume, report=self._report
        )

    def _keep(self, folder: Path) -> None:
        assert self._tables is not None
        with contextlib.suppress(OSError):  # a full disk only makes the next start slower
            self._file(folder).write(self._tables.result())

    def _report(self, share: float) -> None:
        if self._is_over:
            raise _EndedError
        self._share = share

    def _make(self, baseline: NDArray[np.complex128]) -> LiveRefit:
        assert self._tables is not None
        made = self._tables.result()
        self._share = 1.0
        settings = self._setup.refit
        refit = LiveRefit(self._model, self._references, baseline, settings, tables=made)
        if self._witness_noise_t is not None:
            refit.enable_witnesses(self._witness_noise_t, ready=True)
        return refit
