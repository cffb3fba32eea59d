"""Compares the device's ticks with its samples: they share a clock and must advance together."""

from __future__ import annotations

_SLACK_SAMPLES = 2.0
"""Difference, samples, that rounding of ticks may make. Smaller, coarse ticks are accused; larger,
small jumps are not seen."""
_SLACK_SHARE = 5e-4
"""Relative difference up to which ticks and samples run at one pace. What a device says of its
rates is rounded less than that, and two quartz clocks differ by a fifth of it."""
_REFERENCE_S = 1.0
"""Time, s, over which the two are compared: a wrong pace of 1 % shows after 5 ms, and one of 0.1 %
after a tenth of this."""
_TRUST_S = 0.2
"""Time, s, that ticks must agree before they are believed again about lost blocks."""
_AGAIN_S = 0.1
"""Disagreements closer together than this, s, are a wrong pace, others are jumps."""
_HOLE_TOLERANCE = 0.01
"""Relative difference up to which a hole's length by ticks and by sequence number agree. It is far
above the rate error of any clock and below one block in a hundred."""
_LONGEST_HOLE_S = 10.0
"""Longest hole, s, that the sequence number alone may tell of while ticks are not believed. After
a longer one little is lost by starting again."""
_WRAP = 2**32
"""Ticks after which a 32-bit counter begins again."""


class TickCheck:
    """Compares the advance of ticks with that of samples while no block is missing.

    The stamps follow from the samples; ticks only confirm how many blocks were lost.

    Parameters
    ----------
    sample_rate_hz, tick_hz : float
        Samples and ticks a second, as the device states them.

    Attributes
    ----------
    trusted : bool
        Whether ticks may confirm the length of a hole.
    words : str
        What is wrong with the ticks, for an operator; empty while nothing is.
    disagreements : int
        How often ticks that had agreed did not.
    """

    def __init__(self, sample_rate_hz: float, tick_hz: float) -> None:
        self._rate_hz, self._per_tick = sample_rate_hz, sample_rate_hz / tick_hz
        self.disagreements = 0
        self.reset()

    def reset(self) -> None:
        """Begin a new stream."""
        self.trusted, self.words = True, ''
        self._reference: tuple[int, int] | None = None
        self._last_ticks = 0
        self._agrees_from = 0
        self._disagreed_at: int | None = None

    def take(self, sample: int, ticks: int) -> None:
        """Take the ticks of a block whose first sample has a number."""
        if self._reference is None:
            self._begin(sample, ticks)
            return
        since, from_ticks = self._reference
        elapsed = sample - since
        advance = self._advance(from_ticks, ticks, elapsed)
        if abs(advance - elapsed) > _SLACK_SAMPLES + _SLACK_SHARE * elapsed:
            self._disagree(sample, ticks, advance, elapsed)
            self._begin(sample, ticks)
        elif elapsed > _REFERENCE_S * self._rate_hz:
            self._begin(sample, ticks)
        if not self.trusted and sample - self._agrees_from > _TRUST_S * self._rate_hz:
            self.trusted, self.words = True, ''
        self._last_ticks = ticks

    def take_after_hole(self, sample: int, ticks: int) -> None:
        """Take the ticks of the first block after a hole, which was judged already."""
        self._begin(sample, ticks)

    def confirms(self, samples: int, ticks: int) -> bool:
        """Return whether a block `samples` after the last one may have these ticks."""
        if not self.trusted:
            return samples <= _LONGEST_HOLE_S * self._rate_hz
        advance = self._advance(self._last_ticks, ticks, samples)
        return abs(advance - samples) <= 1 + _HOLE_TOLERANCE * samples

    def _begin(self, sample: int, ticks: int) -> None:
        self._reference, self._last_ticks = (sample, ticks), ticks

    def _advance(self, before: int, ticks: int, samples: int) -> float:
        """Samples that pass from one count of ticks to another; a 32-bit counter may wrap."""
        plain = (ticks - before) * self._per_tick
        wrapped = (ticks - before) % _WRAP * self._per_tick
        return min(plain, wrapped, key=lambda advance: abs(advance - samples))

    def _disagree(self, sample: int, ticks: int, advance: float, elapsed: int) -> None:
        again = self._disagreed_at is not None and (
            sample - self._disagreed_at < _AGAIN_S * self._rate_hz
        )
        if ticks == self._last_ticks:
            self.words = 'stand still'
        elif again:
            self.words = f'run at {advance / elapsed:.4g} times the pace of the samples'
        else:
            self.words = f'jumped by {(advance - elapsed) / self._rate_hz:.3g} s'
        if self.trusted:
            self.disagreements += 1
        self.trusted, self._agrees_from, self._disagreed_at = False, sample, sample
