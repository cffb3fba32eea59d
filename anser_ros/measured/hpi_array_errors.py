"""Finds errors that all chips of a SQUID array share, weighed by the likelihood of the signals.

Nothing here sees where the coils were digitised: the likelihood of the channels' signals chooses,
with half the logarithm of the number of signals as the price of a parameter, and the logarithm of
the number of candidates as the price of having looked at all of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.measured.hpi_fit import CoilData, CoilFit, fit_coil
from anser_ros.measured.squid_array import ChipErrors, SquidArray

Array = NDArray[np.float64]

STEPS = {
    'array_offset': 5e-4,
    'array_scale': 5e-3,
    'magnetometer_size': 0.05,
    'gradiometer_size': 0.01,
    'gradiometer_gain': 0.01,
}
"""Step of each shared error by which the likelihood is searched, in the unit of the error."""
UNITS = {'array_offset': 'm'}
PLACES_M = (1e-4, 2e-4, 3e-4, 5e-4, 8e-4)
"""Standard deviations of a chip's place that are tried, m, around the accuracy of the survey."""
TILTS_RAD = (5e-3, 1e-2, 2e-2, 3e-2)
"""Standard deviations of a chip's tilt that are tried, rad."""
GAINS = (0.0, 0.01, 0.02, 0.03)
"""Standard deviations of a channel's gain that are tried, relative."""
START = ChipErrors(3e-4, 0.01, 0.01)
"""Errors of the chips from which the search starts, in the middle of the values that are tried."""


@dataclass(frozen=True)
class SharedError:
    """Describes one candidate for an error that all chips share.

    Attributes
    ----------
    name : str
    value, sigma : float
        Where the likelihood is largest, and its width; m or relative.
    gain : float
        Gain of the log likelihood over the array as surveyed, there.
    price : float
        What a parameter must gain at least.
    fits : tuple of CoilFit
        All coils with this error.
    """

    name: str
    value: float
    sigma: float
    gain: float
    price: float
    fits: tuple[CoilFit, ...]


def refit(
    array: SquidArray, coils: Sequence[CoilData], fits: Sequence[CoilFit], errors: ChipErrors
) -> tuple[CoilFit, ...]:
    """Fit all coils again, starting from where they are."""
    return tuple(
        fit_coil(array, data, fit.places_m, errors, 4)
        for data, fit in zip(coils, fits, strict=True)
    )


def likelihood(fits: Sequence[CoilFit]) -> float:
    """Return the log likelihood of all coils together."""
    return float(sum(fit.log_likelihood for fit in fits))


def choose_chip_errors(
    array: SquidArray, coils: Sequence[CoilData], fits: Sequence[CoilFit], start: ChipErrors
) -> tuple[ChipErrors, tuple[CoilFit, ...]]:
    """Chip errors of the largest likelihood, one kind after the other over a short list."""
    best, found = start, refit(array, coils, fits, start)
    top = likelihood(found)
    for _ in range(2):
        before = best
        trials = [
            *(ChipErrors(value, best.tilt_rad, best.gain) for value in PLACES_M),
            *(ChipErrors(best.place_m, value, best.gain) for value in TILTS_RAD),
            *(ChipErrors(best.place_m, best.tilt_rad, value) for value in GAINS),
        ]
        for trial in trials:
            trial = ChipErrors(
                trial.place_m if trial.place_m != before.place_m else best.place_m,
                trial.tilt_rad if trial.tilt_rad != before.tilt_rad else best.tilt_rad,
                trial.gain if trial.gain != before.gain else best.gain,
            )
            fitted = refit(array, coils, found, trial)
            if likelihood(fitted) > top:
                best, found, top = trial, fitted, likelihood(fitted)
        if best == before:
            break
    return best, found


def weigh(
    array: SquidArray,
    coils: Sequence[CoilData],
    fits: Sequence[CoilFit],
    errors: ChipErrors,
    name: str,
) -> SharedError:
    """Return the likelihood of one shared error: a parabola through three values, then at
    its top.
    """
    here, step = likelihood(refit(array, coils, fits, errors)), STEPS[name]
    ends = [
        likelihood(refit(array.changed({name: sign * step}), coils, fits, errors))
        for sign in (-1.0, 1.0)
    ]
    slope, bend = (ends[1] - ends[0]) / (2.0 * step), (ends[0] + ends[1] - 2.0 * here) / step**2
    value = slope / -bend if bend < 0.0 else step * float(np.sign(slope))
    value = float(np.clip(value, -4.0 * step, 4.0 * step))
    top = refit(array.changed({name: value}), coils, fits, errors)
    sigma = float(1.0 / np.sqrt(-bend)) if bend < 0.0 else float('nan')
    count = sum(int(data.used.sum()) for data in coils)
    price = 0.5 * float(np.log(count)) + float(np.log(len(STEPS)))
    return SharedError(name, value, sigma, likelihood(top) - here, price, top)
