"""A metal object that moves during the session, from one place to another."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.dipoles import Dipoles
from anser_ros.effects.effect import (
    FROZEN,
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Term,
    View,
    needed,
    sigmas,
)
from anser_ros.effects.metal_body import (
    SPHERE_POINTS,
    SPHERE_WEIGHTS,
    UNIT,
    by_modes,
    scatterer_coupling,
)
from anser_ros.fitting.model import EffectRecord
from anser_ros.physics.constants import MU_0

NODES = 33
STEP = 1e-3
SHORTEST = 0.2
PATH = 9
"""Number of parameters of the path, before the polarisabilities."""


def progress(theta: Array, time: Array) -> Array:
    """Share of the way made at each time, 0 to 1."""
    u = np.clip((time - theta[6]) / max(float(theta[7] - theta[6]), SHORTEST), 0.0, 1.0)
    return np.asarray(u + theta[8] * u * (1 - u) * (2 * u - 1))


def _rates(theta: Array, time: Array) -> tuple[Array, Array, Array]:
    """Derivative of the progress by start time, end time and ease."""
    span = max(float(theta[7] - theta[6]), SHORTEST)
    u = np.clip((time - theta[6]) / span, 0.0, 1.0)
    going = ((u > 0) & (u < 1)).astype(np.float64)
    speed = going * (1 + theta[8] * (6 * u - 6 * u**2 - 1)) / span
    return -(1 - u) * speed, -u * speed, u * (1 - u) * (2 * u - 1)


def centre_at(theta: Array, time: Array) -> Array:
    """Centre of the body at each time, shape (F, 3), m."""
    return np.asarray(theta[:3] + progress(theta, time)[:, None] * (theta[3:6] - theta[:3]))


def simple_body() -> tuple[Array, Array]:
    """Offsets (n, 3) and modes (3 n, 4): the centre along x, y, z, and an isotropic shell."""
    offsets = np.concatenate([np.zeros((1, 3)), 0.025 * SPHERE_POINTS])
    count = offsets.shape[0]
    modes = np.zeros((3, count, 4))
    modes[[0, 1, 2], 0, [0, 1, 2]] = 1.0
    modes[:, 1:, 3] = SPHERE_WEIGHTS
    return offsets, modes.reshape(3 * count, 4)


class MovingMetal(Effect):
    """theta: start and end (m), start and end time (s), ease, then the modes' polarisabilities.

    The centre goes straight from start to end between the two times and rests before and after;
    the body doesn't turn. An ease of 0 is even speed, of 1 a smooth step. The body is a cloud of
    scatterers (the field along an axis makes a moment along it) in a few fixed combinations.
    """

    name = 'moving_metal'
    summary = 'a metal object moves during the session'
    units: ClassVar[Mapping[str, str]] = {
        'start_m': 'm', 'end_m': 'm', 't_start_s': 's', 't_end_s': 's', 'ease': '1',
        'polarizability': 'm^3 (3x3, [re, im])',
    }  # fmt: skip
    remedy = Remedy.FIELD
    moving = True

    def starting(self, start: Array, end: Array, times: tuple[float, float], alpha: Array) -> Term:
        """A term with one isotropic scatterer (re, im in 1e-4 m^3)."""
        offsets, modes = simple_body()
        amplitudes = np.zeros((2, modes.shape[1]))
        amplitudes[:, :3] = np.asarray(alpha)[:, None]
        theta = np.concatenate([start, end, times, [0.5], amplitudes.ravel()])
        return Term(self, {'_offsets': offsets, '_modes': modes, '_size': 10.0}, theta)

    def with_body(self, term: Term, offsets: Array, modes: Array, size: float) -> Term:
        """The same path, another body, whose amplitudes (prior ``size``) are still zero."""
        site = {**term.site, '_offsets': offsets, '_modes': modes, '_size': size}
        return Term(self, site, np.concatenate([term.theta[:PATH], np.zeros(2 * modes.shape[1])]))

    def amounts(self, term: Term) -> NDArray[np.int64]:
        """The polarisabilities."""
        return np.arange(PATH, term.theta.size)

    def prior(self, term: Term) -> Array:
        """Anywhere, any time. Frozen metal stays on its path."""
        path = np.concatenate([np.full(6, 0.1), np.full(2, 10.0), [0.5]])
        if term.site.get('_frozen'):
            path = np.full(PATH, FROZEN)
        count = term.theta.size - PATH
        return np.concatenate([path, np.full(count, float(term.site['_size']))])

    def bounded(self, term: Term) -> Term:
        """The end comes after the start, and the body never goes back."""
        theta = term.theta.copy()
        theta[7] = max(theta[7], theta[6] + SHORTEST)
        theta[8] = np.clip(theta[8], -0.5, 1.2)
        return term.with_theta(theta)

    def _amplitudes(self, term: Term) -> ComplexArray:
        parts = term.theta[PATH:].reshape(2, -1)
        return np.asarray(parts[0] + 1j * parts[1])

    def _there(self, term: Term, view: View, shift: Array) -> tuple[Array, ComplexArray]:
        """Coupling (F, S, 3 n) and driving field (F, K, 3 n) of every scatterer, axis by axis."""
        theta, offsets = term.theta, term.site['_offsets']
        nodes = np.linspace(0.0, 1.0, NODES)
        path = theta[:3] + nodes[:, None] * (theta[3:6] - theta[:3]) + shift
        grid = path[:, None, :] + offsets
        field = view.illumination.field(grid.reshape(-1, 3)).reshape(*grid.shape, -1)
        share = np.clip(progress(theta, view.time), 0.0, 1.0) * (NODES - 1)
        left = np.minimum(share.astype(int), NODES - 2)
        part = (share - left)[:, None, None, None]
        at = field[left] * (1 - part) + field[left + 1] * part
        points = grid[left] * (1 - part[..., 0]) + grid[left + 1] * part[..., 0]
        coupling = scatterer_coupling(points, view.centres, view.axes)
        frames, sensors = view.centres.shape[:2]
        driven = np.transpose(at, (0, 3, 2, 1)).reshape(frames, at.shape[3], -1)
        flat = np.moveaxis(coupling, 3, 2).reshape(frames, sensors, -1)
        return flat, (driven * (UNIT / MU_0)).astype(complex)

    def _sum(self, term: Term, view: View, shift: Array) -> ComplexArray:
        """Flux (F, S, K) of the whole body, moved by a shift."""
        coupling, driven = self._there(term, view, shift)
        weights = term.site['_modes'] @ self._amplitudes(term)
        return np.asarray(coupling @ (driven * weights).transpose(0, 2, 1))

    def unit(self, term: Term, view: View) -> ComplexArray:
        """Flux of each mode, (F, S, K, m)."""
        coupling, driven = self._there(term, view, np.zeros(3))
        lit = coupling[:, :, None, :] * driven[:, None, :, :]
        return by_modes(lit, term.site['_modes'])

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """By path (differences, chained) and by polarisability (exact)."""
        theta = term.theta
        unit = self.unit(term, view)
        groups = unit.shape[-1]
        out = view.columns(theta.size)
        out[..., PATH : PATH + groups], out[..., PATH + groups :] = unit, 1j * unit
        if term.site.get('_frozen'):
            return out
        by_place = np.stack(
            [
                (self._sum(term, view, step) - self._sum(term, view, -step)) / (2 * STEP)
                for step in STEP * np.eye(3)
            ],
            axis=-1,
        )
        share = progress(theta, view.time)[:, None, None, None]
        out[..., :3], out[..., 3:6] = by_place * (1 - share), by_place * share
        along = by_place @ (theta[3:6] - theta[:3])
        for i, rate in enumerate(_rates(theta, view.time)):
            out[..., 6 + i] = along * rate[:, None, None]
        return out

    def moving_flux(self, term: Term, view: View) -> ComplexArray:
        """What the body adds to a view."""
        return self._sum(term, view, np.zeros(3))

    def _strength(self, term: Term) -> ComplexArray:
        """Polarisability of each scatterer along each axis, shape (n, 3), m^3."""
        weights = term.site['_modes'] @ self._amplitudes(term)
        return np.asarray(weights.reshape(3, -1).T * UNIT)

    def sources_at(
        self, term: Term, illumination: Dipoles, omega: Array, time: float
    ) -> Dipoles | None:
        """Induced dipoles with the body where it is."""
        points = centre_at(term.theta, np.array([time]))[0] + term.site['_offsets']
        moments = illumination.field(points) * self._strength(term)[..., None] / MU_0
        return Dipoles.vectors(points, moments)

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Path, times and whole polarisability."""
        sigma, total = sigmas(covariance), np.diag(self._strength(term).sum(axis=0))
        strength = self._strength(term)
        return EffectRecord(
            self.name,
            {
                'start_m': term.theta[:3].tolist(),
                'end_m': term.theta[3:6].tolist(),
                't_start_s': float(term.theta[6]),
                't_end_s': float(term.theta[7]),
                'ease': float(term.theta[8]),
                'polarizability': np.stack([total.real, total.imag], axis=-1).tolist(),
                'scatterers_m': term.site['_offsets'].tolist(),
                'scatterers_m3': np.stack([strength.real, strength.imag], axis=-1).tolist(),
            },
            {
                'start_m': sigma[:3].tolist(),
                'end_m': sigma[3:6].tolist(),
                't_start_s': float(sigma[6]),
                't_end_s': float(sigma[7]),
                'ease': float(sigma[8]),
            },
        )

    def term(self, record: EffectRecord) -> Term:
        """From path, times and scatterers."""
        offsets = np.asarray(needed(record, 'scatterers_m'), dtype=np.float64)
        strength = np.asarray(needed(record, 'scatterers_m3'), dtype=np.float64) / UNIT
        flat = strength.transpose(1, 0, 2).reshape(-1, 2)
        theta = np.concatenate(
            [
                np.asarray(needed(record, 'start_m'), dtype=np.float64),
                np.asarray(needed(record, 'end_m'), dtype=np.float64),
                [float(needed(record, 't_start_s')), float(needed(record, 't_end_s'))],
                [float(record.parameters.get('ease', 0.0))],
                flat.T.ravel(),
            ]
        )
        site = {'_offsets': offsets, '_modes': np.eye(flat.shape[0]), '_size': 10.0}
        return Term(self, site, theta)


EFFECTS = (MovingMetal(),)
