"""A metal object moves during the session: straight from rest to rest, or along a spline."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

from anser_ros.arrays import Array, ComplexArray, Integers, pairs_of
from anser_ros.effects.base import Apparatus, View
from anser_ros.effects.effect import FROZEN, LARGEST, BodyTerm, Effect, Family, Remedy, sigmas
from anser_ros.effects.metal_at_rest import STATIC_METAL
from anser_ros.field.model import EffectRecord
from anser_ros.metal.body import COMPACT, SPACINGS, ball_modes, centre_sigma
from anser_ros.metal.scattering import UNIT
from anser_ros.parallel import in_order

SHORTEST = 0.2
"""Shortest time (s) that a straight way may take: a hand is no faster."""
FINE_STEP_S = 0.05
"""Step (s) in which the length of a way is summed up, a quarter of the shortest way."""
NODES, NODES_PER_KNOT = 41, 6
"""Nodes on a path, in which fields are found; between them they are interpolated."""
KEPT_SPLINES = 64
"""Sets of spline weights that are kept, 0.2 MB each, for a few paths fitted side by side."""
NEGLIGIBLE_WAY = 0.02
"""Share (0 to 1) of a way that counts as not yet begun, or as over: 2 to 5 mm of a hand's way."""


@dataclass(frozen=True)
class StraightPath:
    """Leads straight on; its parameters are start and end (m), start and end time (s), ease.

    The centre rests, goes straight from start to end between the two times, and rests. An ease of
    0 is constant speed, of 1 a smooth step.
    """

    count: int = 9
    knots: tuple[float, ...] = ()

    def progress(self, theta: Array, time: Array) -> Array:
        """Return the share of the way made at each time, 0 to 1."""
        u = np.clip((time - theta[6]) / max(float(theta[7] - theta[6]), SHORTEST), 0.0, 1.0)
        return np.asarray(u + theta[8] * u * (1 - u) * (2 * u - 1))

    def centre(self, theta: Array, time: Array) -> Array:
        """Return the body's centre at each time, shape (F, 3), m."""
        way = theta[3:6] - theta[:3]
        return np.asarray(theta[:3] + self.progress(theta, time)[:, None] * way)

    def rates(self, theta: Array, time: Array) -> Array:
        """Return the derivative of the centre by the parameters, (F, 3, 9)."""
        span = max(float(theta[7] - theta[6]), SHORTEST)
        u = np.clip((time - theta[6]) / span, 0.0, 1.0)
        going = ((u > 0) & (u < 1)).astype(np.float64)
        speed = going * (1 + theta[8] * (6 * u - 6 * u**2 - 1)) / span
        share = self.progress(theta, time)
        out = np.zeros((time.size, 3, 9))
        for axis in range(3):
            out[:, axis, axis], out[:, axis, 3 + axis] = 1 - share, share
        scalar = np.stack([-(1 - u) * speed, -u * speed, u * (1 - u) * (2 * u - 1)], axis=1)
        out[:, :, 6:9] = (theta[3:6] - theta[:3])[None, :, None] * scalar[:, None, :]
        return out

    def nodes(self, theta: Array, time: Array) -> tuple[Array, Array, Array]:
        """Return shares of the way, the places there, m, and the share made at each time."""
        way = theta[3:6] - theta[:3]
        share = np.linspace(0.0, 1.0, NODES)
        made = np.clip(self.progress(theta, time), 0.0, 1.0)
        return share, theta[:3] + share[:, None] * way, made

    def prior(self) -> Array:
        """Expect places within decimetres, times within tens of seconds, and any ease."""
        return np.concatenate([np.full(6, 0.1), np.full(2, 10.0), [0.5]])

    def bounded(self, theta: Array) -> Array:
        """Put the end after the start, and keep the body from going back."""
        out = theta.copy()
        out[7] = max(out[7], out[6] + SHORTEST)
        out[8] = np.clip(out[8], -0.5, 1.0)
        return out


