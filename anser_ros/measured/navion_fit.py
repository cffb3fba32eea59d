"""Joint fit of dipoles, sensor errors, plate poses, plate bends and metal to plates at heights.

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
from anser_ros.measured.navion_plate import (
    Plate,
    PlateData,
    SensorErrors,
    Sources,
    vector_basis,
)

Array = NDArray[np.float64]

SENSOR_EFFECTS = ('sensor_gain', 'sensor_axis', 'channel_crosstalk', 'lever_arm')
"""Effects of each sensor by itself, three parameters each."""

PLATE_EFFECTS = ('registration', 'plate_bend')
"""Effects of the plate at each height: six and twelve parameters."""

EFFECTS = (*SENSOR_EFFECTS, *PLATE_EFFECTS)

_UNIT = np.eye(3)
_GAIN = [np.outer(a, a) for a in _UNIT]
_TURN = [np.cross(_UNIT, a) for a in _UNIT]
_LEAK = [
    np.outer(_UNIT[i], _UNIT[j]) + np.outer(_UNIT[j], _UNIT[i])
    for i, j in ((1, 2), (0, 2), (0, 1))
]
GENERATORS = np.array([*_GAIN, *_TURN, *_LEAK])
"""Small changes of a sensor's matrix, shape (9, 3, 3): gains, turns, symmetric leaks."""


