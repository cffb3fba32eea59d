"""Makes the refit that a field_model follows its references with, keeps it, and reports it in
``/diagnostics``. A refit is made in the background. Its tables, seconds of work, need the model
and the references' places only, so they are begun before there is a baseline, and kept on disk;
each baseline adds half a second.
"""

import contextlib
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import numpy as np

from anser_ros.arrays import ComplexArray
from anser_ros.chain.model_half import ModelHalf
from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import Frame
from anser_ros.nodes.field_model_io import KeptBaseline, ToolWitnesses
from anser_ros.nodes.runtime.node import Level, Status
from anser_ros.physics.board import loop_field
from anser_ros.physics.sensor import SensorTable
from anser_ros.pose_states import REFERENCES_LOST
from anser_ros.refit import tables
from anser_ros.refit.frame import Pace
from anser_ros.refit.health import DISAGREES
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.model import WITHHELD, RefitResult
from anser_ros.sessions.kept_tables import KeptTables
from anser_ros.sessions.nominal_board import NominalBoard, stated_volume
from anser_ros.stamps import is_live
from anser_ros.wire.setup import Setup

WORKER = 'refit_start'
"""Name of the thread that makes a refit."""


class _EndedError(Exception):
    """The tables are no longer needed."""


class RefitStart:
    """Makes the refits of one model in a thread of its own.

    An emitter that can't be drawn from the setup has to do with the model's own dipoles. Tables
    are kept in a ``folder``; None where they are not. With tools as
    witnesses, ``witness_noise_t`` is the noise of a component of what they read, T.
    """

    def __init__(
        self,
        setup: Setup,
        model: FieldModel,
        references: SensorTable,
        folder: Path | None = None,
        witness_noise_t: float | None = None,
    ) -> None:
        self._setup, self._model, self._references = setup, model, references
        self._folder, self._witness_noise_t = folder, witness_noise_t
        self._worker = ThreadPoolExecutor(1, thread_name_prefix=WORKER)
        self._tables: Future[tables.RefitTables] | None = None
        self._made: Future[LiveRefit] | None = None
        self._kept: Future[None] | None = None
        self._share, self._is_over = 0.0, False

    def prepare(self) -> Future[tables.RefitTables]:
        """Begin with what needs no baseline, unless that is done; return the tables to come."""
        if self._tables is None:
            self._tables = self._worker.submit(self._work_tables_out)
        return self._tables

    def begin(self, baseline: ComplexArray) -> None:
        """Begin to make the refit to what differs from a baseline, in place of one being made.

        The baseline, shape (R, K), T, is what the references read without metal.
        """
        made = self.prepare()
        if self._made is not None:
            self._made.cancel()
        self._made = self._worker.submit(self._make, baseline, made)
        if self._kept is None and self._folder is not None:
            self._kept = self._worker.submit(self._keep, self._folder, made)  # nobody waits for it

    def taken(self) -> LiveRefit | None:
        """Return the refit once, as soon as it is made; raises `FitError` where none can be."""
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
        return KeptTables(folder, self._setup, self._model, self._references)

    def _work_tables_out(self) -> tables.RefitTables:
        kept = None if self._folder is None else self._file(self._folder).read()
        if kept is not None:
            return kept
        drawing, volume = NominalBoard.of(self._setup).field, stated_volume(self._setup)
        settings = self._setup.refit
        return tables.build_tables(
            self._model, self._references, settings, drawing, volume, report=self._report
        )

    def _keep(self, folder: Path, made: Future[tables.RefitTables]) -> None:
        with contextlib.suppress(OSError):  # a full disk only makes the next start slower
            self._file(folder).write(made.result())

    def _report(self, share: float) -> None:
        if self._is_over:
            raise _EndedError
        self._share = share

    def _make(self, baseline: ComplexArray, made: Future[tables.RefitTables]) -> LiveRefit:
        ready, settings = made.result(), self._setup.refit
        self._share = 1.0
        refit = LiveRefit(self._model, self._references, baseline, settings, tables=ready)
        if self._witness_noise_t is not None:
            refit.enable_witnesses(self._witness_noise_t, ready=True)
        return refit


