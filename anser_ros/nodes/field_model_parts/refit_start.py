"""Makes a refit in the background, while the callbacks go on.

Its tables, seconds of work, need the model and the references' places only, so they are begun
before there is a baseline. What a baseline adds is half a second more, for each baseline again.
"""

from concurrent.futures import Future, ThreadPoolExecutor, wait

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import FieldModel
from anser_ros.nodes.field_model_parts.patches import Patches
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit import tables
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.patches import start_table
from anser_ros.sessions.drawing import Drawing
from anser_ros.sessions.session import sensor_table
from anser_ros.sessions.volume import stated_volume
from anser_ros.wire.setup import Setup

WORKER = 'refit_start'
"""Name of the thread that makes a refit."""
Started = tuple[LiveRefit, Patches | None]
"""A refit, and the patches that its last coils are on; None where no sensor is on a body that
moves."""


class _EndedError(Exception):
    """The tables are no longer needed."""


class RefitStart:
    """Makes the refits of one model in a thread of its own.

    Parameters
    ----------
    setup : Setup
        An emitter that can't be drawn from it has to do with the model's own dipoles.
    model : FieldModel
    references : SensorTable
        The fixed ones.
    bodies : tuple of str
        Bodies whose coils are further references, while their poses are known.

    Attributes
    ----------
    is_awaited : bool
        Whether no pose is to be given before the refit is there that is being made.
    """

    def __init__(
        self, setup: Setup, model: FieldModel, references: SensorTable, bodies: tuple[str, ...]
    ) -> None:
        self._setup, self._model, self._fixed = setup, model, references
        moving = tuple(s for s in setup.tool_sensors if s.body in bodies)
        self._moving = sensor_table(moving) if moving else None
        self._worker = ThreadPoolExecutor(1, thread_name_prefix=WORKER)
        self._tables: Future[tables.RefitTables] | None = None
        self._made: Future[Started] | None = None
        self._share, self._is_over = 0.0, False
        self.is_awaited = False

    def prepare(self) -> None:
        """Begin with what needs no baseline, unless that is done."""
        if self._tables is None:
            self._tables = self._worker.submit(self._work_tables_out)

    def begin(self, baseline: NDArray[np.complex128], is_awaited: bool) -> None:
        """Begin to make the refit to what differs from a baseline, in place of one being made.

        Parameters
        ----------
        baseline : ndarray, shape (R, K), complex
            Readings of the fixed references without metal, T.
        is_awaited : bool
            Whether no pose is to be given before it is there.
        """
        self.prepare()
        if self._made is not None:
            self._made.cancel()
        self._made, self.is_awaited = self._worker.submit(self._make, baseline), is_awaited

    def taken(self) -> Started | None:
        """Return the refit once, as soon as it is made.

        Raises
        ------
        FitError
            When no refit can be made for this model, these references or this baseline.
        """
        made = self._made
        if made is None or not made.done():
            return None
        self._made, self.is_awaited = None, False
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
        works = (self._tables, self._made)
        # What was given up before it began is done, but `wait` would wait for it.
        going_on = [work for work in works if work is not None and not work.done()]
        return not wait(going_on, longest_s).not_done

    def _work_tables_out(self) -> tables.RefitTables:
        drawing, volume = Drawing.of(self._setup).field, stated_volume(self._setup)
        fixed, moving = self._fixed, self._moving
        references = fixed if moving is None else fixed.joined(start_table(moving))
        settings = self._setup.refit
        return tables.build_tables(
            self._model, references, settings, drawing, volume, report=self._report
        )

    def _report(self, share: float) -> None:
        if self._is_over:
            raise _EndedError
        self._share = share

    def _make(self, baseline: NDArray[np.complex128]) -> Started:
        setup, model, references = self._setup, self._model, self._fixed
        assert self._tables is not None
        made = self._tables.result()
        self._share = 1.0
        if self._moving is None:
            return LiveRefit(model, references, baseline, setup.refit, tables=made), None
        patches = Patches(self._moving, baseline, setup.frame_id, setup.refit)
        return patches.started(model, references, tables=made), patches
