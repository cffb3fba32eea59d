"""A metal object that moves during the session, from one place to another."""

import numpy as np

from anser_ros.effects.dipoles import Dipoles
from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Term,
    View,
    needed,
    sigmas,
)  # fmt: skip
from anser_ros.effects.metal_body import UNIT, BodyShape, moving_group_flux
from anser_ros.fitting.model import EffectRecord
from anser_ros.physics.constants import MU_0

BALL = BodyShape.ball()
NODES = 33
STEP = 1e-3
SHORTEST = 0.2


def _progress(theta: Array, time: Array) -> Array:
    """Share of the way made at each time, 0 to 1."""
    span = max(float(theta[7] - theta[6]), SHORTEST)
    return np.asarray(np.clip((time - theta[6]) / span, 0.0, 1.0))


class MovingMetal(Effect):
    """theta: start (m, 3), end (m, 3), start and end time (s), then polarisabilities.

    The centre goes straight and evenly from start to end between the two times and rests before
    and after; the body doesn't turn.
    """

    name = 'moving_metal'
    summary = 'a metal object moves during the session'
    units = {
        'start_m': 'm', 'end_m': 'm', 't_start_s': 's', 't_end_s': 's',
        'polarizability': 'm^3 (3x3, [re, im])',
    }  # fmt: skip
    plausible = {'t_start_s': (0.0, 1e5), 't_end_s': (0.0, 1e5)}
    remedy = Remedy.FIELD
    moving = True

    def starting(self, start: Array, end: Array, times: tuple[float, float], alpha: Array) -> Term:
        """A term with one isotropic scatterer (re, im in 1e-4 m^3)."""
        groups = np.zeros((2, BALL.groups))
        groups[:, 0] = alpha
        return Term(self, {}, np.concatenate([start, end, times, groups.ravel()]))

    def prior(self, term: Term) -> Array:
        """Anywhere, any time."""
        return np.concatenate([np.full(6, 0.1), np.full(2, 10.0), np.full(2 * BALL.groups, 10.0)])

    def bounded(self, term: Term) -> Term:
        """The end comes after the start."""
        theta = term.theta.copy()
        theta[7] = max(theta[7], theta[6] + SHORTEST)
        return term.with_theta(theta)

    def _groups(self, theta: Array, view: View, shift: Array) -> ComplexArray:
        """Flux of every group's unit polarisability, (F, S, K, g)."""
        nodes = np.linspace(0.0, 1.0, NODES)
        path = theta[:3] + nodes[:, None] * (theta[3:6] - theta[:3]) + shift
        points = path[:, None, :] + BALL.offsets
        field = view.illumination.field(points.reshape(-1, 3))
        field = field.reshape(*points.shape, -1)
        share = _progress(theta, view.time) * (NODES - 1)
        left = np.minimum(share.astype(int), NODES - 2)
        part = (share - left)[:, None, None, None]
        at = field[left] * (1 - part) + field[left + 1] * part
        where = points[left] * (1 - part[..., 0]) + points[left + 1] * part[..., 0]
        moments = np.einsum('gnij,fnjk->fgnik', BALL.tensors, at, optimize=True) * (UNIT / MU_0)
        return moving_group_flux(where, moments, view.centres, view.axes)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """By path (differences, chained) and by polarisability (exact)."""
        theta, alpha = term.theta, term.theta[8:]
        unit = self._groups(theta, view, np.zeros(3))
        groups = unit.shape[-1]
        out = view.columns(theta.size)
        out[..., 8 : 8 + groups], out[..., 8 + groups :] = unit, 1j * unit
        weights = alpha.reshape(2, -1)[0] + 1j * alpha.reshape(2, -1)[1]
        by_place = np.stack(
            [
                (
                    self._groups(theta, view, step) @ weights
                    - self._groups(theta, view, -step) @ weights
                )
                / (2 * STEP)
                for step in STEP * np.eye(3)
            ],
            axis=-1,
        )
        share = _progress(theta, view.time)
        way, span = theta[3:6] - theta[:3], max(float(theta[7] - theta[6]), SHORTEST)
        going = ((share > 0) & (share < 1)).astype(np.float64)
        out[..., :3] = by_place * (1 - share)[:, None, None, None]
        out[..., 3:6] = by_place * share[:, None, None, None]
        along = by_place @ way
        out[..., 6] = along * (-(1 - share) * going / span)[:, None, None]
        out[..., 7] = along * (-share * going / span)[:, None, None]
        return out

    def sources_at(
        self, term: Term, illumination: Dipoles, omega: Array, time: float
    ) -> Dipoles | None:
        """Induced dipoles with the body where it is."""
        share = float(_progress(term.theta, np.array([time]))[0])
        centre = term.theta[:3] + share * (term.theta[3:6] - term.theta[:3])
        return BALL.sources(centre, term.theta[8:], illumination)

    def moving_flux(self, term: Term, view: View) -> ComplexArray:
        """What the body adds to a view."""
        parts = term.theta[8:].reshape(2, -1)
        unit = self._groups(term.theta, view, np.zeros(3))
        return np.asarray(unit @ (parts[0] + 1j * parts[1]))

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Path, times and whole polarisability."""
        total, sigma = BALL.total(term.theta[8:]), sigmas(covariance)
        return EffectRecord(
            self.name,
            {
                'start_m': term.theta[:3].tolist(),
                'end_m': term.theta[3:6].tolist(),
                't_start_s': float(term.theta[6]),
                't_end_s': float(term.theta[7]),
                'polarizability': np.stack([total.real, total.imag], axis=-1).tolist(),
                'groups': (UNIT * term.theta[8:]).tolist(),
            },
            {
                'start_m': sigma[:3].tolist(),
                'end_m': sigma[3:6].tolist(),
                't_start_s': float(sigma[6]),
                't_end_s': float(sigma[7]),
            },
        )

    def term(self, record: EffectRecord) -> Term:
        """From path, times and groups."""
        theta = np.concatenate(
            [
                np.asarray(needed(record, 'start_m'), dtype=np.float64),
                np.asarray(needed(record, 'end_m'), dtype=np.float64),
                [float(needed(record, 't_start_s')), float(needed(record, 't_end_s'))],
                np.asarray(needed(record, 'groups'), dtype=np.float64) / UNIT,
            ]
        )
        return Term(self, {}, theta)


EFFECTS = (MovingMetal(),)