@dataclass(frozen=True)
class FreePath:
    """Leads along a natural spline; its parameters are the centre (m) at each knot."""

    knots: tuple[float, ...]  # s, ascending, at least three

    @property
    def count(self) -> int:
        """Return three parameters for each knot of the path."""
        return 3 * len(self.knots)

    def _weights(self, time: Array) -> Array:
        """Share of each knot in the centre at each time, (F, n)."""
        knots = np.array(self.knots)
        return spline_weights(knots, np.clip(time, knots[0], knots[-1]), 'natural')

    def centre(self, theta: Array, time: Array) -> Array:
        """Return the body's centre at each time, shape (F, 3), m."""
        return np.asarray(self._weights(time) @ theta.reshape(-1, 3))

    def rates(self, theta: Array, time: Array) -> Array:
        """Return the derivative of the centre by the parameters, (F, 3, count)."""
        weights = self._weights(time)
        rates = weights[:, None, :, None] * np.eye(3)[None, :, None, :]
        return np.asarray(rates.reshape(time.size, 3, -1))

    def nodes(self, theta: Array, time: Array) -> tuple[Array, Array, Array]:
        """Use the time as coordinate: a free path may turn back."""
        count = NODES_PER_KNOT * (len(self.knots) - 1) + 1
        times = np.linspace(self.knots[0], self.knots[-1], count)
        return times, self.centre(theta, times), np.clip(time, times[0], times[-1])

    def prior(self) -> Array:
        """Return a spread of 0.1 m: the path stays within decimetres of its start value."""
        return np.full(self.count, 0.1)

    def bounded(self, theta: Array) -> Array:
        return theta

    @staticmethod
    def through(knots: Array, time: Array, centres: Array) -> tuple['FreePath', Array]:
        """Return the path nearest to a course (F, 3) at ascending times, and its parameters."""
        path = FreePath(tuple(float(k) for k in knots))
        weights = path._weights(time)
        bend = 1e-3 * np.diff(np.eye(len(knots)), 2, axis=0)
        normal = weights.T @ weights + bend.T @ bend
        course = np.linalg.solve(normal, weights.T @ centres)
        return path, np.asarray(course.ravel(), dtype=np.float64)


MetalPath = StraightPath | FreePath
"""Leads along ``count`` parameters, through ``knots`` (s) where it is free."""


def spline_weights(nodes: Array, at: Array, ends: str) -> Array:
    """Return what each node's value weighs in a cubic spline's values, shape (F, N); to be read.

    ``nodes`` (N,) ascend, values are wanted ``at`` (F,), ``ends`` is scipy's ``bc_type``.
    """
    return _spline_weights(nodes.tobytes(), at.tobytes(), ends)


@lru_cache(maxsize=KEPT_SPLINES)
def _spline_weights(nodes: bytes, at: bytes, ends: str) -> Array:
    grid = np.frombuffer(nodes)
    from scipy.interpolate import CubicSpline  # loads slowly, and no live node needs it

    weights = np.asarray(CubicSpline(grid, np.eye(grid.size), bc_type=ends)(np.frombuffer(at)))
    weights.flags.writeable = False
    return weights


