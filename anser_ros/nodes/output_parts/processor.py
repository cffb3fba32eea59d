"""Measures how busy the processors are, by the system and by this process."""

import os
import time

LEAST_S = 1.0
"""Least time, s, over which shares are taken: the system counts in ticks of 10 ms."""


class Processor:
    """Measures shares since the last look that was long enough ago."""

    def __init__(self) -> None:
        self._own_s, self._at_s = time.process_time(), time.monotonic()
        self._busy = _busy()
        self._shares = 0.0, 0.0

    def shares(self) -> tuple[float, float]:
        """Return this process's share of one processor, and how much of all is in use, 0 to 1."""
        now_s = time.monotonic()
        elapsed_s = now_s - self._at_s
        if elapsed_s >= LEAST_S:
            own_s, busy = time.process_time(), _busy()
            whole = max(busy[1] - self._busy[1], 1)
            self._shares = (own_s - self._own_s) / elapsed_s, (busy[0] - self._busy[0]) / whole
            self._own_s, self._at_s, self._busy = own_s, now_s, busy
        return self._shares


def _busy() -> tuple[int, int]:
    """Ticks in use and all ticks since the start of the system; zeros where it does not tell."""
    if not os.path.exists('/proc/stat'):
        return 0, 0
    with open('/proc/stat', encoding='ascii') as lines:
        ticks = [int(text) for text in lines.readline().split()[1:9]]
    # user, nice, system, idle, iowait, irq, softirq, steal
    return sum(ticks) - ticks[3] - ticks[4], sum(ticks)
