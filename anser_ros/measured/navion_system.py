"""Linearises the joint plate fit once: columns, marginal covariance, solution, evidence.

Rows are a sensor's readings, (K coils, P heights, 3 axes). Columns are shared (moments, plate
states, metal places) or a sensor's own (gains, turns, leaks, shift). A sensor's own errors touch
only its own rows, so they are marginalised there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.measured.navion_plate import (
    HallSensorErrors,
    Plate,
    PlateData,
    Sources,
    vector_basis,
)

Array = NDArray[np.float64]

_UNIT = np.eye(3)
"""Unit vectors of a sensor's three axes."""
_GAIN = [np.outer(a, a) for a in _UNIT]
_TURN = [np.cross(_UNIT, a) for a in _UNIT]
_LEAK = [
    np.outer(_UNIT[i], _UNIT[j]) + np.outer(_UNIT[j], _UNIT[i])
    for i, j in ((1, 2), (0, 2), (0, 1))
]
"""Symmetric changes of a sensor's matrix, one for each pair of axes."""
GENERATORS = np.array([*_GAIN, *_TURN, *_LEAK])
"""Small changes of a sensor's matrix, shape (9, 3, 3): gains, turns, symmetric leaks."""


@dataclass(frozen=True)
class Widths:
    """Holds the expected size (1 sigma) of everything unknown; from how such rigs are made.

    Attributes
    ----------
    noise_t : float
        Noise of a coil's field: sensor noise, quantisation and what no effect here explains, T.
    freedom : float
        Degrees of freedom of Student's t.
    moment_am2, metal_am2 : float
        One dipole's moment in a magnet, in a metal object.
    gain, axis_rad, leak, lever_m : float
        Start values of the sensor errors' widths; the fit learns them.
    shift_m, tilt_rad, bend_m : float
        A plate that is laid on spacers by hand.
    metal_m : float
        Metal's distance from where the search put it.
    """

    noise_t: float = 3e-5
    freedom: float = 4.0
    moment_am2: float = 1000.0
    metal_am2: float = 1.0
    gain: float = 0.03
    axis_rad: float = 0.05
    leak: float = 0.02
    lever_m: float = 5e-4
    shift_m: float = 5e-4
    tilt_rad: float = 2.5e-3
    bend_m: float = 5e-4
    metal_m: float = 0.05


@dataclass(frozen=True)
class NavionProblem:
    """Holds what doesn't change while Gauss-Newton runs.

    Attributes
    ----------
    data : PlateData
    plate : Plate
    magnet_m, metal_m : ndarray, shape (N, 3), (J, 3)
        Dipoles in the magnets; where metal is suspected.
    state_used : ndarray of int
        Numbers of a plate's state that are free.
    prior : ndarray, shape (C, C)
        Precision of the shared unknowns.
    widths : Widths
    """

    data: PlateData
    plate: Plate
    magnet_m: Array
    metal_m: Array
    state_used: NDArray[np.intp]
    prior: Array
    widths: Widths

    @property
    def reading(self) -> Array:
        """Return the readings, shape (S, K, P, 3), T."""
        return self.data.field_t.transpose(2, 1, 0, 3)

    @property
    def n_moments(self) -> int:
        """Return the number of moment components of one coil."""
        return 3 * (len(self.magnet_m) + len(self.metal_m))


@dataclass
class Estimate:
    """Holds the unknowns that Gauss-Newton steps change.

    Attributes
    ----------
    moment : ndarray, shape (3N, K)
        A m^2.
    states : ndarray, shape (P, n_state)
    metal : ndarray, shape (J, 3)
        m.
    sensor : ndarray, shape (S, 12)
        Weights of `GENERATORS`, then the shift (m).
    width : ndarray, shape (12,)
        1 sigma of `sensor` among sensors.
    weight : ndarray, shape (P, S)
        Student weights.
    """

    moment: Array
    states: Array
    metal: Array
    sensor: Array
    width: Array
    weight: Array

    def sources(self, magnet_m: Array) -> Sources:
        """Return the dipoles as they are estimated now."""
        position = np.concatenate([magnet_m, self.metal])
        moment = self.moment.reshape(len(position), 3, self.moment.shape[1])
        return Sources(position, moment, len(self.metal))

    def errors(self) -> HallSensorErrors:
        """Return the sensor errors as they are estimated now."""
        matrix = np.eye(3) + np.einsum('sa,aij->sij', self.sensor[:, :9], GENERATORS)
        return HallSensorErrors(matrix, self.sensor[:, 9:])