def moving_times(path: MetalPath, theta: Array, time: Array) -> tuple[float, float]:
    """Return when the body begins and ends its way, s."""
    if not path.knots:
        return float(theta[6]), float(theta[7])
    count = max(3, int((time.max() - time.min()) / FINE_STEP_S) + 1)
    fine = np.linspace(time.min(), time.max(), count)
    steps = np.linalg.norm(np.diff(path.centre(theta, fine), axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    share = way / max(float(way[-1]), 1e-9)
    first = int(np.searchsorted(share, NEGLIGIBLE_WAY))
    last = int(np.searchsorted(share, 1 - NEGLIGIBLE_WAY))
    return float(fine[max(first - 1, 0)]), float(fine[min(last, fine.size - 1)])


STEP = 1e-3
"""Step (m) of the central differences by the place: 1e-4 of an error at a decimetre."""
PATH_SAMPLES = 21
"""Times at which a record says where the metal is: two seconds apart in a session of 40 s."""
SHAPED = 60
"""Parameters that moving metal counts for at least when explanations are compared: a simple body
must not win against a fluctuation, which counts for 40 (`docs/log.md`)."""
SHORT_WAY = 0.02
"""Ends of the course nearer to each other than this (m) don't give a straight path a direction."""
UPWARDS = np.array([0.0, 0.0, -0.05])
"""What the straight path's start is shifted by then, m: metal that comes from below."""
KNOTS = 9
"""Knots of the free path that is tried first: one in 4.5 s of a session of 40 s."""


@dataclass(frozen=True, kw_only=True)
class MovingTerm(BodyTerm):
    """Holds metal on a path; theta is the path's parameters, then the modes' amplitudes."""

    path: MetalPath
    duration: float  # Of the session, s
    # Parameters of the path as the search started with; None for a term from a record
    first: Array | None = None

    @property
    def placed(self) -> int:
        """Return the number of the path's parameters, which come first in theta."""
        return self.path.count

    @property
    def knots(self) -> int:
        """Return knots of a free path; 0 for a straight one."""
        return len(self.path.knots)

    def centres(self, time: Array) -> Array:
        """Return where the body is at each time, (F, 3), m, frame fg."""
        return self.path.centre(self.course, time)

    def _seen(self, view: View, shift: Array) -> tuple[Array, ComplexArray]:
        """Amplitudes about the moving centre, of sensors (F, S, M) and of emitters (F, K, M)."""
        nodes, on_way, at = self.path.nodes(self.course, view.time)
        grid = (on_way + shift)[:, None, :] + self.shapes.offsets
        field = view.illumination.field(grid.reshape(-1, 3)).reshape(*grid.shape, -1)
        driven = np.ascontiguousarray(self.shapes.driven(field), dtype=np.complex128)
        flat = driven.reshape(nodes.size, -1).view(np.float64)  # real and imaginary by turns
        along = spline_weights(nodes, at, 'not-a-knot') @ flat
        drive = along.view(np.complex128).reshape(at.size, *driven.shape[1:])
        centre = self.centres(view.time) + shift
        return self.shapes.received(centre, view.centres, view.axes, view.sensors.length), drive

    def flux(self, view: View, shift: Array) -> ComplexArray:
        """Return the flux (F, S, K) of the whole body, moved by a shift (m)."""
        return self.shapes.flux(*self._seen(view, shift), self.couplings, view.omega)

    def unit(self, view: View) -> NDArray[np.inexact]:
        """Return the flux of each mode of unit amplitude, (F, S, K, m)."""
        return self.shapes.mode_flux(*self._seen(view, np.zeros(3)), self.modes, view.omega)

    def freer(self, knots: int) -> Self | None:
        """Return the same body on a free path with so many knots; None where it has as many."""
        if self.knots >= knots:
            return None
        time = np.linspace(0.0, self.duration, 6 * knots)
        path, course = FreePath.through(
            np.linspace(0.0, self.duration, knots), time, self.centres(time)
        )
        theta = np.concatenate([course, self.theta[self.placed :]])
        return replace(self, path=path, theta=theta)

    def restarted(self) -> Self | None:
        """Return the body on the path that the search started with."""
        if self.first is None:
            return None
        return self.with_theta(np.concatenate([self.first, self.theta[self.first.size :]]))


class MovingMetal(Effect[MovingTerm]):
    """Moves metal straight from rest to rest, or on a free path. The body doesn't turn."""

    name = 'moving_metal'
    summary = 'a metal object moves during the session'
    units = {
        'start_m': 'm', 'end_m': 'm', 't_start_s': 's', 't_end_s': 's',
        'path': 's and m', 'polarizability': 'm^3 (3x3, [re, im])',
    }  # fmt: skip
    remedy = Remedy.FIELD
    family = Family.MOVING_METAL
    inexact = np.inf
    followed = True
    still = STATIC_METAL

    def along(
        self, time: Array, course: Array, solution: Array, apparatus: Apparatus
    ) -> Sequence[MovingTerm]:
        """Return a straight and a free path along the best places."""
        duration, few = apparatus.duration, max(2, len(course) // 8)
        start, end = course[:few].mean(0), course[-few:].mean(0)
        path, knots = FreePath.through(np.linspace(0.0, duration, KNOTS), time, course)
        if np.linalg.norm(end - start) < SHORT_WAY:
            start = start + UPWARDS
        straight = np.concatenate([start, end, (0.2 * duration, 0.8 * duration), [0.5]])
        return (
            self.starting(StraightPath(), straight, duration, solution),
            self.starting(path, knots, duration, solution),
        )

    def starting(
        self, path: MetalPath, course: Array, duration: float, alpha: Array
    ) -> MovingTerm:
        """Return a simple body on a path with parameters ``course``; alpha: re, im in 1e-4 m^3."""
        modes = ball_modes()
        amplitudes = np.zeros((2, modes.shape[1]))
        amplitudes[:, 0] = alpha
        return MovingTerm(
            self, theta=np.concatenate([course, amplitudes.ravel()]), kind=COMPACT, modes=modes,
            spread=np.full(modes.shape[1], LARGEST), path=path, duration=float(duration),
            first=course,
        )  # fmt: skip

    def complexity(self, term: MovingTerm) -> int:
        """Return at least the number of parameters that it will have once it is shaped."""
        return max(int(term.theta.size), SHAPED)

    def body(self, term: MovingTerm) -> MovingTerm:
        return term

    def amounts(self, term: MovingTerm) -> Integers:
        return np.arange(term.placed, term.theta.size)

    def prior(self, term: MovingTerm) -> Array:
        """Return the path's own prior and the modes' sizes; held metal stays on its path."""
        path = term.path.prior()
        if term.held:
            path = np.full(path.size, FROZEN)
        return np.concatenate([path, term.spread, term.spread])

    def bounded(self, term: MovingTerm) -> MovingTerm:
        course = term.path.bounded(term.course)
        return term.with_theta(np.concatenate([course, term.theta[term.placed :]]))

    def columns(self, term: MovingTerm, view: View) -> ComplexArray:
        """Return derivatives by the path (differences, chained) and by the amplitudes (exact)."""
        unit = term.unit(view)
        out = np.empty((*view.flux.shape, term.theta.size), dtype=complex)
        ends = term.placed, term.placed + unit.shape[-1]
        out[..., ends[0] : ends[1]] = unit
        np.multiply(unit, 1j, out=out[..., ends[1] :])
        if term.held:
            out[..., : term.placed] = 0.0
            return out
        steps = STEP * np.eye(3)
        moved = in_order(lambda shift: term.flux(view, shift), [*steps, *-steps])
        by_place = (np.stack(moved[:3], axis=-1) - np.stack(moved[3:], axis=-1)) / (2 * STEP)
        rates = term.path.rates(term.course, view.time)
        each = by_place.reshape(len(rates), -1, 3) @ rates
        out[..., : term.placed] = each.reshape(*by_place.shape[:3], -1)
        return out

    def moving_flux(self, term: MovingTerm, view: View) -> ComplexArray:
        return term.flux(view, np.zeros(3))

    def record(self, term: MovingTerm, covariance: Array) -> EffectRecord:
        total, couplings = term.shapes.polarisability(term.couplings), UNIT * term.couplings
        times = np.linspace(0.0, term.duration, PATH_SAMPLES)
        start, end = moving_times(term.path, term.course, times)
        ends = np.array([start, end])
        at, spread = term.centres(ends), _place_sigma(term, covariance, ends)
        # Which point of a body is its centre, hardly anything tells; of an extended one, nothing.
        vague = max(centre_sigma(total), SPACINGS.get(term.kind, 0.0))
        spread = np.hypot(spread, vague)
        times_sigma = _time_sigma(term, covariance, start, end)
        return EffectRecord(
            self.name,
            {
                'start_m': at[0].tolist(), 'end_m': at[1].tolist(),
                't_start_s': start, 't_end_s': end,
                'path': {'time_s': times.tolist(), 'position_m': term.centres(times).tolist()},
                'polarizability': pairs_of(total), 'couplings_m3': pairs_of(couplings),
                'knots_s': list(term.path.knots), 'course': term.course.tolist(),
                'body': term.kind,
            },
            {
                'start_m': spread[0].tolist(), 'end_m': spread[1].tolist(),
                't_start_s': times_sigma[0], 't_end_s': times_sigma[1],
                'path': np.hypot(_place_sigma(term, covariance, times), vague).tolist(),
            },
        )  # fmt: skip

    def term(self, record: EffectRecord) -> MovingTerm:
        """Make the term from path and couplings; every coupling is a mode of its own."""
        knots = tuple(float(k) for k in record.needed('knots_s'))
        course = np.asarray(record.needed('course'), dtype=np.float64)
        couplings = np.asarray(record.needed('couplings_m3'), dtype=np.float64) / UNIT
        return MovingTerm(
            self, theta=np.concatenate([course, couplings.T.ravel()]),
            kind=str(record.needed('body')), modes=np.eye(len(couplings)),
            spread=np.full(len(couplings), LARGEST),
            path=FreePath(knots) if knots else StraightPath(),
            duration=float(record.needed('path')['time_s'][-1]),
        )  # fmt: skip


def _place_sigma(term: MovingTerm, covariance: Array, time: Array) -> Array:
    """Standard deviation of the centre at each time, (F, 3), m."""
    rates = term.path.rates(term.course, time)
    block = covariance[: term.placed, : term.placed]
    variance = np.einsum('fic,cd,fid->fi', rates, block, rates)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _time_sigma(
    term: MovingTerm, covariance: Array, start: float, end: float
) -> tuple[float, float]:
    """Standard deviation of the times when the way begins and ends, s."""
    knots = term.path.knots
    if not knots:
        first, last = sigmas(covariance)[6:8]
        return float(first), float(last)
    time = np.linspace(knots[0], knots[-1], PATH_SAMPLES * 8)
    centre = term.centres(time)
    # A body has certainly left a place only when it is farther away than its place is uncertain.
    known = 2.0 * np.linalg.norm(_place_sigma(term, covariance, time), axis=1)
    gone = np.flatnonzero(np.linalg.norm(centre - centre[0], axis=1) > known)
    coming = np.flatnonzero(np.linalg.norm(centre - centre[-1], axis=1) > known)
    knot = 0.5 * (knots[1] - knots[0])
    left = float(time[gone[0]]) if gone.size else knots[-1]
    there = float(time[coming[-1]]) if coming.size else knots[0]
    return float(np.hypot(knot, left - start)), float(np.hypot(knot, end - there))


@dataclass(frozen=True, kw_only=True)
class DepartedTerm(MovingTerm):
    """Holds metal that rested near while a field was learnt, and moves.

    The fitted field and the references' steady readings contain the metal at rest. The residual is
    its field at its present place, less that at its place of rest, so the motion determines its
    field at rest.
    """

    rest_s: float  # When it rests, s since the session's start

    @property
    def alone(self) -> MovingTerm:
        """Return the moving metal itself, not relative to where it rests."""
        return MovingTerm(**{key: v for key, v in vars(self).items() if key != 'rest_s'})

    def resting(self, view: View) -> View:
        """Return the view as if all of it were recorded while the metal rests."""
        return replace(view, time=np.full(view.time.shape, self.rest_s))

    def flux(self, view: View, shift: Array) -> ComplexArray:
        """Return the flux (F, S, K) of the whole body, moved by a shift (m), less that at rest."""
        return self.alone.flux(view, shift) - self.alone.flux(self.resting(view), shift)

    def unit(self, view: View) -> NDArray[np.inexact]:
        """Return the flux of each mode of unit amplitude, (F, S, K, m)."""
        return np.asarray(self.alone.unit(view) - self.alone.unit(self.resting(view)))

    def rest_flux(self, view: View) -> ComplexArray:
        """Return what the metal at rest adds to a view, (F, S, K), T."""
        return self.alone.flux(self.resting(view), np.zeros(3))

    def rest_columns(self, view: View) -> ComplexArray:
        """Return the derivative by the parameters of the flux of metal at rest, (F, S, K, q)."""
        return MovingMetal().columns(self.alone.free(), self.resting(view))


@dataclass(frozen=True)
class DepartedMetal(MovingMetal):
    """Takes metal on a free path from its rest and back; a model has none of it to correct."""

    rest_s: float  # When it rests, s since the session's start

    def starting(
        self, path: MetalPath, course: Array, duration: float, alpha: Array
    ) -> DepartedTerm:
        """Return a simple body on a path; arguments as of `MovingMetal.starting`."""
        plain = super().starting(path, course, duration, alpha)
        return DepartedTerm(**vars(plain), rest_s=self.rest_s)

    def columns(self, term: MovingTerm, view: View) -> ComplexArray:
        assert isinstance(term, DepartedTerm)
        rest = super().columns(term.alone, term.resting(view))
        return super().columns(term.alone, view) - rest


EFFECTS = (MovingMetal(),)
