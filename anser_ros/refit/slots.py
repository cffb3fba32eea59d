"""Chooses, frame by frame, the few compact bodies that are full hypotheses at present.

Hundreds of compact bodies (`refit.clouds`) are too many to be judged in full in every frame. So
the bank has a few *slots*, places for one body each; a body that explains the readings better
takes over the slot of the one that explains them worst.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros.refit.background import BackgroundTask
from anser_ros.refit.evidence import STRENGTHS
from anser_ros.refit.posterior import Bank, Eigenbasis, make_room
from anser_ros.refit.search import BodySearch
from anser_ros.refit.tables import RefitTables

Array = NDArray[np.float64]

SLOTS = 3
"""Compact bodies that are full hypotheses at a time: two that explain the readings alike, and one
more that may be better. Each costs the posterior of a source in every frame."""
SLOT_EVIDENCE = 3.0
"""Gain of approximate log evidence for which a body takes another's slot: odds of twenty to one,
so that two that explain alike do not take turns."""
EVERY = 4
"""Frames from one look at all bodies to the next. In 80 ms at 50 Hz metal in a hand moves some 2
cm, a third of the distance between neighbouring bodies (`clouds.BODY_SPACING`)."""
MOST_BODIES = 16
"""Bodies whose hypotheses are kept once worked out, 3 MB and 17 ms each: of a disc that comes and
goes, again and again, 16 answer two thirds of the requests, and 24 no more."""
PRESENT = 1.15
"""Ratio of the readings' power to that of the noise below which no body is looked for: noise of 32
references and eight emitters exceeds it in one frame of 100."""


Choice = tuple[int, int] | None
"""A slot and the body for it; None if there is no better one than those that have slots."""


class _Look(NamedTuple):
    """A look at all bodies, and the hypothesis of the body that it chooses, if any."""

    choice: BackgroundTask[Choice]
    eigenbasis: BackgroundTask[Eigenbasis | None]


class BodySlots:
    """Fills the slots of a bank with the bodies that the readings support.

    ``bank``: its last `SLOTS` hypotheses are slots.
    """

    def __init__(self, bank: Bank, tables: RefitTables) -> None:
        self._bank, self._tables = bank, tables
        self._first = len(bank.priors) - SLOTS + 1
        self._search = BodySearch(tables.factors, bank.rows, bank.whitening, STRENGTHS[::2])
        self._bodies: list[int] = []
        self._look: _Look | None = None
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
        if self._wait > 0 or (self._look is not None and self._look.choice.result() is not None):
            return
        self._wait = EVERY
        choice = BackgroundTask(partial(self._choose, readings, noise, (*self._bodies,)), stamp_ns)
        self._look = _Look(choice, BackgroundTask(partial(self._eigenbasis_of, choice), stamp_ns))

    def _eigenbasis_of(self, choice: BackgroundTask[Choice]) -> Eigenbasis | None:
        """Return the hypothesis of the chosen body; the thread that has chosen it calls this."""
        chosen = choice.result()
        return None if chosen is None else self._eigenbasis(chosen[1])

    def _eigenbasis(self, body: int) -> Eigenbasis:
        """Return the hypothesis of a body; one thread in the background calls it."""
        known = self._known.pop(body, None)
        if known is None:
            known = self._bank.eigenbasis(self._tables.body_prior(body))
            make_room(self._known, MOST_BODIES)
        self._known[body] = known  # the newest at the end
        return known

    def _put_in(self, stamp_ns: int) -> None:
        """Put a body into its slot whose time has come."""
        look = self._look
        if look is None or not look.eigenbasis.is_due(stamp_ns):
            return
        self._look = None
        choice, eigenbasis = look.choice.result(), look.eigenbasis.result()
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
