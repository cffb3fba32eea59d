"""Keeps the hypotheses that are in use, and follows how probable each is.

Hundreds of compact bodies (`refit.clouds`) are too many to be judged in full in every frame. So a
bank has a few *slots*, places for one body each; a body that explains the readings better takes
over the slot of the one that explains them worst. For each set of reference coils in use there is
a bank, computed once. The `Belief` goes on from frame to frame.

Work that takes longer than a frame runs in one background thread of the process. A result comes
into use at a fixed time after it was requested, measured by the stamps of the frames: so the
refit's results do not depend on how busy the machine is, and a recording gives the live results.
If the thread has not finished by then, the refit waits for it.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from typing import Generic, TypeVar

import numpy as np

from anser_ros.arrays import Array, Booleans, ComplexArray
from anser_ros.refit.posterior import STRENGTHS, Bank, Eigenbasis, make_room
from anser_ros.refit.tables import BodySearch, RefitTables
from anser_ros.settings import RefitSettings

DELAY_NS = 80_000_000
"""Time from asking for a result to its use, ns: four frames at 50 Hz. The longest work takes 20 ms
of a free processor, and frames wait for it on a busy one; until then the interim answer holds."""

Result = TypeVar('Result')


@cache
def _worker() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix='refit')


class BackgroundTask(Generic[Result]):
    """Runs one piece of work in the background thread.

    ``work``: must only read what nothing else changes. ``stamp_ns``: stamp of the frame that
    starts it, ns.
    """

    def __init__(self, work: Callable[[], Result], stamp_ns: int) -> None:
        self._begin_ns = stamp_ns
        self._future: Future[Result] = _worker().submit(work)

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether the result may be used in a frame; at once where the stamps went back."""
        return not self._begin_ns <= stamp_ns < self._begin_ns + DELAY_NS

    def result(self) -> Result:
        """Return the result, and wait for it where that is necessary."""
        return self._future.result()


SLOTS = 3
"""Compact bodies that are full hypotheses at a time: two that explain the readings alike, and one
more that may be better. Each costs the posterior of a source in every frame."""
SLOT_EVIDENCE = 3.0
"""Log evidence for which a body takes another's slot: odds of 20 to 1, so that none take turns."""
EVERY = 4
"""Frames between looks at all bodies: a hand moves a third of `clouds.BODY_SPACING` meanwhile."""
MOST_BODIES = 16
"""Bodies whose hypotheses are kept, 3 MB and 17 ms each; 24 would answer no more requests."""
PRESENT = 1.15
"""Power of the readings over that of noise below which no body is looked for (1 frame in 100)."""


Choice = tuple[int, int] | None
"""A slot and the body for it; None if there is no better one than those that have slots."""


class BodySlots:
    """Fills the slots of a bank with the bodies that the readings support.

    ``bank``: its last `SLOTS` hypotheses are slots.
    """

    def __init__(self, bank: Bank, tables: RefitTables) -> None:
        self._bank, self._tables = bank, tables
        self._first = len(bank.priors) - SLOTS + 1
        self._search = BodySearch(tables.factors, bank.rows, bank.whitening, STRENGTHS[::2])
        self._bodies: list[int] = []
        # A look at all bodies, and the hypothesis of the one that it chooses, if any.
        self._look: tuple[BackgroundTask[Choice], BackgroundTask[Eigenbasis | None]] | None = None
        self._wait = 0
        self._known: dict[int, Eigenbasis] = {}

    def warm_up(self, readings: Array, noise: float) -> None:
        """Look at all bodies once and choose none, so that the first look takes no longer."""
        self._search.scores(readings, noise)

    def clear(self) -> None:
        """Empty all slots of bodies."""
        self._bodies, self._look, self._wait = [], None, 0
        for slot in range(SLOTS):
            self._bank.vacate(self._first + slot)

    def fill(self, readings: Array, noise: float, stamp_ns: int) -> None:
        """Take in one frame; every few frames a body may be replaced by a better one.

        All bodies are compared, and the hypothesis of the chosen one is computed, in parallel with
        the frames; it takes its slot in a later frame. The arguments are those of `Bank.evaluate`.
        """
        self._put_in(stamp_ns)
        if float((readings**2).mean()) < PRESENT * noise**2:
            return
        self._wait -= 1
        if self._wait > 0 or (self._look is not None and self._look[0].result() is not None):
            return
        self._wait = EVERY
        choice = BackgroundTask(partial(self._choose, readings, noise, (*self._bodies,)), stamp_ns)
        self._look = choice, BackgroundTask(partial(self._eigenbasis_of, choice), stamp_ns)

    def _eigenbasis_of(self, choice: BackgroundTask[Choice]) -> Eigenbasis | None:
        """Return the hypothesis of the chosen body; the thread that has chosen it calls this."""
        chosen = choice.result()
        if chosen is None:
            return None
        known = self._known.pop(body := chosen[1], None)
        if known is None:
            known = self._bank.eigenbasis(self._tables.body_prior(body))
            make_room(self._known, MOST_BODIES)
        self._known[body] = known  # the newest at the end
        return known

    def _put_in(self, stamp_ns: int) -> None:
        """Put a body into its slot whose time has come."""
        if self._look is None or not self._look[1].is_due(stamp_ns):
            return
        choice, eigenbasis = self._look[0].result(), self._look[1].result()
        self._look = None
        if choice is not None and eigenbasis is not None:
            slot, body = choice
            self._bank.replace_prior(self._first + slot, eigenbasis)
            self._bodies[slot : slot + 1] = [body]

    def _choose(self, readings: Array, noise: float, bodies: tuple[int, ...]) -> Choice:
        """Return the next slot to be filled and the body for it, beside those in slots."""
        scores = self._search.scores(readings, noise)
        order = np.argsort(-scores, kind='stable').tolist()
        best = next(body for body in order if body not in bodies)
        if len(bodies) < SLOTS:
            return len(bodies), best
        worst = min(range(SLOTS), key=lambda slot: float(scores[bodies[slot]]))
        return (worst, best) if scores[best] > scores[bodies[worst]] + SLOT_EVIDENCE else None


