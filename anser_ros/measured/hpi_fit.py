"""Fits places of the coils on a head, with the stray field of their leads and errors of the array.

A coil's tone is not the coil's alone: its lead runs along the head, and where it is not twisted
tightly it is a loop of its own, a hundredth of the coil and less, but close to other channels. A
lead is described by further dipoles, each found where the residual asks for it, as long as
channels left out are predicted better.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from anser_ros.measured.squid_array import ChipErrors, SquidArray, SquidWhitener, whitener

Array = NDArray[np.float64]

SCALE_M = 1e-2
"""Unit of the positions in the least-squares search, m, so that its unknowns are near one."""
ROUNDS = 5
"""Rounds of reweighting; each further one changes the weights of the chips less."""
REACH_M = 0.14
"""Half size of the grid of start positions, m: the size of a head."""
GRID_STEP_M = 0.02
"""Distance of neighbouring start positions, m: a fifth of a head's radius."""
GRID_GAP_M = (0.02, 0.12)
"""Smallest and largest distance of a start position from the nearest channel, m."""
LEAD_MOMENT = 3e-10
"""Plausible moment of a stretch of lead, A m^2: a few hundredths of a coil's."""
FREEDOM = 4.0
"""Degrees of freedom of the Student density of residuals, of a chip's together and of single
held-out channels; fewer give outliers less weight."""


@dataclass(frozen=True)
class CoilData:
    """Holds the signals of one tone.

    Attributes
    ----------
    signals : ndarray, shape (S,)
        In-phase amplitude of each channel, T or T/m.
    noise : ndarray, shape (S,)
        Its standard deviation, same unit.
    used : ndarray of bool, shape (S,)
    """

    signals: Array
    noise: Array
    used: NDArray[np.bool_]


@dataclass(frozen=True)
class CoilFit:
    """Describes one coil and the dipoles of its lead.

    Attributes
    ----------
    places_m : ndarray, shape (D, 3)
        The coil first, then its lead's dipoles.
    moments : ndarray, shape (D, 3)
        A m^2.
    predicted : ndarray, shape (S,)
    log_likelihood : float
        Of the used channels, chips by Student's t, up to a constant.
    power : float
        Mean squared whitened residual of the used channels.
    sigma_m : float
        Standard deviation of the coil's place (root of the covariance's trace), m.
    white : SquidWhitener
    """

    places_m: Array
    moments: Array
    predicted: Array
    log_likelihood: float
    power: float
    sigma_m: float
    white: SquidWhitener


def _design(array: SquidArray, places: Array) -> Array:
    return np.concatenate([array.signals(place) for place in places], axis=1)


def _linear(matrix: Array, right: Array) -> tuple[Array, Array]:
    """Moments by least squares of scaled columns, and the residual.

    The first three columns are the coil's; those of leads are held small by `LEAD_MOMENT`, one
    more residual each.
    """
    held = np.eye(matrix.shape[1])[3:] / LEAD_MOMENT
    matrix = np.vstack([matrix, held])
    right = np.concatenate([right, np.zeros(len(held))])
    scale = np.linalg.norm(matrix, axis=0)
    scaled = matrix / scale
    solution = np.linalg.lstsq(scaled, right, rcond=None)[0]
    return solution / scale, right - scaled @ solution


def first_place(array: SquidArray, data: CoilData, starts: Array) -> Array:
    """Return the place of a single dipole, m, channels weighted within their kind only.

    This is the plain fit: it knows no noise and no chip errors.
    """
    weight = np.where(data.used, 1.0, 0.0)
    for kind in (array.is_magnetometer, ~array.is_magnetometer):
        weight[kind] /= np.median(np.abs(data.signals[kind]))
    right = weight * data.signals

    def misfit(place: Array) -> Array:
        matrix = weight[:, None] * array.signals(SCALE_M * place)
        return _linear(matrix, right)[1] / np.linalg.norm(right)

    best = min(
        (least_squares(misfit, start / SCALE_M) for start in starts), key=lambda s: float(s.cost)
    )
    return np.asarray(SCALE_M * best.x)


def plain_fit(array: SquidArray, data: CoilData, place: Array) -> Array:
    """Return the readings (S,) that the plain fit's dipole predicts."""
    weight = np.where(data.used, 1.0, 0.0)
    for kind in (array.is_magnetometer, ~array.is_magnetometer):
        weight[kind] /= np.median(np.abs(data.signals[kind]))
    matrix = array.signals(place)
    moment, _ = _linear(weight[:, None] * matrix, weight * data.signals)
    return np.asarray(matrix @ moment)


