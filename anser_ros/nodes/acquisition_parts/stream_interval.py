"""Counts what the acquisition has published since its last status."""

from dataclasses import dataclass

import numpy as np

from anser_ros.nodes.acquisition_parts.flux_frame import FluxFrame, Staleness


@dataclass
class Interval:
    """Counts what happened since the last diagnostics."""

    begin_s: float
    frames: int = 0
    delay_sum_s: float = 0.0
    delay_max_s: float = 0.0
    flags: np.ndarray | None = None
    staleness: Staleness | None = None
    repeats: int = 0

    def add(self, frame: FluxFrame, delay_s: float) -> None:
        """Note a published frame."""
        self.frames += 1
        self.delay_sum_s += delay_s
        self.delay_max_s = max(self.delay_max_s, delay_s)
        flags, now = self.flags, frame.staleness
        if flags is not None and flags.shape == frame.flags.shape:
            self.flags = flags | frame.flags
            self.staleness = self.staleness | now if self.staleness else now
        else:
            self.flags, self.staleness = frame.flags, now
        self.repeats += frame.repeats
