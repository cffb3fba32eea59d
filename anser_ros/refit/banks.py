"""Keeps the hypotheses for each set of reference coils that is in use, each computed once."""

import numpy as np
from numpy.typing import NDArray

from anser_ros.refit.background import begin_in_background
from anser_ros.refit.posterior import Bank
from anser_ros.refit.slots import SLOTS, BodySlots
from anser_ros.refit.tables import RefitTables
from anser_ros.settings import RefitSettings

Array = NDArray[np.float64]

MOST_BANKS = 4
"""Banks of hypotheses, one for each set of usable coils, that are kept; the oldest is dropped.
Fewer, and coils that come and go cost a bank each time; more only cost memory."""


class Banks:
    """Keeps banks of hypotheses by the coils in use, with the slots for bodies of each.

    ``baseline`` (S, K): readings without the metal, T; NaN for a coil that has none.
    """

    def __init__(
        self, tables: RefitTables, baseline: NDArray[np.complex128], settings: RefitSettings
    ) -> None:
        self._tables = tables
        self._width = k = baseline.shape[1]
        turned = baseline * tables.excitation.phase.conj()
        scale = settings.emitter_drift / settings.accuracy.flux_noise_t
        self._drift = np.zeros((baseline.size, k))
        for emitter in range(k):
            self._drift[emitter::k, emitter] = np.nan_to_num(turned[:, emitter].real) * scale
        self._known: dict[bytes, tuple[Bank, BodySlots]] = {}

    def of(self, in_use: NDArray[np.bool_]) -> tuple[Bank, BodySlots]:
        """Return the hypotheses for the coils in use, bool (S,), and their slots."""
        key = in_use.tobytes()
        if key not in self._known:
            coils, k = np.flatnonzero(in_use), self._width
            rows = (coils[:, None] * k + np.arange(k)).ravel()
            if len(self._known) >= MOST_BANKS:
                del self._known[next(iter(self._known))]
            tables = self._tables
            bank = Bank(tables.priors, rows, self._drift, SLOTS, len(tables.bodies))
            self._known[key] = (bank, BodySlots(bank, tables))
            begin_in_background(bank.make_ready)
        return self._known[key]

    def forget(self) -> None:
        """Empty the slots of all banks."""
        for _, slots in self._known.values():
            slots.clear()
