"""The few compact bodies that are full hypotheses at present, chosen frame by frame.

Hundreds of compact bodies (`refit.clouds`) are too many to be judged in full in every frame. So
the bank has a few *slots*, places for one body each; a body that explains the readings better
takes over the slot of the one that explains them worst.
"""

import numpy as np
from numpy.typing import NDArray

from anser_ros.refit.evidence import STRENGTHS
from anser_ros.refit.posterior import Bank
from anser_ros.refit.search import BodySearch
from anser_ros.refit.tables import RefitTables

Array = NDArray[np.float64]

SLOTS = 3
"""Compact bodies that are full hypotheses at a time."""
BETTER = 3.0
"""Gain of approximate log evidence for which a body takes another's slot."""
EVERY = 4
"""Frames from one look at all bodies to the next."""
PRESENT = 1.15
"""Ratio of the readings' power to that of the noise below which no body is looked for."""


class BodySlots:
    """Fills the slots of a bank with the bodies that the readings support.

    Parameters
    ----------
    bank : Bank
        Its last `SLOTS` hypotheses are slots.
    tables : RefitTables
    """

    def __init__(self, bank: Bank, tables: RefitTables) -> None:
        self._bank, self._tables = bank, tables
        self._first = len(bank.priors) - SLOTS + 1
        self._search = BodySearch(tables.factors, bank.rows, bank.whitening, STRENGTHS[::2])
        self._bodies: list[int] = []
        self._wait = 0

    def clear(self) -> None:
        """Empty all slots of bodies."""
        self._bodies, self._wait = [], 0
        for slot in range(SLOTS):
            self._bank.vacate(self._first + slot)

    def fill(self, readings: Array, noise: float) -> None:
        """Take in one frame; every few frames a body may be replaced by a better one.

        Parameters
        ----------
        readings : ndarray, shape (n, 2)
            Change since the baseline in nominal noise deviations, real and imaginary part.
        noise : float
            Noise in units of the nominal one.
        """
        if float((readings**2).mean()) < PRESENT * noise**2:
            return
        self._wait -= 1
        if self._wait > 0:
            return
        self._wait = EVERY
        scores = self._search.scores(readings, noise)
        order = np.argsort(-scores, kind='stable').tolist()
        while len(self._bodies) < SLOTS:
            body = next(b for b in order if b not in self._bodies)
            self._bank.occupy(self._first + len(self._bodies), self._tables.body_prior(body))
            self._bodies.append(body)
        best = next(b for b in order if b not in self._bodies)
        worst = min(range(SLOTS), key=lambda slot: float(scores[self._bodies[slot]]))
        if scores[best] > scores[self._bodies[worst]] + BETTER:
            self._bank.occupy(self._first + worst, self._tables.body_prior(best))
            self._bodies[worst] = best
