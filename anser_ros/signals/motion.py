"""Finds rates of change of the fluxes from earlier windows, for windows too short to fit them."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

REACH_S = 0.03
"""Time over which the straight line is fitted, s. A tool's velocity hardly changes meanwhile; a
shorter time makes the slopes noisier, a longer one makes them late."""
LONGEST_WINDOW_GAP_S = 0.05
"""Longest time from one window to the next, s; after a longer gap the windows before it say
nothing about the present motion."""
FEWEST_WINDOWS = 3
"""Windows that a slope needs at least, so that the noise of a single one does not make it."""


class FluxRates:
    """Finds the slopes of the fluxes over the last windows, by a straight line through them.

    Over `REACH_S` the slopes are determined so well that subtracting their effect from a short
    window adds hardly any noise.
    """

    def __init__(self) -> None:
        self._past: deque[tuple[float, NDArray[np.complex128]]] = deque()

    def add(self, time_s: float, flux: NDArray[np.complex128]) -> None:
        """Take in the fluxes (S, K), T, of a window at the time of its middle.

        A gap or a step back in time discards the windows before.
        """
        past = self._past
        if past and not 0 < time_s - past[-1][0] <= LONGEST_WINDOW_GAP_S:
            past.clear()
        past.append((time_s, flux))
        while len(past) > FEWEST_WINDOWS and time_s - past[0][0] > REACH_S:
            past.popleft()

    def at(self, time_s: float) -> NDArray[np.complex128] | None:
        """Return the rates (S, K), T/s, at a time, or None without enough recent windows."""
        past = self._past
        if len(past) < FEWEST_WINDOWS or not 0 < time_s - past[-1][0] <= LONGEST_WINDOW_GAP_S:
            return None
        times = np.array([moment for moment, _ in past])
        weights = times - times.mean()
        weights /= weights @ weights
        return np.asarray(np.tensordot(weights, np.array([flux for _, flux in past]), axes=1))