def student_weight(white: SquidWhitener, left: Array) -> Array:
    """Return the weight of each chip, (C,): chips beside a stretch of lead that is not modelled
    count less.

    Student's t of the chip's three residuals together, `FREEDOM` degrees of freedom.
    Source: K. Lange et al., J. Am. Stat. Assoc. 84 (1989) 881.
    """
    power = np.sum(left.reshape(white.chips.shape) ** 2, axis=1)
    return np.asarray((FREEDOM + 3.0) / (FREEDOM + power))


def student_loss(left: Array, together: int) -> Array:
    """Return the negative log density of whitened residuals, up to a constant.

    Student's t with `FREEDOM` degrees of freedom, of so many neighbours together: shape (n,) for
    residuals (n together,).
    """
    power = np.sum(left.reshape(-1, together) ** 2, axis=1)
    return np.asarray(0.5 * (FREEDOM + together) * np.log1p(power / FREEDOM))


def fit_coil(
    array: SquidArray, data: CoilData, places: Array, errors: ChipErrors, rounds: int = ROUNDS
) -> CoilFit:
    """Fit the places of all dipoles; moments are eliminated, the covariance follows the coil."""
    places = np.asarray(places, dtype=float).reshape(-1, 3)
    matrix = _design(array, places)
    rough = 1.0 / np.hypot(data.noise, 0.03 * data.signals) * data.used
    moments, _ = _linear(rough[:, None] * matrix, rough * data.signals)
    weight = np.ones(len(array.chips))
    for _ in range(rounds):
        columns = array.chip_columns(places[0], moments[:3])
        white = whitener(array, data.noise, columns, matrix @ moments, errors, data.used)
        weight = student_weight(white, white.apply(data.signals - matrix @ moments))
        white = white.weighted(weight)
        right = white.apply(data.signals)

        def misfit(x: Array, white: SquidWhitener = white, right: Array = right) -> Array:
            return _linear(white.apply(_design(array, SCALE_M * x.reshape(-1, 3))), right)[1]

        solution = least_squares(misfit, places.ravel() / SCALE_M, max_nfev=12)
        places = SCALE_M * solution.x.reshape(-1, 3)
        matrix = _design(array, places)
        moments, left = _linear(white.apply(matrix), right)
    left = data.signals - matrix @ moments
    plain, left_white = white.weighted(1.0 / weight), white.apply(left)
    information = solution.jac.T @ solution.jac
    covariance = np.linalg.pinv(information)[:3, :3] * SCALE_M**2
    return CoilFit(
        places,
        moments.reshape(-1, 3),
        matrix @ moments,
        -float(student_loss(plain.apply(left), 3).sum()) - plain.half_log_det,
        float(left_white @ left_white) / int(data.used.sum()),
        float(np.sqrt(np.trace(covariance))),
        white,
    )


class LeadSearch:
    """Finds where a residual asks for one more dipole.

    Parameters
    ----------
    array : SquidArray
    """

    def __init__(self, array: SquidArray) -> None:
        line = np.arange(-REACH_M, REACH_M + 1e-9, GRID_STEP_M)
        grid = np.stack(np.meshgrid(line, line, line, indexing='ij'), axis=-1).reshape(-1, 3)
        middle = array.centres_m.mean(axis=0)
        grid = grid + np.array([0.0, 0.0, middle[2] - 0.03])
        gap = np.array([np.linalg.norm(array.centres_m - p, axis=1).min() for p in grid])
        self._grid = grid[(gap > GRID_GAP_M[0]) & (gap < GRID_GAP_M[1])]
        self._columns = np.concatenate([array.signals(p) for p in self._grid], axis=1)

    def place(self, data: CoilData, fit: CoilFit) -> Array:
        """Return the grid point, m, whose dipole explains most of a fit's whitened residual."""
        left = fit.white.apply(data.signals - fit.predicted)
        columns = fit.white.apply(self._columns).reshape(len(left), -1, 3)
        columns = columns / np.linalg.norm(columns, axis=0)
        normal = np.einsum('sgi,sgj->gij', columns, columns) + 1e-9 * np.eye(3)
        right = np.einsum('sgi,s->gi', columns, left)
        explained = np.einsum('gi,gi->g', right, np.linalg.solve(normal, right[..., None])[..., 0])
        return np.asarray(self._grid[int(np.argmax(explained))])


def grow_chain(
    array: SquidArray,
    data: CoilData,
    start: Array,
    errors: ChipErrors,
    leads: LeadSearch,
    most: int,
) -> list[CoilFit]:
    """Return fits with 0, 1, ... `most` dipoles of the lead, each grown from the one before."""
    chain = [fit_coil(array, data, start, errors)]
    for _ in range(most):
        place = leads.place(data, chain[-1])
        chain.append(fit_coil(array, data, np.vstack([chain[-1].places_m, place]), errors))
    return chain
