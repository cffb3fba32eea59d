"""Makes faults of the line between control unit and host that a simulator can be asked for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from anser_ros.simulation.control_unit import Piece

NONE = 'none'
UNPLUG = 'unplug'
OVERRUN = 'overrun'
SATURATION = 'saturation'
FAULTS = (
    NONE, 'bad_crc', 'gap', 'garbage', 'wrong_baud', 'silence', UNPLUG, OVERRUN, SATURATION,
)  # fmt: skip
_BURST_BYTES = 700
"""Length of a burst of garbage: about as long as a block of samples, so that it may hold bytes
that look like the begin of a record."""
_LASTS_S = {'wrong_baud': 2.5, 'silence': 2.5, UNPLUG: 1.0, OVERRUN: 0.1, SATURATION: 1.0}
"""Duration of each lasting fault, s. The first two outlast the host's patience, so that it notices
them; the others last long enough for several blocks."""


class FaultInjector:
    """Damages the records on the line once in every period.

    `bad_crc`, `gap` and `garbage` affect one block, the others last for some time. The owner of
    the unit and of its port has to act on `unplug`, `overrun` (the unit has no room for its
    blocks) and `saturation` (of its first channel) while they last.
    """

    def __init__(self, kind: str = NONE, period_s: float = 5.0, seed: int = 0) -> None:
        self.kind = kind
        self.period_s = period_s
        self._rng = np.random.default_rng(seed)
        self._done = -1

    def lasts(self, time_s: float, kind: str) -> bool:
        """Return whether the lasting fault `kind` is on at a time; each period begins with it."""
        in_period = time_s % self.period_s
        return self.kind == kind and in_period < min(_LASTS_S[kind], self.period_s / 2)

    def apply(self, pieces: Sequence[Piece], time_s: float) -> list[Piece]:
        """Return the records as they arrive."""
        if self.kind in ('bad_crc', 'gap', 'garbage'):
            return self._damage_one(pieces, int(time_s // self.period_s))
        if self.kind == 'silence' and self.lasts(time_s, 'silence'):
            return []
        if self.kind == 'wrong_baud' and self.lasts(time_s, 'wrong_baud'):
            return [Piece(self._garble(p.data), p.is_block) for p in pieces]
        return list(pieces)

    def _damage_one(self, pieces: Sequence[Piece], period: int) -> list[Piece]:
        arrived = []
        for piece in pieces:
            if piece.is_block and period != self._done:
                self._done = period
                if self.kind == 'gap':
                    continue
                if self.kind == 'garbage':
                    arrived.append(Piece(self._noise(_BURST_BYTES)))
                else:
                    damaged = bytearray(piece.data)
                    damaged[len(damaged) // 2] ^= 0x10
                    arrived.append(Piece(bytes(damaged), is_block=True))
                    continue
            arrived.append(piece)
        return arrived

    def _garble(self, data: bytes) -> bytes:
        """Return what a receiver at another baud rate gets: fewer bytes, all of them wrong."""
        return self._noise(max(1, len(data) // 3))

    def _noise(self, count: int) -> bytes:
        return bytes(self._rng.integers(0, 256, count, dtype=np.uint8))
