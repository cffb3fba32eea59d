"""Fits dipoles, sensor errors, plate poses, plate bends and metal jointly to plates at heights.

One Gauss-Newton for all of it. Each sensor's own errors touch only its own readings, so they are
marginalised: they widen that sensor's noise covariance, and what is left is one generalised
least-squares problem in the moments, the plates' states and the metal's places (Schur complement;
Golub and Van Loan, Matrix Computations, section 3.2). Widths of the sensor errors are learnt from
their own spread (expectation maximisation), readings that fit badly are weighted down (Student's
t), and the Laplace approximation of the evidence says which effects the data ask for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.errors import FitError
from anser_ros.measured.navion_plate import HallSensorErrors, Plate, PlateData, Sources
from anser_ros.measured.navion_system import (
    Estimate,
    NavionProblem,
    Solution,
    System,
    Whitened,
    Widths,
)

Array = NDArray[np.float64]

SENSOR_EFFECTS = ('sensor_gain', 'sensor_axis', 'channel_crosstalk', 'lever_arm')
"""Effects of each sensor by itself, three parameters each."""

PLATE_EFFECTS = ('registration', 'plate_bend')
"""Effects of the plate at each height: six and twelve parameters."""

EFFECTS = (*SENSOR_EFFECTS, *PLATE_EFFECTS)

_ITERATIONS = 10
"""Gauss-Newton steps of a fit; the widths are learnt in all but the first and last two."""
_GAUGE = 100.0
"""How many times tighter the sum of a plate state over the heights is held than the state."""
_METAL_STEP = 0.01
"""Longest movement of a metal object in one step along each axis, m."""


@dataclass(frozen=True)
class PlateFit:
    """Holds what a joint fit found.

    Attributes
    ----------
    sources : Sources
    errors : HallSensorErrors
    states : ndarray, shape (P, n_state)
        Of the fitted heights.
    weight : ndarray, shape (P, S)
        Student weights; far below 1 marks readings that belong to no part of the model.
    log_evidence : float
        Laplace approximation; comparable between fits to the same readings.
    effects : frozenset of str
    residual_t : ndarray, shape (P, K, S, 3)
    whitened : Whitened
        The last step's equations.
    """

    sources: Sources
    errors: HallSensorErrors
    states: Array
    weight: Array
    log_evidence: float
    effects: frozenset[str]
    residual_t: Array
    whitened: Whitened


def _problem(
    data: PlateData, magnet_m: Array, metal_m: Array, effects: frozenset[str], widths: Widths
) -> NavionProblem:
    plate = Plate(data.grid_m)
    used = np.zeros(plate.n_state, dtype=bool)
    used[:6] = 'registration' in effects
    used[6:] = 'plate_bend' in effects
    index = np.flatnonzero(used)
    sigma = np.repeat([widths.shift_m, widths.tilt_rad, widths.bend_m], [3, 3, plate.n_state - 6])
    places = metal_m.reshape(-1, 3)
    prior = _prior_precision(data, len(magnet_m), places, sigma[index], widths)
    return NavionProblem(data, plate, magnet_m, places, index, prior, widths)


def _prior_precision(
    data: PlateData, n_magnet: int, metal_m: Array, state_sigma: Array, widths: Widths
) -> Array:
    """Precision of moments, states and metal places.

    What all heights share is no state of a plate (it moves the magnets or turns the sensors), so
    each state's sum over the heights is held at zero.
    """
    n_planes, n_coils = data.field_t.shape[:2]
    moment = np.repeat([widths.moment_am2, widths.metal_am2], [3 * n_magnet, metal_m.size])
    sigma = np.concatenate(
        [
            np.tile(moment, n_coils),
            np.tile(state_sigma, n_planes),
            np.full(metal_m.size, widths.metal_m),
        ]
    )
    precision = np.diag(sigma**-2.0)
    for k, value in enumerate(state_sigma):
        same = n_coils * len(moment) + k + len(state_sigma) * np.arange(n_planes)
        precision[np.ix_(same, same)] += (_GAUGE / value) ** 2
    return precision


def _start(problem: NavionProblem, effects: frozenset[str]) -> Estimate:
    n_planes, n_coils, n_sensors = problem.data.field_t.shape[:3]
    widths = problem.widths
    sensor_width = np.repeat([widths.gain, widths.axis_rad, widths.leak, widths.lever_m], 3)
    keep = np.repeat([name in effects for name in SENSOR_EFFECTS], 3)
    return Estimate(
        moment=np.zeros((problem.n_moments, n_coils)),
        states=np.zeros((n_planes, problem.plate.n_state)),
        metal=problem.metal_m.copy(),
        sensor=np.zeros((n_sensors, 12)),
        width=np.where(keep, sensor_width, 0.0),
        weight=np.ones((n_planes, n_sensors)),
    )


def _step(now: Estimate, system: System, solution: Solution, learn: bool) -> None:
    """Move the estimate; `learn` lets the widths of the sensor errors follow their spread."""
    problem = system.problem
    n_planes, n_coils = problem.data.field_t.shape[:2]
    first = n_coils * problem.n_moments
    last = first + n_planes * len(problem.state_used)
    now.moment = solution.shared[:first].reshape(n_coils, -1).T
    now.states = now.states.copy()
    now.states[:, problem.state_used] = solution.shared[first:last].reshape(n_planes, -1)
    goal = problem.metal_m + solution.shared[last:].reshape(-1, 3)
    now.metal = now.metal + np.clip(goal - now.metal, -_METAL_STEP, _METAL_STEP)
    now.sensor = solution.sensor
    square = (system.residual(solution) ** 2).sum(axis=(1, 3)).T
    scale, freedom = problem.widths.noise_t**2, problem.widths.freedom
    now.weight = (freedom + 3 * n_coils) / (freedom + square / scale)
    if learn:
        now.width = np.sqrt(np.mean(solution.sensor**2 + solution.sensor_variance, axis=0))


def fit_plates(
    data: PlateData,
    magnet_m: Array,
    metal_m: Array,
    effects: frozenset[str],
    widths: Widths | None = None,
    robust: bool = True,
) -> PlateFit:
    """Fit plates at several heights jointly.

    Parameters
    ----------
    data : PlateData
        The heights to learn from.
    magnet_m : ndarray, shape (N, 3)
        Dipoles of the magnets, m.
    metal_m : ndarray, shape (J, 3)
        Where metal objects are suspected, m; the fit moves them.
    effects : frozenset of str
        Names out of `EFFECTS`.
    widths : Widths, optional
        Expected sizes.
    robust : bool
        False takes every reading at its word, for the search of metal.

    Raises
    ------
    FitError
        With unknown effects or fewer than two heights.
    """
    unknown = effects - set(EFFECTS)
    if unknown:
        raise FitError(f'no such plate effect: {", ".join(sorted(unknown))}')
    if len(data.height_m) < 2:
        raise FitError(f'need plates at 2 heights or more, got {len(data.height_m)}')
    chosen = widths or Widths()
    if not robust:
        chosen = replace(chosen, freedom=1e9)
    problem = _problem(data, magnet_m, metal_m, effects, chosen)
    now = _start(problem, effects)
    for k in range(_ITERATIONS):
        system = System(problem, now, moving=k > 0)
        solution = system.solve()
        _step(now, system, solution, learn=2 <= k < _ITERATIONS - 2)
    return PlateFit(
        sources=now.sources(magnet_m),
        errors=now.errors(),
        states=now.states,
        weight=now.weight,
        log_evidence=system.log_evidence(solution),
        effects=effects,
        residual_t=system.residual(solution).transpose(2, 1, 0, 3),
        whitened=system.whitened(),
    )
