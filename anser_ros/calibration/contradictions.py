"""Finds sessions of one tool that disagree about its sensors.

Every session gets its own parameters about the joint estimate, beside the field that all share.
The values that two sessions give for a sensor must agree within their uncertainty. Clocks are left
out, because an optical tracker that was restarted legitimately has another offset.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from anser_ros.calibration.joint_system import Eliminated
from anser_ros.calibration.population import Likelihood, solve
from anser_ros.calibration.sensor_parameters import CLOCKS, EACH, PRIOR, USEFUL, SensorParameters
from anser_ros.field.measurements import Measurements

Array = NDArray[np.float64]

CERTAIN = 6.0
"""Standard deviations between two sessions from which on they contradict each other: a value of a
normal variable is that far out once in a billion."""
NOTICEABLE = 0.5
"""Share of the useful size of a parameter (`USEFUL`) below which a difference is not reported: it
moves poses by less than a tenth of a millimetre."""


@dataclass(frozen=True)
class Contradiction:
    """Names a sensor, or body, of which two sessions say different things."""

    kind: str  # of `sensor_parameters.KINDS`
    place: str  # name of the sensor, or of the body
    # size, sigma: difference and its standard deviation, in the parameter's unit
    size: float
    sigma: float
    sessions: tuple[int, int]  # which of the measurements


def contradictions(
    parts: Sequence[Measurements], kinds: Sequence[str], sums: Callable[..., Eliminated]
) -> tuple[Contradiction, ...]:
    """Return of what two sessions say different things, the worst pair of each once.

    ``parts``: one a body and session, corrected by the joint estimate. ``sums``: given parameters
    and measurements, what these say about the parameters, with the field unknown.
    """
    bodies = [part.body for part in parts]
    if len(set(bodies)) == len(bodies):
        return ()
    apart = [replace(part, body=str(i)) for i, part in enumerate(parts)]
    parameters = SensorParameters(apart, [kind for kind in kinds if kind not in CLOCKS])
    rest = sums(parameters, apart)
    width = np.empty(len(parameters))
    for kind in parameters.kinds:
        width[parameters.rows(kind)] = PRIOR[kind]
    inflation = max(1.0, rest.inflation)
    information = rest.information / inflation + parameters.rule()
    posterior = solve(Likelihood(information, rest.gradient / inflation), width)
    change, covariance = posterior.values, posterior.covariance
    worst: dict[tuple[str, str], Contradiction] = {}
    for i, j in combinations(range(len(bodies)), 2):
        if bodies[i] != bodies[j]:
            continue
        for kind in parameters.kinds:
            for name, one, other in _pairs(parameters, kind, i, j):
                difference = change[one] - change[other]
                variance = covariance[one, one] + covariance[other, other]
                variance = variance - 2.0 * covariance[one, other]
                sigma = float(np.sqrt(variance[int(np.argmax(np.abs(difference)))]))
                size = float(np.linalg.norm(difference))
                found = Contradiction(kind, name or bodies[i], size, sigma, (i, j))
                known = worst.get((kind, found.place))
                if size < max(NOTICEABLE * USEFUL[kind], CERTAIN * sigma):
                    continue
                if known is None or size / sigma > known.size / known.sigma:
                    worst[kind, found.place] = found
    return tuple(worst.values())


def _pairs(
    parameters: SensorParameters, kind: str, i: int, j: int
) -> list[tuple[str, NDArray[np.int64], NDArray[np.int64]]]:
    """Each sensor's name (none for a body's own) with its rows for two of the measurements."""
    slices = [parameters.slices[kind, str(index)] for index in (i, j)]
    one, other = (np.arange(s.start, s.stop) for s in slices)
    if kind not in EACH:
        return [('', one, other)]
    each = EACH[kind]
    return list(
        zip(parameters.tables[i].name, one.reshape(-1, each), other.reshape(-1, each), strict=True)
    )