@dataclass(frozen=True)
class Whitened:
    """Holds the last linear system, for the search of one more dipole.

    Attributes
    ----------
    inverse_root : ndarray, shape (S, R, R)
        ``inverse_root @ columns`` whitens a sensor's rows.
    reach : ndarray, shape (S * R, C)
        What the fitted unknowns can explain of whitened rows v: ``reach @ (reach.T @ v)``.
    residual : ndarray, shape (S * R,)
        Whitened rows that they don't explain.
    sensing : ndarray, shape (P, S, 3, 3)
        Field in the frame to reading.
    position : ndarray, shape (P, S, 3)
        Sensors, m.
    """

    inverse_root: Array
    reach: Array
    residual: Array
    sensing: Array
    position: Array


@dataclass(frozen=True)
class Solution:
    """Holds shared unknowns, each sensor's own with their variance, and the rows' residual (T)."""

    shared: Array
    sensor: Array
    sensor_variance: Array
    residual: Array


class System:
    """Linearises once: rows are (S, K * P * 3), columns the shared unknowns."""

    def __init__(self, problem: NavionProblem, now: Estimate, moving: bool) -> None:
        self.problem, self.now = problem, now
        self.n_sensors, self.n_coils, self.n_planes = problem.reading.shape[:3]
        plate, data = problem.plate, problem.data
        sources, errors = now.sources(problem.magnet_m), now.errors()
        placed = [
            plate.place(h, s, errors.shift_m)
            for h, s in zip(data.height_m, now.states, strict=True)
        ]
        self.position = np.array([p for p, _ in placed])
        self.rotation = np.array([r for _, r in placed])
        flat = self.position.reshape(-1, 3)
        shape = (self.n_planes, self.n_sensors)
        self.field = sources.field(flat).reshape(*shape, 3, -1)
        self.gradient = sources.gradient(flat).reshape(*shape, 3, 3, -1)
        self.sensing = np.einsum('sij,pslj->psil', errors.matrix, self.rotation)
        model = np.einsum('psil,pslk->skpi', self.sensing, self.field)
        residual = (problem.reading - model).reshape(self.n_sensors, -1)
        self.own = self._sensor_columns()
        self.shared = self._shared_columns(sources, moving)
        value = self._shared_value()
        self.target = (
            residual
            + np.einsum('sra,sa->sr', self.own, now.sensor)
            + np.einsum('src,c->sr', self.shared, value)
        )
        self._whiten()

    def _shared_value(self) -> Array:
        problem, now = self.problem, self.now
        return np.concatenate(
            [
                now.moment.T.ravel(),
                now.states[:, problem.state_used].ravel(),
                (now.metal - problem.metal_m).ravel(),
            ]
        )

    def _sensor_columns(self) -> Array:
        local = np.einsum('pslj,pslk->psjk', self.rotation, self.field)
        matrix = np.einsum('aij,psjk->skpia', GENERATORS, local)
        slope = np.einsum('psil,pslmk,psmj->skpij', self.sensing, self.gradient, self.rotation)
        both = np.concatenate([matrix, slope], axis=4)
        return np.asarray(both.reshape(self.n_sensors, -1, 12))

    def _shared_columns(self, sources: Sources, moving: bool) -> Array:
        problem = self.problem
        n_coils, n_moments, used = self.n_coils, problem.n_moments, problem.state_used
        n_columns = len(problem.prior)
        out = np.zeros((self.n_sensors, n_coils, self.n_planes, 3, n_columns))
        basis = self.dipole_columns(sources.position_m)
        for k in range(n_coils):
            out[:, k, :, :, k * n_moments : (k + 1) * n_moments] = basis
        if moving:
            first = n_coils * n_moments
            for p, height in enumerate(problem.data.height_m):
                columns = self._state_columns(p, height)[..., used]
                out[:, :, p, :, first + p * len(used) : first + (p + 1) * len(used)] = columns
            first += self.n_planes * len(used)
            for j in range(sources.n_metal):
                columns = self._metal_columns(
                    sources, len(sources.position_m) - sources.n_metal + j
                )
                out[..., first + 3 * j : first + 3 * j + 3] = columns
        return out.reshape(self.n_sensors, -1, n_columns)

    def dipole_columns(self, positions: Array) -> Array:
        """Return readings per component of each dipole's moment: shape (S, P, 3, 3N)."""
        basis = vector_basis(self.position.reshape(-1, 3), positions)
        basis = basis.reshape(*self.position.shape[:2], 3, -1)
        return np.asarray((self.sensing @ basis).transpose(1, 0, 2, 3))

    def _state_columns(self, p: int, height: float) -> Array:
        shift, turn = self.problem.plate.motion(height, self.now.states[p], self.position[p])
        field = self.field[p].transpose(2, 0, 1)  # (K, S, 3)
        change = np.einsum('slmk,sqm->ksql', self.gradient[p], shift)
        change = change - np.cross(turn[None], field[:, :, None])
        return np.asarray(np.einsum('sil,ksql->skiq', self.sensing[p], change))

    def _metal_columns(self, sources: Sources, index: int) -> Array:
        flat = self.position.reshape(-1, 3)
        slope = -sources.gradient(flat, slice(index, index + 1))
        slope = slope.reshape(*self.position.shape[:2], 3, 3, -1)
        return np.asarray(np.einsum('psil,pslmk->skpim', self.sensing, slope))

    def _whiten(self) -> None:
        problem, now = self.problem, self.now
        rows = self.own.shape[1]
        weight = np.broadcast_to(
            now.weight.T[:, None, :, None],
            (self.n_sensors, self.n_coils, self.n_planes, 3),
        ).reshape(-1, rows)
        self.noise = problem.widths.noise_t**2 / weight
        spread = self.own * now.width
        self.covariance = spread @ spread.transpose(0, 2, 1)
        self.covariance[:, np.arange(rows), np.arange(rows)] += self.noise
        root = np.linalg.cholesky(self.covariance)
        self.inverse_root = np.linalg.inv(root)
        self.white = (self.inverse_root @ self.shared).reshape(-1, self.shared.shape[2])
        self.white_target = (self.inverse_root @ self.target[..., None]).reshape(-1)
        self.normal = self.white.T @ self.white + problem.prior

    def solve(self) -> Solution:
        """Return shared unknowns by generalised least squares, then each sensor's given those."""
        shared = np.linalg.solve(self.normal, self.white.T @ self.white_target)
        rest = self.target - self.shared @ shared
        spread = self.own * self.now.width
        half = self.inverse_root @ spread
        white = (self.inverse_root @ rest[..., None])[..., 0]
        sensor = self.now.width * np.einsum('sra,sr->sa', half, white)
        variance = self.now.width**2 * (1.0 - (half**2).sum(axis=1))
        residual = rest - np.einsum('sra,sa->sr', self.own, sensor)
        return Solution(shared, sensor, np.maximum(variance, 0.0), residual)

    def residual(self, solution: Solution) -> Array:
        """Return the residual (S, K, P, 3), T, of the linearised model."""
        return solution.residual.reshape(self.problem.reading.shape)

    def log_evidence(self, solution: Solution) -> float:
        """Return Laplace's approximation of the log evidence, up to a constant of the readings."""
        problem = self.problem
        freedom, noise = problem.widths.freedom, problem.widths.noise_t
        square = (self.residual(solution) ** 2).sum(axis=(1, 3)) / noise**2
        fit = -0.5 * (freedom + 3 * self.n_coils) * np.log1p(square / freedom).sum()
        used = self.now.width > 0.0
        width = self.now.width[used]
        penalty = solution.shared @ problem.prior @ solution.shared
        penalty += ((solution.sensor[:, used] / width) ** 2).sum()
        volume = np.linalg.slogdet(problem.prior)[1] - np.linalg.slogdet(self.normal)[1]
        volume -= np.linalg.slogdet(self.covariance)[1].sum() - np.log(self.noise).sum()
        return float(fit - 0.5 * penalty + 0.5 * volume)

    def whitened(self) -> Whitened:
        """Return what the search of one more dipole needs."""
        root = np.linalg.cholesky(self.normal)
        basis = np.linalg.solve(root, self.white.T).T
        residual = self.white_target - basis @ (basis.T @ self.white_target)
        return Whitened(self.inverse_root, basis, residual, self.sensing, self.position)