MOST_BANKS = 4
"""Banks of hypotheses, one for each set of usable coils, that are kept; the oldest is dropped."""


class Banks:
    """Keeps banks of hypotheses by the coils in use, with the slots for bodies of each.

    ``baseline`` (S, K): readings without the metal, T; NaN for a coil that has none.
    """

    def __init__(
        self, tables: RefitTables, baseline: ComplexArray, settings: RefitSettings
    ) -> None:
        self._tables = tables
        self._width = k = baseline.shape[1]
        turned = np.nan_to_num((baseline * tables.excitation.phase.conj()).real)
        scale = settings.emitter_drift / settings.accuracy.flux_noise_t
        self._drift = ((turned * scale)[:, :, None] * np.eye(k)).reshape(-1, k)
        self._known: dict[bytes, tuple[Bank, BodySlots]] = {}

    def of(self, in_use: Booleans) -> tuple[Bank, BodySlots]:
        """Return the hypotheses for the coils in use, bool (S,), and their slots."""
        key = in_use.tobytes()
        if key not in self._known:
            coils, k = np.flatnonzero(in_use), self._width
            rows = (coils[:, None] * k + np.arange(k)).ravel()
            make_room(self._known, MOST_BANKS)
            tables = self._tables
            bank = Bank(tables.priors, rows, self._drift, SLOTS, len(tables.bodies))
            self._known[key] = (bank, BodySlots(bank, tables))
            _worker().submit(bank.make_ready)  # saves a later frame time, changes no result
        return self._known[key]

    def forget(self) -> None:
        """Empty the slots of all banks."""
        for _, slots in self._known.values():
            slots.clear()


UNCHANGED = 0.99
"""Probability of no change from which on the calibrated model is active."""


class Belief:
    """Holds probabilities of the hypotheses; the first of them is that nothing has changed.

    ``persistence`` is the probability that the hypothesis of one frame still holds in the next.
    The ``weights`` (H,) are replaced, never changed in place.
    """

    def __init__(self, count: int, persistence: float) -> None:
        self._count, self._persistence = count, persistence
        self.forget()

    def forget(self) -> None:
        """Believe that nothing has changed."""
        self.weights = np.eye(self._count)[0]

    @property
    def may_have_changed(self) -> bool:
        """Return whether the field may have changed: the calibrated model does not hold then."""
        return bool(self.weights[0] < UNCHANGED)

    @property
    def log_odds(self) -> float:
        """Return the logarithm of the odds that something has changed."""
        nothing = self.weights[0]
        return float(np.log(max(1.0 - nothing, 1e-300)) - np.log(max(nothing, 1e-300)))

    def update(self, log_evidence: Array) -> None:
        """Take in a frame's evidence of each hypothesis, shape (H,)."""
        prior = self._persistence * self.weights
        prior += (1.0 - self._persistence) / len(prior)
        log_weight = np.log(prior) + log_evidence
        weights = np.exp(log_weight - log_weight.max())
        self.weights = weights / weights.sum()

    def update_by(self, names: Sequence[str], evidence: Mapping[str, float]) -> None:
        """Update the weights of the named hypotheses by other evidence of the same frame.

        Hypotheses that are not in it are ruled out, unless all are.
        """
        if not evidence:
            return
        gain = np.array([evidence.get(name, -np.inf) for name in names])
        weights = self.weights * np.exp(gain - gain.max())
        if weights.sum() > 0.0:
            self.weights = weights / weights.sum()
