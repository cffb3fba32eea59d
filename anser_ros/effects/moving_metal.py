"""A metal object that moves during the session."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

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
from anser_ros.effects.metal_path import FreePath, MetalPath, StraightPath, moving_times
from anser_ros.field.dipoles import Dipoles
from anser_ros.field.model import EffectRecord
from anser_ros.metal.body import BODIES, COMPACT, SPACINGS, ball_modes, centre_sigma
from anser_ros.metal.scattering import UNIT, Shapes

STEP = 1e-3
PATH_SAMPLES = 21
LARGEST = 10.0
"""Prior size of a simple body's modes, `UNIT`."""


class MovingMetal(Effect):
    """theta: the path's parameters, then real and imaginary parts of the modes' amplitudes.

    The body doesn't turn. The site holds the path, the session's times, the modes
    (`anser_ros.metal.scattering`) and the prior size of each.
    """

    name = 'moving_metal'
    summary = 'a metal object moves during the session'
    units: ClassVar[Mapping[str, str]] = {
        'start_m': 'm', 'end_m': 'm', 't_start_s': 's', 't_end_s': 's',
        'path': 's and m', 'polarizability': 'm^3 (3x3, [re, im])',
    }  # fmt: skip
    remedy = Remedy.FIELD
    moving = True

    def starting(self, path: MetalPath, course: Array, duration: float, alpha: Array) -> Term:
        """A simple body on a path with parameters ``course``; alpha: re, im in 1e-4 m^3."""
        modes = ball_modes()
        amplitudes = np.zeros((2, modes.shape[1]))
        amplitudes[:, 0] = alpha
        site = {
            '_path': path, '_course': course, '_duration': float(duration), '_kind': COMPACT,
            '_modes': modes, '_spread': np.full(modes.shape[1], LARGEST),
        }  # fmt: skip
        return Term(self, site, np.concatenate([course, amplitudes.ravel()]))

    def with_body(self, term: Term, kind: str, modes: Array, spread: Array) -> Term:
        """The same path, another body, whose amplitudes are still zero."""
        site = {**term.site, '_kind': kind, '_modes': modes, '_spread': spread}
        amplitudes = np.zeros(2 * modes.shape[1])
        return Term(self, site, np.concatenate([term.theta[: path_of(term).count], amplitudes]))

    def with_path(self, term: Term, path: MetalPath, course: Array) -> Term:
        """The same body on another path."""
        amplitudes = term.theta[path_of(term).count :]
        return Term(self, {**term.site, '_path': path}, np.concatenate([course, amplitudes]))

    def amounts(self, term: Term) -> NDArray[np.int64]:
        """The polarisabilities."""
        return np.arange(path_of(term).count, term.theta.size)

    def prior(self, term: Term) -> Array:
        """Anywhere, any time. Frozen metal stays on its path."""
        path = path_of(term).prior()
        if term.site.get('_frozen'):
            path = np.full(path.size, FROZEN)
        return np.concatenate([path, term.site['_spread'], term.site['_spread']])

    def bounded(self, term: Term) -> Term:
        """The path in its domain."""
        count = path_of(term).count
        course = path_of(term).bounded(term.theta[:count])
        return term.with_theta(np.concatenate([course, term.theta[count:]]))

    def _couplings(self, term: Term) -> ComplexArray:
        parts = term.theta[path_of(term).count :].reshape(2, -1)
        return np.asarray(term.site['_modes'] @ (parts[0] + 1j * parts[1]))

    def _seen(self, term: Term, view: View, shift: Array) -> tuple[Array, ComplexArray]:
        """Amplitudes of the sensors (F, S, M) and emitters (F, K, M) about the moving centre.

        The emitters' are interpolated between nodes on the way.
        """
        path, shapes = path_of(term), shapes_of(term)
        course = term.theta[: path.count]
        nodes, on_way, at = path.nodes(course, view.time)
        grid = (on_way + shift)[:, None, :] + shapes.offsets
        field = view.illumination.field(grid.reshape(-1, 3)).reshape(*grid.shape, -1)
        drive = CubicSpline(nodes, shapes.driven(field))(at)
        centre = path.centre(course, view.time) + shift
        return shapes.heard(centre, view.centres, view.axes, view.sensors.length), drive

    def _sum(self, term: Term, view: View, shift: Array) -> ComplexArray:
        """Flux (F, S, K) of the whole body, moved by a shift."""
        seen = self._seen(term, view, shift)
        return shapes_of(term).flux(*seen, self._couplings(term), view.omega)

    def unit(self, term: Term, view: View) -> NDArray[np.inexact]:
        """Flux of each mode, (F, S, K, m)."""
        seen = self._seen(term, view, np.zeros(3))
        return shapes_of(term).mode_flux(*seen, term.site['_modes'], view.omega)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """By path (differences, chained) and by polarisability (exact)."""
        path = path_of(term)
        unit = self.unit(term, view)
        out = view.columns(term.theta.size)
        groups = unit.shape[-1]
        out[..., path.count : path.count + groups] = unit
        out[..., path.count + groups :] = 1j * unit
        if term.site.get('_frozen'):
            return out
        by_place = np.stack(
            [
                (self._sum(term, view, step) - self._sum(term, view, -step)) / (2 * STEP)
                for step in STEP * np.eye(3)
            ],
            axis=-1,
        )
        rates = path.rates(term.theta[: path.count], view.time)
        out[..., : path.count] = by_place @ rates[:, None]
        return out

    def moving_flux(self, term: Term, view: View) -> ComplexArray:
        """What the body adds to a view."""
        return self._sum(term, view, np.zeros(3))

    def centres(self, term: Term, time: Array) -> Array:
        """Where the body is at each time, (F, 3), m."""
        return path_of(term).centre(term.theta[: path_of(term).count], time)

    def sources_at(
        self, term: Term, illumination: Dipoles, omega: Array, time: float
    ) -> Dipoles | None:
        """Induced dipoles with the body where it is."""
        centre = self.centres(term, np.array([time]))[0]
        return shapes_of(term).sources(centre, self._couplings(term), illumination, omega)

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Path, times and polarisability."""
        path, total = path_of(term), shapes_of(term).polarisability(self._couplings(term))
        course, couplings = term.theta[: path.count], UNIT * self._couplings(term)
        times = np.linspace(0.0, term.site['_duration'], PATH_SAMPLES)
        start, end = moving_times(path, course, times)
        ends = np.array([start, end])
        at, spread = self.centres(term, ends), self._place_sigma(term, covariance, ends)
        # Which point of a body is its centre, hardly anything tells; of an extended one, nothing.
        vague = max(centre_sigma(total), SPACINGS.get(term.site['_kind'], 0.0))
        spread = np.hypot(spread, vague)
        times_sigma = self._time_sigma(term, covariance, start, end)
        return EffectRecord(
            self.name,
            {
                'start_m': at[0].tolist(),
                'end_m': at[1].tolist(),
                't_start_s': start,
                't_end_s': end,
                'path': {
                    'time_s': times.tolist(),
                    'position_m': self.centres(term, times).tolist(),
                },
                'polarizability': np.stack([total.real, total.imag], axis=-1).tolist(),
                'knots_s': list(path.knots),
                'course': course.tolist(),
                'body': term.site['_kind'],
                'couplings_m3': np.stack([couplings.real, couplings.imag], axis=-1).tolist(),
            },
            {
                'start_m': spread[0].tolist(),
                'end_m': spread[1].tolist(),
                't_start_s': times_sigma[0],
                't_end_s': times_sigma[1],
                'path': np.hypot(self._place_sigma(term, covariance, times), vague).tolist(),
            },
        )

    def _place_sigma(self, term: Term, covariance: Array, time: Array) -> Array:
        """Standard deviation of the centre at each time, (F, 3), m."""
        path = path_of(term)
        rates = path.rates(term.theta[: path.count], time)
        block = covariance[: path.count, : path.count]
        variance = np.einsum('fic,cd,fid->fi', rates, block, rates)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def _time_sigma(
        self, term: Term, covariance: Array, start: float, end: float
    ) -> tuple[float, float]:
        """Standard deviation of the times when the way begins and ends, s.

        On a free path a body has left its first place for certain only where it is farther from
        it than it is known to be anywhere.
        """
        path = path_of(term)
        if not path.knots:
            first, last = sigmas(covariance)[6:8]
            return float(first), float(last)
        time = np.linspace(path.knots[0], path.knots[-1], PATH_SAMPLES * 8)
        centre = self.centres(term, time)
        known = 2.0 * np.linalg.norm(self._place_sigma(term, covariance, time), axis=1)
        gone = np.flatnonzero(np.linalg.norm(centre - centre[0], axis=1) > known)
        coming = np.flatnonzero(np.linalg.norm(centre - centre[-1], axis=1) > known)
        knot = 0.5 * (path.knots[1] - path.knots[0])
        left = float(time[gone[0]]) if gone.size else path.knots[-1]
        there = float(time[coming[-1]]) if coming.size else path.knots[0]
        return float(np.hypot(knot, left - start)), float(np.hypot(knot, end - there))

    def term(self, record: EffectRecord) -> Term:
        """From path and couplings."""
        knots = tuple(float(k) for k in needed(record, 'knots_s'))
        course = np.asarray(needed(record, 'course'), dtype=np.float64)
        couplings = np.asarray(needed(record, 'couplings_m3'), dtype=np.float64) / UNIT
        path = FreePath(knots) if knots else StraightPath()
        site = {
            '_path': path, '_kind': str(needed(record, 'body')), '_modes': np.eye(len(couplings)),
            '_spread': np.full(len(couplings), LARGEST),
            '_duration': float(needed(record, 'path')['time_s'][-1]),
        }  # fmt: skip
        return Term(self, site, np.concatenate([course, couplings.T.ravel()]))


def path_of(term: Term) -> MetalPath:
    """The path that a term's site holds."""
    path: MetalPath = term.site['_path']
    return path


def shapes_of(term: Term) -> Shapes:
    """The shapes that a term's body is made of."""
    return BODIES[term.site['_kind']]()


EFFECTS = (MovingMetal(),)
