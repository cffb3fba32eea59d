"""How fast fluxes change, from the windows before: for windows too short to tell it themselves."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

REACH_S = 0.03
LONGEST_GAP_S = 0.05
LEAST = 3


class FluxRates:
    """Slopes of the fluxes over the last windows, by a straight line through them.

    Over `REACH_S` a tool's velocity hardly changes, and the slopes are known so well that what
    they take off a short window adds next to no noise.
    """

    def __init__(self) -> None:
        self._past: deque[tuple[float, NDArray[np.complex128]]] = deque()

    def add(self, time_s: float, flux: NDArray[np.complex128]) -> None:
        """Take a window's fluxes (S, K) at its middle; a gap or step back in time starts anew."""
        past = self._past
        if past and not 0 < time_s - past[-1][0] <= LONGEST_GAP_S:
            past.clear()
        past.append((time_s, flux))
        while len(past) > LEAST and time_s - past[0][0] > REACH_S:
            past.popleft()

    def at(self, time_s: float) -> NDArray[np.complex128] | None:
        """Rates (S, K), T/s; None until there are three windows not long ago."""
        past = self._past
        if len(past) < LEAST or not 0 < time_s - past[-1][0] <= LONGEST_GAP_S:
            return None
        times = np.array([moment for moment, _ in past])
        weights = times - times.mean()
        weights /= weights @ weights
        return np.asarray(np.tensordot(weights, np.array([flux for _, flux in past]), axes=1))
