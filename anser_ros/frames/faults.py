"""Lists why a reading must not be used: every fault with its name, its state and its reason.

A reading is one sensor's fluxes of all emitters in one frame. Its first fault in the order of
`FAULTS` counts. The flag bits are those of `wire.points`.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from anser_ros import pose_states as states
from anser_ros.arrays import ComplexArray, Integers
from anser_ros.physics.sensor import LARGEST_FLUX_T
from anser_ros.wire import points


class Fault(NamedTuple):
    """Describes one kind of fault by its name, state and reason."""

    kind: str  # Its name in the counters: ``readings_<kind>``
    state: str  # The state of a pose that the reading was for
    reason: str  # What `/diagnostics` says of it


GOOD = 0
"""Code of a reading without a fault; the codes of faults are their places in `FAULTS`."""
MISSING_CODE, SATURATED_CODE, STALE_CODE, DROPPED_CODE, FLAGGED_CODE = 1, 2, 3, 4, 5
"""Codes of what the frame itself says: no such channel, or a flag."""
FLAG_CODES = (
    (points.SATURATED, SATURATED_CODE),
    (points.STALE, STALE_CODE),
    (points.DROPPED, DROPPED_CODE),
)
"""Flag bits and their codes; the first that is set counts. Any other bit is `FLAGGED_CODE`."""
NOT_FINITE_CODE, ABSURD_CODE = 6, 7
"""Codes of what the values say."""
STUCK_CODE = 8
"""Code of what earlier readings say: this one repeats one of them."""

FAULTS: tuple[Fault | None, ...] = (
    None,
    Fault('missing', states.STALE, 'its channel is not in the frame'),
    Fault('saturated', states.SATURATED, 'flagged saturated by the acquisition'),
    Fault('stale', states.STALE, 'flagged stale by the acquisition'),
    Fault('dropped', states.DROPPED, 'flagged dropped by the acquisition'),
    Fault('flagged', states.NO_SIGNAL, 'flagged by the acquisition with an unknown bit'),
    Fault('not_finite', states.NO_SIGNAL, 'the fluxes are not finite'),
    Fault('absurd', states.NO_SIGNAL, f'fluxes beyond {LARGEST_FLUX_T:g} T are implausible'),
    Fault('stuck', states.STALE, 'stuck: the same reading as before'),
)


def value_codes(flux: ComplexArray) -> Integers:
    """Return what the values of readings (..., K), T, say about them.

    Each is `GOOD`, `NOT_FINITE_CODE` or `ABSURD_CODE`.
    """
    with np.errstate(invalid='ignore'):
        largest = np.maximum(np.abs(flux.real), np.abs(flux.imag)).max(axis=-1, initial=0.0)
    codes = np.where(largest < LARGEST_FLUX_T, GOOD, ABSURD_CODE)
    return np.where(np.isfinite(largest), codes, NOT_FINITE_CODE)


def reading_codes(flux: ComplexArray, flags: NDArray[np.integer[Any]]) -> Integers:
    """Return what is wrong with recorded readings, as `frames.intake` says it of live ones.

    ``flux`` (..., K) in T and ``flags`` (...) of `wire.points`, where a channel that is not in its
    frame has `STALE` and NaN, make places in `FAULTS`; `GOOD` for readings that can be used.
    """
    codes = np.where(flags == 0, value_codes(flux), FLAGGED_CODE)
    for bit, code in reversed(FLAG_CODES):
        codes[(flags & bit) != 0] = code
    return codes
