"""Keeps the refit that a field_model follows its references with, and the next
while it is made.
"""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import Frame
from anser_ros.nodes.field_model_parts.kept_baseline import KeptBaseline
from anser_ros.nodes.field_model_parts.refit_start import RefitStart, warm_up
from anser_ros.nodes.field_model_parts.tool_witnesses import ToolWitnesses
from anser_ros.physics.sensor import SensorTable
from anser_ros.pose_states import REFERENCES_LOST
from anser_ros.refit.change import Pace
from anser_ros.refit.health import DISAGREES
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.result import RefitResult
from anser_ros.sessions.kept_tables import ReadAhead
from anser_ros.stamps import is_live
from anser_ros.wire.setup import Setup


class ActiveRefit:
    """Keeps the refit, its last result, and what it is made from.

    ``count`` counts an event by its name, ``kept`` is what a process after this one takes up, and
    ``ahead`` what is read of it before references and setup are known.

    Attributes
    ----------
    current : LiveRefit or None
    result : RefitResult or None
        Of the newest frame, since the refit began or was reset.
    update_s : float
        Time that the last result took, s.
    """

    def __init__(
        self,
        witnesses: ToolWitnesses,
        pace: Pace,
        count: Callable[[str], None],
        kept: KeptBaseline,
        ahead: ReadAhead,
    ) -> None:
        warm_up()
        self._witnesses, self._pace, self._count = witnesses, pace, count
        self._kept, self._ahead = kept, ahead
        self._has_looked = False
        self._confirmed: RefitResult | None = None
        self._start: RefitStart | None = None
        self._baseline: NDArray[np.complex128] | None = None
        self.current: LiveRefit | None = None
        self.result: RefitResult | None = None
        self.update_s = 0.0

    def prepare(
        self, setup: Setup, base: FieldModel, references: SensorTable, at_once: bool
    ) -> None:
        """Be without a refit, and begin at once with what needs no baseline for the next one."""
        self.end()
        self.current = self.result = self._start = None
        self._has_looked = False
        self._kept.expect(setup, base)
        self._witnesses.expect(setup, base)
        if len(references):
            folder, noise_t = self._kept.folder, self._witnesses.noise_t
            self._start = RefitStart(setup, base, references, folder, self._ahead, noise_t)
            if at_once:
                self._start.prepare()
        else:
            self._ahead.drop()

    def forget_baseline(self) -> None:
        """Drop the baseline: the readings are to be others."""
        self._baseline = None

    def begin(self, baseline: NDArray[np.complex128]) -> None:
        """Begin to make a refit to what differs from a baseline, shape (S, K), T.

        No pose is given before the first one is there, since metal may come meanwhile; one that is
        active goes on until the next one is there.

        Raises
        ------
        FitError
            When there are no references.
        """
        if self._start is None:
            raise FitError('the setup has no reference sensors')
        self._kept.drop()
        self._baseline = baseline
        self._start.begin(baseline)

    def begin_again(self) -> None:
        """Begin to make one to the last baseline, if there is one."""
        if self._baseline is not None:
            self.begin(self._baseline)

    def resume(self, is_wanted: bool) -> None:
        """Begin with the baseline of a process before this one, where there is one.

        It is looked for once for a setup and model, as soon as the sender is known.
        """
        has_one = self.current is not None or self.is_making
        if not is_wanted or self._start is None or self._has_looked or has_one:
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

    def wait(self) -> None:
        """Wait until the refit is made that is being made, if there is one."""
        if self._start is not None:
            self._start.wait()

    def take(self) -> bool:
        """Activate a refit that has been made meanwhile; return whether there was one.

        Raises
        ------
        FitError
            When none can be made.
        """
        started = None if self._start is None else self._start.taken()
        if started is None:
            return False
        self.current, self.result = started, None
        self._count('refit_starts')
        return True

    def end(self, longest_s: float = 0.0) -> bool:
        """Give up what is being made; return whether that ended within some seconds."""
        return self._start is None or self._start.end(longest_s)

    @property
    def words(self) -> str:
        """Return how far the refit is that is being made; empty where none is."""
        return '' if self._start is None else self._start.words

    @property
    def is_making(self) -> bool:
        """Return whether a refit is being made."""
        return self._start is not None and self._start.is_making

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

    def reset(self) -> None:
        """Let the refit forget all frames, and its last result."""
        if self.current is not None:
            self.current.reset()
        self.result = None

    def follow(self, frame: Frame) -> RefitResult | None:
        """Return the result of a frame; None where the last one was less than the pace ago."""
        refit = self.current
        if refit is None or not self._pace.is_due(frame.stamp_ns):
            return None
        begin_s = time.monotonic()
        if self.result is not None:
            self._witnesses.pass_on(refit, self.result.stamp_ns)
        self.result = refit.follow(frame)
        self._count('refits')
        self.update_s = time.monotonic() - begin_s
        return self.result