class ActiveRefit(ModelHalf):
    """Keeps the refit, its last result, and what it is made from.

    ``count`` counts an event by its name, ``kept`` is what a process after this one takes up.
    ``start`` makes the refits of the active model, None without references; the newest ``result``
    took ``update_s``.
    """

    def __init__(
        self,
        witnesses: ToolWitnesses,
        pace: Pace,
        count: Callable[[str], None],
        kept: KeptBaseline,
    ) -> None:
        super().__init__(pace)
        # The compiler loads for half a second, now, while the graph is still being discovered.
        loop_field(np.eye(3), np.ones((1, 3)), 1.0)
        self._witnesses, self._count = witnesses, count
        self._kept = kept
        self._has_looked = False
        self._confirmed: RefitResult | None = None
        self.start: RefitStart | None = None
        self._baseline: ComplexArray | None = None
        self.update_s = 0.0

    def prepare(
        self, setup: Setup, base: FieldModel, references: SensorTable, at_once: bool, again: bool
    ) -> None:
        """Be without a refit, and begin at once with what needs no baseline for the next one, or
        to make it ``again`` to the last baseline, which is dropped else.
        """
        self.end()
        self.follow_by(None)
        self.start = None
        self._has_looked = False
        self._kept.expect(setup, base)
        self._witnesses.expect(setup, base)
        if len(references):
            folder, noise_t = self._kept.folder, self._witnesses.noise_t
            self.start = RefitStart(setup, base, references, folder, noise_t)
            if at_once:
                self.start.prepare()
        baseline, self._baseline = self._baseline, None
        if again and baseline is not None:
            self.begin(baseline)

    def begin(self, baseline: ComplexArray) -> None:
        """Begin to make a refit to what differs from a baseline, shape (S, K), T.

        No pose is given before the first one is there, since metal may come meanwhile; one that is
        active goes on until the next one is there. Raises `FitError` without references.
        """
        if self.start is None:
            raise FitError('the setup has no reference sensors')
        self._kept.drop()
        self._baseline = baseline
        self.start.begin(baseline)

    def resume(self, is_wanted: bool) -> None:
        """Begin with the baseline of a process before this one, where there is one.

        It is looked for once for a setup and model, as soon as the sender is known.
        """
        has_one = self.current is not None or self.is_making
        if not is_wanted or self.start is None or self._has_looked or has_one:
            return
        self._has_looked, baseline = self._kept.is_known, self._kept.read()
        if baseline is not None:
            self.begin(baseline)
            self._count('baselines_resumed')

    def confirm(self) -> None:
        """Keep the baseline for a process after this one, unless references contradict it.

        One that jumped by itself may be recognised by what it read before, which the next process
        does not know.
        """
        result, kept = self.result, self._kept
        if self._baseline is None or result is None or result is self._confirmed:
            return
        self._confirmed = result
        if not is_live(result.stamp_ns, time.time_ns()):
            return  # a recording that is played begins with its own baseline each time
        try:
            if result.is_answer and all(one.state != DISAGREES for one in result.references):
                kept.confirm(self._baseline)
            else:
                kept.drop()
        except OSError:  # a full disk: the node goes on, and one after it begins without baseline
            self._count('baselines_not_kept')

    def take(self) -> bool:
        """Activate a refit that has been made meanwhile; return whether there was one.

        Raises `FitError` when none can be made.
        """
        started = None if self.start is None else self.start.taken()
        if started is None:
            return False
        self.follow_by(started)
        self._count('refit_starts')
        return True

    def end(self, longest_s: float = 0.0) -> bool:
        """Give up what is being made; return whether that ended within some seconds."""
        return self.start is None or self.start.end(longest_s)

    @property
    def is_making(self) -> bool:
        """Return whether a refit is being made."""
        return self.start is not None and self.start.is_making

    @property
    def is_awaited(self) -> bool:
        """Return whether the first refit is being made, before which no pose is given."""
        return self.current is None and self.is_making

    @property
    def withheld(self) -> str:
        """State for which trackers are to give no pose for the newest frame."""
        if self.result is None:
            return REFERENCES_LOST if self.is_awaited else ''
        return self.result.withheld

    def refitted(self, refit: LiveRefit, frame: Frame) -> RefitResult:
        """Return what the refit makes of a frame, after what tools witness of the one before."""
        begin_s = time.monotonic()
        if self.result is not None:
            self._witnesses.pass_on(refit, self.result.stamp_ns)
        result = super().refitted(refit, frame)
        self._count('refits')
        self.update_s = time.monotonic() - begin_s
        return result


TROUBLED = tuple(WITHHELD)
"""States of the refit that an operator is warned of."""
PREPARING = (
    'a baseline is there, the refit is being prepared: until it is active there are no poses '
    '(state references_lost), as metal may come meanwhile'
)
ACTIVE = 'the refit is active: the model follows the references'


def no_baseline(namespace: str) -> str:
    """Return words for the console if references are there, but nothing to compare them with."""
    return (
        'no baseline of the references, so the model does not follow them, and metal will make '
        f'poses vanish (state residual): with no metal near, call {namespace}/field_model/'
        'set_baseline, or give a clean recording as baseline_file'
    )


def model_values(model: FieldModel, name: str) -> dict[str, object]:
    """Return the figures of the active model; ``name`` stands where its source is not known."""
    return {
        'source': model.provenance.get('source', name),
        'dipoles': len(model.positions),
        'emitters': len(model.emitters),
        'flux_error_t': float(model.flux_error_t),
        'modes': 0 if model.modes is None else len(model.modes),
    }


def refit_values(result: RefitResult) -> dict[str, object]:
    """Return the figures of a frame's refit by their names in `/diagnostics`."""
    return {
        'refit_state': result.state,
        'refit_reason': result.reason,
        'reference_noise_t': result.noise_t,
        'change_log_odds': result.log_odds,
        'references_left_out': ', '.join(result.left_out),
        'most_likely': max(result.weights, key=result.weights.__getitem__, default=''),
        'largest_drift': float(np.abs(result.drift).max(initial=0.0)),
    }


def activity(
    refit: ActiveRefit, is_held: bool, is_wanted: bool, refused: str, values: dict[str, object]
) -> str:
    """Return what the refit does, or why none is made, and add its figures to the values.

    ``refused`` is why a baseline that was requested last is not active.
    """
    result, making = refit.result, '' if refit.start is None else refit.start.words
    if is_held:
        return 'held as it is: freeze was called'
    if not is_wanted:
        return 'constant'
    if refit.current is None and making:
        return f'constant, {making}'
    if refit.current is None:
        return f'constant, no baseline: {refused}' if refused else 'constant, no baseline yet'
    words = 'baseline set'
    if result is not None:
        values |= refit_values(result)
        words = ': '.join(filter(None, (result.state, result.reason)))
    words += f'; a new baseline was refused: {refused}' if refused else ''
    return words + (f'; the next {making}' if making else '')


def reference_statuses(result: RefitResult | None) -> list[Status]:
    """Return a line for every reference sensor that the refit looked at."""
    if result is None:
        return []
    return [
        Status(
            health.name,
            Level.OK if health.state == 'ok' else Level.WARN,
            health.state,
            {'residual_t': health.residual_t, 'distance': health.distance},
        )
        for health in result.references
    ]