@dataclass(frozen=True)
class Widths:
    """Expected size (1 sigma) of everything that is unknown; from how such rigs are made.

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
class Whitened:
    """The last linear system, for the search of one more dipole.

    ``inverse_root @ columns`` whitens a sensor's rows; `projector` is the share of whitened rows
    that the fitted unknowns can reach, ``basis @ basis.T``.
    """

    inverse_root: Array
    projector: Array
    residual: Array
    reading: Array
    position: Array


@dataclass(frozen=True)
class PlateFit:
    """What a joint fit found.

    Attributes
    ----------
    sources : Sources
    errors : SensorErrors
    states : ndarray, shape (P, n_state)
        Of the fitted heights.
    weight : ndarray, shape (P, S)
        Student weights; far below 1 marks readings that belong to no part of the model.
    log_evidence : float
        Laplace approximation; comparable between fits to the same readings.
    effects : frozenset of str
    residual_t : ndarray, shape (P, K, S, 3)
    """

    sources: Sources
    errors: SensorErrors
    states: Array
    weight: Array
    log_evidence: float
    effects: frozenset[str]
    residual_t: Array
    whitened: Whitened


@dataclass
class _Estimate:
    """What Gauss-Newton moves."""

    moment: Array
    states: Array
    metal: Array
    sensor: Array
    """(S, 12): weights of the generators, then the shift."""
    width: Array
    weight: Array


class PlateFitter:
    """The joint fit for one set of heights, effects, magnets and metal objects."""

    def __init__(
        self,
        data: PlateData,
        magnet_m: Array,
        metal_m: Array,
        effects: frozenset[str],
        widths: Widths | None = None,
    ) -> None:
        unknown = effects - set(EFFECTS)
        if unknown:
            raise FitError(f'no such plate effect: {", ".join(sorted(unknown))}')
        if data.field_t.ndim != 4 or len(data.height_m) < 2:
            raise FitError(f'need plates at 2 heights or more, got {len(data.height_m)}')
        self.data, self.effects = data, effects
        self.widths = widths or Widths()
        self.plate = Plate(data.grid_m)
        self.magnet_m = magnet_m
        self.metal_start = metal_m.reshape(-1, 3)
        self.reading = data.field_t.transpose(2, 1, 0, 3)  # (S, K, P, 3)
        self.n_sensors, self.n_coils, self.n_planes = self.reading.shape[:3]
        self.n_moments = 3 * (len(magnet_m) + len(self.metal_start))
        self.state_used = self._used_states()
        self.prior = self._prior_precision()

    def _used_states(self) -> NDArray[np.intp]:
        used = np.zeros(self.plate.n_state, dtype=bool)
        used[:6] = 'registration' in self.effects
        used[6:] = 'plate_bend' in self.effects
        return np.flatnonzero(used)

    def _prior_precision(self) -> Array:
        """Precision of moments, states and metal places.

        What all heights share is no state of a plate (it moves the magnets or turns the sensors),
        so each state's sum over the heights is held at zero.
        """
        width = self.widths
        moment = np.full(len(self.magnet_m) * 3, width.moment_am2)
        metal = np.full(len(self.metal_start) * 3, width.metal_am2)
        state = np.concatenate(
            [
                np.full(3, width.shift_m),
                np.full(3, width.tilt_rad),
                np.full(self.plate.n_state - 6, width.bend_m),
            ]
        )[self.state_used]
        sigma = np.concatenate(
            [
                np.tile(np.concatenate([moment, metal]), self.n_coils),
                np.tile(state, self.n_planes),
                np.full(self.metal_start.size, width.metal_m),
            ]
        )
        precision = np.diag(sigma**-2.0)
        first = self.n_coils * self.n_moments
        for k, value in enumerate(state):
            same = first + k + len(state) * np.arange(self.n_planes)
            precision[np.ix_(same, same)] += (100.0 / value) ** 2
        return precision

    def _start(self) -> _Estimate:
        width = self.widths
        sensor_width = np.repeat([width.gain, width.axis_rad, width.leak, width.lever_m], 3)
        keep = np.repeat([name in self.effects for name in SENSOR_EFFECTS], 3)
        return _Estimate(
            moment=np.zeros((self.n_moments, self.n_coils)),
            states=np.zeros((self.n_planes, self.plate.n_state)),
            metal=self.metal_start.copy(),
            sensor=np.zeros((self.n_sensors, 12)),
            width=np.where(keep, sensor_width, 0.0),
            weight=np.ones((self.n_planes, self.n_sensors)),
        )

    def _sources(self, now: _Estimate) -> Sources:
        position = np.concatenate([self.magnet_m, now.metal])
        return Sources(
            position, now.moment.reshape(len(position), 3, self.n_coils), len(now.metal)
        )

    def _errors(self, now: _Estimate) -> SensorErrors:
        matrix = np.eye(3) + np.einsum('sa,aij->sij', now.sensor[:, :9], GENERATORS)
        return SensorErrors(matrix, now.sensor[:, 9:])

    def run(self, iterations: int = 10) -> PlateFit:
        """Fit; `iterations` Gauss-Newton steps of which all but the first move everything."""
        now = self._start()
        for k in range(iterations):
            system = _System(self, now, moving=k > 0)
            solution = system.solve()
            self._step(now, system, solution, learn=2 <= k < iterations - 2)
        return PlateFit(
            sources=self._sources(now),
            errors=self._errors(now),
            states=now.states,
            weight=now.weight,
            log_evidence=system.log_evidence(solution),
            effects=self.effects,
            residual_t=system.last_residual(solution).transpose(2, 1, 0, 3),
            whitened=system.whitened(),
        )

    def _step(self, now: _Estimate, system: _System, solution: _Solution, learn: bool) -> None:
        first = self.n_coils * self.n_moments
        last = first + self.n_planes * len(self.state_used)
        now.moment = solution.shared[:first].reshape(self.n_coils, -1).T
        now.states = now.states.copy()
        now.states[:, self.state_used] = solution.shared[first:last].reshape(self.n_planes, -1)
        goal = self.metal_start + solution.shared[last:].reshape(-1, 3)
        now.metal = now.metal + np.clip(goal - now.metal, -0.01, 0.01)
        now.sensor = solution.sensor
        square = (system.last_residual(solution) ** 2).sum(axis=(1, 3)).T
        scale, freedom = self.widths.noise_t**2, self.widths.freedom
        now.weight = (freedom + 3 * self.n_coils) / (freedom + square / scale)
        if learn:
            now.width = np.sqrt(np.mean(solution.sensor**2 + solution.sensor_variance, axis=0))


@dataclass(frozen=True)
class _Solution:
    shared: Array
    sensor: Array
    sensor_variance: Array
    residual: Array


class _System:
    """One linearisation: rows are (S, K * P * 3), columns the shared unknowns."""

    def __init__(self, fitter: PlateFitter, now: _Estimate, moving: bool) -> None:
        self.fitter, self.now = fitter, now
        plate, data = fitter.plate, fitter.data
        sources, errors = fitter._sources(now), fitter._errors(now)
        placed = [
            plate.place(h, s, errors.shift_m)
            for h, s in zip(data.height_m, now.states, strict=True)
        ]
        self.position = np.array([p for p, _ in placed])
        self.rotation = np.array([r for _, r in placed])
        flat = self.position.reshape(-1, 3)
        shape = (fitter.n_planes, fitter.n_sensors)
        self.field = sources.field(flat).reshape(*shape, 3, -1)
        self.gradient = sources.gradient(flat).reshape(*shape, 3, 3, -1)
        self.sensing = np.einsum('sij,pslj->psil', errors.matrix, self.rotation)
        model = np.einsum('psil,pslk->skpi', self.sensing, self.field)
        residual = (fitter.reading - model).reshape(fitter.n_sensors, -1)
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
        fitter, now = self.fitter, self.now
        return np.concatenate(
            [
                now.moment.T.ravel(),
                now.states[:, fitter.state_used].ravel(),
                (now.metal - fitter.metal_start).ravel(),
            ]
        )

    def _sensor_columns(self) -> Array:
        local = np.einsum('pslj,pslk->psjk', self.rotation, self.field)
        matrix = np.einsum('aij,psjk->skpia', GENERATORS, local)
        slope = np.einsum('psil,pslmk,psmj->skpij', self.sensing, self.gradient, self.rotation)
        both = np.concatenate([matrix, slope], axis=4)
        return np.asarray(both.reshape(self.fitter.n_sensors, -1, 12))

    def _shared_columns(self, sources: Sources, moving: bool) -> Array:
        fitter = self.fitter
        n_coils, n_moments, used = fitter.n_coils, fitter.n_moments, fitter.state_used
        n_columns = len(fitter.prior)
        out = np.zeros((fitter.n_sensors, n_coils, fitter.n_planes, 3, n_columns))
        basis = self.dipole_columns(sources.position_m)
        for k in range(n_coils):
            out[:, k, :, :, k * n_moments : (k + 1) * n_moments] = basis
        if moving:
            first = n_coils * n_moments
            for p, height in enumerate(fitter.data.height_m):
                columns = self._state_columns(p, height)[..., used]
                out[:, :, p, :, first + p * len(used) : first + (p + 1) * len(used)] = columns
            first += fitter.n_planes * len(used)
            for j in range(sources.n_metal):
                columns = self._metal_columns(
                    sources, len(sources.position_m) - sources.n_metal + j
                )
                out[..., first + 3 * j : first + 3 * j + 3] = columns
        return out.reshape(fitter.n_sensors, -1, n_columns)

    def dipole_columns(self, positions: Array) -> Array:
        """Readings per component of each dipole's moment: shape (S, P, 3, 3N)."""
        basis = vector_basis(self.position.reshape(-1, 3), positions)
        basis = basis.reshape(*self.position.shape[:2], 3, -1)
        return (self.sensing @ basis).transpose(1, 0, 2, 3)

    def _state_columns(self, p: int, height: float) -> Array:
        shift, turn = self.fitter.plate.motion(height, self.now.states[p], self.position[p])
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
        fitter, now = self.fitter, self.now
        rows = self.own.shape[1]
        weight = np.broadcast_to(
            now.weight.T[:, None, :, None],
            (fitter.n_sensors, fitter.n_coils, fitter.n_planes, 3),
        ).reshape(-1, rows)
        self.noise = fitter.widths.noise_t**2 / weight
        spread = self.own * now.width
        self.covariance = spread @ spread.transpose(0, 2, 1)
        self.covariance[:, np.arange(rows), np.arange(rows)] += self.noise
        root = np.linalg.cholesky(self.covariance)
        self.inverse_root = np.linalg.inv(root)
        self.white = (self.inverse_root @ self.shared).reshape(-1, self.shared.shape[2])
        self.white_target = (self.inverse_root @ self.target[..., None]).reshape(-1)
        self.normal = self.white.T @ self.white + fitter.prior

    def solve(self) -> _Solution:
        """Shared unknowns by generalised least squares, then each sensor's given those."""
        shared = np.linalg.solve(self.normal, self.white.T @ self.white_target)
        rest = self.target - self.shared @ shared
        spread = self.own * self.now.width
        half = self.inverse_root @ spread
        white = (self.inverse_root @ rest[..., None])[..., 0]
        sensor = self.now.width * np.einsum('sra,sr->sa', half, white)
        variance = self.now.width**2 * (1.0 - (half**2).sum(axis=1))
        residual = rest - np.einsum('sra,sa->sr', self.own, sensor)
        return _Solution(shared, sensor, np.maximum(variance, 0.0), residual)

    def last_residual(self, solution: _Solution) -> Array:
        """Residual (S, K, P, 3), T, of the linearised model."""
        return solution.residual.reshape(self.fitter.reading.shape)

    def log_evidence(self, solution: _Solution) -> float:
        """Laplace approximation of the log evidence, up to a constant of the readings."""
        fitter = self.fitter
        freedom, noise = fitter.widths.freedom, fitter.widths.noise_t
        square = (self.last_residual(solution) ** 2).sum(axis=(1, 3)) / noise**2
        fit = -0.5 * (freedom + 3 * fitter.n_coils) * np.log1p(square / freedom).sum()
        used = self.now.width > 0.0
        width = self.now.width[used]
        penalty = solution.shared @ fitter.prior @ solution.shared
        penalty += ((solution.sensor[:, used] / width) ** 2).sum()
        volume = np.linalg.slogdet(fitter.prior)[1] - np.linalg.slogdet(self.normal)[1]
        volume -= np.linalg.slogdet(self.covariance)[1].sum() - np.log(self.noise).sum()
        return float(fit - 0.5 * penalty + 0.5 * volume)

    def whitened(self) -> Whitened:
        """What the search of one more dipole needs."""
        root = np.linalg.cholesky(self.normal)
        basis = np.linalg.solve(root, self.white.T).T
        residual = self.white_target - basis @ (basis.T @ self.white_target)
        return Whitened(self.inverse_root, basis, residual, self.sensing, self.position)


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
    chosen = widths or Widths()
    if not robust:
        chosen = replace(chosen, freedom=1e9)
    return PlateFitter(data, magnet_m, metal_m, effects, chosen).run()
