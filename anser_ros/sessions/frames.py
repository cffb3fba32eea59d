"""Yields a recorded session as the frames that its nodes received, one after the other."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.measurements import Measurements
from anser_ros.sessions.session import Session
from anser_ros.stamps import NANO

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class FrameReadings:
    """Holds what S sensors read in one frame: channels, fluxes (S, K), T, and flag bits."""

    channels: NDArray[np.int64]
    flux: ComplexArray
    flags: NDArray[np.int64]

    def in_phase(self) -> 'FrameReadings':
        """Return the readings without the fluxes' quadrature parts."""
        return replace(self, flux=self.flux.real.astype(complex))


@dataclass(frozen=True)
class SessionFrame:
    """Holds all that tools or references, or both, measured under one stamp."""

    stamp_ns: int
    tools: FrameReadings | None
    reference: FrameReadings | None


def frames_of(session: Session) -> Iterator[SessionFrame]:
    """Yield every stamp of a session in order, with what was measured under it."""
    rows: dict[float, tuple[list[tuple[Measurements, int]], list[int]]] = {}
    for tool in session.tools:
        for row, time in enumerate(tool.time.tolist()):
            rows.setdefault(time, ([], []))[0].append((tool, row))
    if session.reference is not None:
        for row, time in enumerate(session.reference.time.tolist()):
            rows.setdefault(time, ([], []))[1].append(row)
    for time in sorted(rows):
        tools, references = rows[time]
        reference = None
        if session.reference is not None and references:
            reference = _readings([(session.reference, references[0])])
        yield SessionFrame(
            session.start_ns + round(time / NANO), _readings(tools) if tools else None, reference
        )


def _readings(rows: list[tuple[Measurements, int]]) -> FrameReadings:
    return FrameReadings(
        np.concatenate([body.sensors.channel for body, _ in rows]),
        np.concatenate([body.flux[row] for body, row in rows]),
        np.concatenate([body.flags[row] for body, row in rows]),
    )
