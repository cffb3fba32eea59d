"""Holds a recorded session as arrays; reading one from a file is the business of `wire.bag`."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from anser_ros.wire.setup import Setup


@dataclass(frozen=True)
class RecordedFluxes:
    """Holds the fluxes (F, S, K) of one topic, T, with flags (F, S), by ascending stamps (F,)."""

    stamp_ns: NDArray[np.int64]
    channel: NDArray[np.int64]
    flags: NDArray[np.int64]
    flux: NDArray[np.complex128]


@dataclass(frozen=True)
class PoseStream:
    """Holds poses of one topic: stamps (M,), positions (M, 3) in m, quaternions x y z w (M, 4)."""

    stamp_ns: NDArray[np.int64]
    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]


@dataclass(frozen=True)
class Bag:
    """Holds a recorded session: setup, fluxes, optical poses, and what was refused or lost."""

    path: str
    setup: Setup
    setup_text: str
    tool: RecordedFluxes | None
    reference: RecordedFluxes | None
    optical: dict[str, PoseStream]
    refused: dict[str, int] = field(default_factory=dict)
    lost: str = ''
