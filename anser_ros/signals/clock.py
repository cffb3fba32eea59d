"""Maps the device's clock to the host's by the earliest arrivals."""

from __future__ import annotations

FOLLOWED_SHARE = 1e-4
"""More than two quartz clocks drift apart: how fast the estimate follows a slow device clock."""
_JUMP_NS = 1_000_000_000
_STALL_NS = 3_000_000_000


class DeviceClock:
    """Host time of device timestamps.

    Every arrival is late by an unknown delay that is never negative, so the smallest difference
    seen between arrival and device time is the best estimate of the offset. The estimate may rise
    by `FOLLOWED_SHARE`, so that it follows a slow device clock and forgets an early outlier.

    Parameters
    ----------
    tick_hz : rate of the device's timestamp counter
    """

    def __init__(self, tick_hz: float) -> None:
        self._ns_per_tick = 1e9 / tick_hz
        self._offset_ns: float | None = None
        self._last_device_ns = 0.0
        self._late_from_ns: float | None = None
        self.jumps = 0

    def observe(self, ticks: float, arrival_ns: int) -> None:
        """Note that device time `ticks` was already past at host time `arrival_ns`.

        Device time that runs backwards, or leaps ahead of the host's by more than a second, starts
        the estimate anew. One that is a second behind may be a host that stalled: only when that
        lasts for three seconds has the clock changed.
        """
        device_ns = ticks * self._ns_per_tick
        offset = arrival_ns - device_ns
        if self._offset_ns is not None:
            elapsed = device_ns - self._last_device_ns
            risen = self._offset_ns + FOLLOWED_SHARE * max(elapsed, 0.0)
            if (
                elapsed < 0
                or risen - offset > _JUMP_NS
                or self._is_behind(offset - risen, device_ns)
            ):
                self.jumps += 1
                self._late_from_ns = None
            else:
                offset = min(offset, risen)
        self._offset_ns = offset
        self._last_device_ns = device_ns

    def _is_behind(self, late_ns: float, device_ns: float) -> bool:
        """Whether all arrivals for long have been so late that the clock must have changed."""
        if late_ns <= _JUMP_NS:
            self._late_from_ns = None
        elif self._late_from_ns is None:
            self._late_from_ns = device_ns
        return self._late_from_ns is not None and device_ns - self._late_from_ns > _STALL_NS

    def host_ns(self, ticks: float) -> int:
        """Host time at device time `ticks`, in the clock of the arrivals; 0 before the first."""
        if self._offset_ns is None:
            return 0
        return round(ticks * self._ns_per_tick + self._offset_ns)
