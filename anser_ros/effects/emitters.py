"""What is wrong with emitters: strength, its drift, leaking tones, place, size."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.effects.base import Apparatus, View
from anser_ros.effects.channels import ComplexGain
from anser_ros.effects.effect import Effect, Remedy, Site, Term, sigmas
from anser_ros.field.model import Dipoles, EffectRecord, size_figures, spread_along, symmetry_axis
from anser_ros.physics.rotations import rotation_of_vector, spatial


def _of_one(term: Term, emitters: int, factor: complex) -> ComplexArray:
    """Return the matrix (1, K, K) that multiplies the term's emitter by a factor."""
    matrix = np.eye(emitters, dtype=complex)
    matrix[term.site['coil'], term.site['coil']] = factor
    return matrix[None]


class CoilGain(ComplexGain):
    """Is the complex gain of one emitter."""

    name = 'coil_gain'
    summary = "an emitter's strength is not the calibrated one"
    units = {'coil': '1', 'gain': '1', 'phase_deg': 'deg'}
    installed = True

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        return [Term(self, {'coil': k}, np.zeros(2)) for k in range(apparatus.emitters)]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        own = view.linear[:, :, term.site['coil']] / (1 + complex(*term.theta))
        out = view.columns(2)
        out[:, :, term.site['coil'], 0], out[:, :, term.site['coil'], 1] = own, 1j * own
        return out

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        return _of_one(term, omega.size, 1 + complex(*term.theta))


PHASE_UNIT = 1e-3
"""theta counts milliradians."""


class CoilPhase(Effect[Term]):
    """Theta is the phase by which an emitter's current is ahead of what it is taken for, mrad."""

    name = 'coil_phase'
    summary = "an emitter's phase is not the calibrated one"
    units = {'coil': '1', 'phase_rad': 'rad'}
    plausible = {'phase_rad': (-0.5, 0.5)}
    remedy = Remedy.FLUX
    typical = 30.0  # phases of amplifiers and of their references are off by some degrees
    recorded = {'phase_rad': (1, PHASE_UNIT)}
    inexact = 0.1  # phases of single sensors, which it leaves, are off by some mrad too
    gregarious = True  # one wrong reference of the phases turns all of them, each by its own

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        return [Term(self, {'coil': k}, np.zeros(1)) for k in range(apparatus.emitters)]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        out = view.columns(1)
        out[:, :, term.site['coil'], 0] = 1j * PHASE_UNIT * view.linear[:, :, term.site['coil']]
        return out

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        return _of_one(term, omega.size, np.exp(1j * PHASE_UNIT * term.theta[0]))


PROBED_SHARES = (0.1, 0.5, 2.5)
"""Time constants of the probe, as shares of the session: from one that has ended early to one that
is nearly a straight line. Closer ones have nearly parallel columns."""


def _shape(time: Array, tau: float) -> Array:
    return np.asarray(1 - np.exp(-np.maximum(time, 0.0) / tau))


@dataclass(frozen=True, kw_only=True)
class CoilDriftTerm(Term):
    """Holds the drift of one emitter, or of all."""

    duration: float = 1.0  # Of the session, s; only the search needs it


class CoilDrift(Effect[CoilDriftTerm]):
    """Multiplies an emitter by 1 + a (1 - exp(-t/tau)); theta is a and log(tau / s)."""

    name = 'coil_drift'
    summary = "an emitter's strength changes with time"
    units = {'coil': '1', 'amount': '1', 'tau_s': 's'}
    plausible = {'amount': (-0.5, 0.5), 'tau_s': (0.25, 1600.0)}
    remedy = Remedy.FLUX
    size = 'amount'  # the key of a
    typical = (0.1, 1.6)  # some percent, and a time constant within a factor of five
    drifts = True

    def candidates(self, apparatus: Apparatus) -> Sequence[CoilDriftTerm]:
        duration = max(apparatus.duration, 1.0)
        start, coils = np.array([0.0, np.log(0.5 * duration)]), range(apparatus.emitters)
        return [CoilDriftTerm(self, {'coil': k}, start, duration=duration) for k in coils]

    def amounts(self, term: CoilDriftTerm) -> Integers:
        """Return the amount's index alone: a drift of nothing has any time constant."""
        return np.array([0])

    def _factor(self, term: CoilDriftTerm, time: Array) -> tuple[ComplexArray, ComplexArray]:
        """Return what the emitter is multiplied by (F,), and that by the curve's size."""
        curve = _shape(time, float(np.exp(term.theta[1])))
        return 1 + term.theta[0] * curve, np.ones(time.size, dtype=complex)

    def _changed(self, term: CoilDriftTerm, view: View, curves: Sequence[Array]) -> ComplexArray:
        """Return the emitter's flux by the size of some curves (F,)."""
        factor, slope = self._factor(term, view.time)
        out, which = view.columns(len(curves)), [term.site['coil']] if term.site else slice(None)
        own = view.linear[:, :, which] * (slope / factor)[:, None, None]
        out[:, :, which] = own[..., None] * np.stack(curves, axis=-1)[:, None, None]
        return out

    def columns(self, term: CoilDriftTerm, view: View) -> ComplexArray | None:
        """Return the emitter's flux times the derivatives of the curve."""
        amount, log_tau = term.theta
        tau = float(np.exp(log_tau))
        late = np.maximum(view.time, 0.0) / tau
        return self._changed(term, view, [_shape(view.time, tau), -amount * late * np.exp(-late)])

    def probe(self, term: CoilDriftTerm, view: View) -> ComplexArray | None:
        """Return the flux of drifts with three different time constants."""
        curves = [_shape(view.time, share * term.duration) for share in PROBED_SHARES]
        return self._changed(term, view, curves)

    def started(self, term: CoilDriftTerm, solution: Array) -> Sequence[CoilDriftTerm]:
        """Start with the time constant whose curve comes nearest to the probe's sum."""
        duration = term.duration
        time = np.linspace(0.0, duration, 60)
        curves = [_shape(time, share * duration) for share in PROBED_SHARES]
        wanted = solution @ curves
        taus = duration * np.geomspace(0.03, 5.0, 25)
        tried = np.array([_shape(time, tau) for tau in taus.tolist()])
        amounts = tried @ wanted / (tried**2).sum(axis=1)
        best = np.argmin(((wanted - amounts[:, None] * tried) ** 2).sum(axis=1))
        return (self.bounded(term.with_theta(np.array([amounts[best], np.log(taus[best])]))),)

    def bounded(self, term: CoilDriftTerm) -> CoilDriftTerm:
        """Keep the time constant between 0.3 and 1500 s, and the change at the session's end."""
        amount, log_tau = term.theta
        within = np.clip(log_tau, np.log(0.3), np.log(1500.0))
        end = np.exp(np.log(term.duration) - np.array([max(log_tau, within), within]))
        amount *= np.divide(*-np.expm1(-end))
        return term.with_theta(np.array([amount, within]))

    def emitter_matrix(self, term: CoilDriftTerm, time: Array, omega: Array) -> ComplexArray:
        matrix = np.repeat(np.eye(omega.size, dtype=complex)[None], time.size, axis=0)
        coils = [term.site['coil']] if 'coil' in term.site else np.arange(omega.size)
        matrix[:, coils, coils] = self._factor(term, time)[0][:, None]
        return matrix

    def record(self, term: CoilDriftTerm, covariance: Array) -> EffectRecord:
        sigma, tau = sigmas(covariance), float(np.exp(term.theta[1]))
        return EffectRecord(
            self.name,
            {**term.recorded_site, self.size: float(term.theta[0]), 'tau_s': tau},
            {self.size: float(sigma[0]), 'tau_s': tau * float(sigma[1])},
        )

    def term(self, record: EffectRecord) -> CoilDriftTerm:
        theta = np.array([float(record.needed(self.size)), np.log(float(record.needed('tau_s')))])
        return CoilDriftTerm(self, self.site_of(record), theta)


class CoilPhaseDrift(CoilDrift):
    """Turns an emitter's phase by a (1 - exp(-t/tau)); theta is a (rad) and log(tau / s)."""

    name = 'coil_phase_drift'
    summary = "an emitter's phase changes with time"
    units = {'coil': '1', 'phase_rad': 'rad', 'tau_s': 's'}
    plausible = {'phase_rad': (-0.5, 0.5), 'tau_s': (0.25, 1600.0)}
    size = 'phase_rad'

    def _factor(self, term: CoilDriftTerm, time: Array) -> tuple[ComplexArray, ComplexArray]:
        factor = np.exp(1j * term.theta[0] * _shape(time, float(np.exp(term.theta[1]))))
        return factor, 1j * factor


class CommonDrift(CoilDrift):
    """Multiplies all emitters alike, or the gain of all channels, which is the same."""

    name = 'common_drift'
    summary = 'the strength of all emitters, or the gain of all channels, changes with time'
    units = {'amount': '1', 'tau_s': 's'}

    def candidates(self, apparatus: Apparatus) -> Sequence[CoilDriftTerm]:
        first = super().candidates(apparatus)[0]
        return [replace(first, site={})]


class CoilCrosstalk(Effect[Term]):
    """Theta is the real and imaginary share of a one-way leak, or one real share both ways.

    Readings at the second coil's frequency contain a share of the first one's field.
    """

    name = 'coil_crosstalk'
    summary = "one emitter's tone leaks into another's"
    units = {'coils': '1', 'eps': '1', 'eps_quadrature': '1', 'mutual': '1'}
    plausible = {'eps': (-0.5, 0.5)}
    remedy = Remedy.FLUX
    typical = 0.1  # leaks amount to some percent
    recorded = {'eps': (1, 1.0), 'eps_quadrature': (1, 1.0)}  # a mutual leak has no quadrature

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        coils = range(apparatus.emitters)
        one_way = [Term(self, {'coils': p}, np.zeros(2)) for p in permutations(coils, 2)]
        both: list[Site] = [{'coils': p, 'mutual': True} for p in combinations(coils, 2)]
        return one_way + [Term(self, site, np.zeros(1)) for site in both]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the source emitter's flux, placed in the other emitter's tone."""
        source, target = term.site['coils']
        back = np.linalg.inv(self._matrix(term, view.omega.size))
        own = np.einsum('ab,fsb->fsa', back, view.linear)
        out = view.columns(term.theta.size)
        out[:, :, target, 0] = own[:, :, source]
        if term.site.get('mutual'):
            out[:, :, source, 0] = own[:, :, target]
        else:
            out[:, :, target, 1] = 1j * own[:, :, source]
        return out

    def _matrix(self, term: Term, emitters: int) -> ComplexArray:
        source, target = term.site['coils']
        matrix = np.eye(emitters, dtype=complex)
        if term.site.get('mutual'):
            matrix[target, source] = matrix[source, target] = term.theta[0]
        else:
            matrix[target, source] = complex(*term.theta)
        return matrix

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        return self._matrix(term, omega.size)[None]

    def term(self, record: EffectRecord) -> Term:
        site, eps = self.site_of(record), float(record.needed('eps'))
        if record.parameters.get('mutual'):
            return Term(self, {**site, 'mutual': True}, np.array([eps]))
        across = float(record.parameters.get('eps_quadrature', 0.0))
        return Term(self, site, np.array([eps, across]))


class CoilMoved(Effect[Term]):
    """Theta is the shift of one emitter, m, frame fg."""

    name = 'coil_moved'
    summary = 'an emitter is not where the model has it'
    units = {'coil': '1', 'shift_m': 'm'}
    plausible = {'shift_m': (-0.03, 0.03)}
    remedy = Remedy.FIELD
    typical = 3e-3  # emitters shift by some millimetres
    installed = True
    gradient_error = 0.07  # less lets references outvote tools with gradients that are guesses
    recorded = {'shift_m': (3, 1.0)}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        return [Term(self, {'coil': k}, np.zeros(3)) for k in range(apparatus.emitters)]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Move the sensor the other way, which does the same as moving the source."""
        coil = term.site['coil']
        out = view.columns(3)
        out[:, :, coil] = -np.moveaxis(view.d_position[..., coil], 2, -1)
        return out

    def sources(self, term: Term, base: Dipoles, light: Dipoles, omega: Array) -> Dipoles | None:
        return self._changed(term, base)

    def light(self, term: Term, illumination: Dipoles) -> Dipoles:
        """Move the emitter in the field that metal sees, too."""
        return illumination.joined(self._changed(term, illumination))

    def _changed(self, term: Term, base: Dipoles) -> Dipoles:
        """Return the emitter where it is, and less it where the model has it."""
        only = np.zeros_like(base.moments)
        only[:, term.site['coil']] = base.moments[:, term.site['coil']]
        used = np.flatnonzero(np.abs(only).any(axis=1))
        place, direction, moment = base.positions[used], base.directions[used], only[used]
        return Dipoles(*self._moved(term, place, direction), moment).joined(
            Dipoles(place, direction, -moment)
        )

    def _moved(self, term: Term, place: Array, direction: Array) -> tuple[Array, Array]:
        return place + term.theta, direction


@dataclass(frozen=True, kw_only=True)
class CoilTurnedTerm(Term):
    """Holds an emitter that turns about a point."""

    centre: tuple[float, ...]  # (3,), m, frame fg
    axis: tuple[float, ...] = (0.0, 0.0, 0.0)  # of its moment, a turn about which nobody sees

    @property
    def seen(self) -> Array:
        """Return what takes the turn about that axis off a rotation vector, (3, 3)."""
        return np.eye(3) - np.outer(self.axis, self.axis)


class CoilTurned(CoilMoved):
    """Theta is the rotation vector of one emitter about its middle, rad, frame fg."""

    name = 'coil_turned'
    summary = 'an emitter does not stand as the model has it'
    units = {'coil': '1', 'rotation_deg': 'deg', 'centre_m': 'm'}
    plausible = {'rotation_deg': (-15.0, 15.0)}
    typical = 0.03  # emitters are tilted by some degrees

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        light = apparatus.illumination
        weight = np.abs(light.moments) / np.maximum(np.abs(light.moments).sum(axis=0), 1e-300)
        whole = (light.moments.real.T @ light.directions).tolist()
        return [
            CoilTurnedTerm(
                self, {'coil': k}, np.zeros(3), centre=tuple(centre),
                axis=tuple(np.array(moment) / max(np.linalg.norm(moment), 1e-300)),
            )
            for k, (centre, moment) in enumerate(
                zip((weight.T @ light.positions).tolist(), whole, strict=True)
            )
        ]  # fmt: skip

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Turn the sensors the other way, which does the same as turning the source."""
        assert isinstance(term, CoilTurnedTerm)
        coil = term.site['coil']
        lever = view.centres - term.centre
        turn = np.cross(lever, view.d_position[..., coil]) + np.cross(
            view.axes, view.d_axis[..., coil]
        )
        out = view.columns(3)
        out[:, :, coil] = -turn @ spatial(term.seen @ term.theta) @ term.seen
        return out

    def _moved(self, term: Term, place: Array, direction: Array) -> tuple[Array, Array]:
        assert isinstance(term, CoilTurnedTerm)
        turn = rotation_of_vector(term.seen @ term.theta)
        return (place - term.centre) @ turn.T + term.centre, direction @ turn.T

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        assert isinstance(term, CoilTurnedTerm)
        turn = np.degrees(term.seen @ term.theta).tolist()
        figures = {'rotation_deg': turn, 'centre_m': list(term.centre)}
        covariance = term.seen @ covariance @ term.seen
        deviation = {'rotation_deg': np.degrees(sigmas(covariance)).tolist()}
        return EffectRecord(self.name, {**term.recorded_site, **figures}, deviation)

    def term(self, record: EffectRecord) -> Term:
        theta = np.radians(np.asarray(record.needed('rotation_deg'), dtype=np.float64))
        centre = tuple(float(value) for value in record.needed('centre_m'))
        return CoilTurnedTerm(self, self.site_of(record), theta, centre=centre)


SIZE_UNIT = 1e-4
"""theta counts second moments in units of (10 mm)^2."""


@dataclass(frozen=True, kw_only=True)
class EmitterSizeTerm(Term):
    """Holds an emitter that is the same all around an axis."""

    axis: Array  # (3,), unit vector, frame fg
    modelled_m2: float  # Second moment of the model's own dipoles of this emitter, m^2

    @property
    def second_moment_m2(self) -> float:
        """Return the second moment of the whole emitter, m^2."""
        return self.modelled_m2 + SIZE_UNIT * float(self.theta[0])


class EmitterSize(Effect[EmitterSizeTerm]):
    """Theta is what the second moment of an emitter has beside its model's, in (10 mm)^2.

    An emitter that is the same all around an axis has, after its dipole, the field of an octupole
    about its centre: that of dipoles spread along the axis, whose mean square distance from the
    centre, weighted by their moments, is its second moment s^2. The field is linear in it: s^2 / 2
    times the second derivative of the emitter's own field along the axis. A uniformly magnetised
    cylinder of length L and radius a has L^2 / 12 - a^2 / 4, a flat coil less than nothing.

    Metal sees the emitter as the model has it: what its size changes there is a small part of what
    metal changes at the sensors.
    """

    name = 'emitter_size'
    summary = 'an emitter is longer or flatter than its model'
    units = {'coil': '1', 'second_moment_m2': 'm^2', 'length_m': 'm', 'diameter_m': 'm'}
    plausible = {'length_m': (0.0, 1.0), 'diameter_m': (0.0, 1.0)}
    remedy = Remedy.FIELD
    typical = 100.0  # of magnets and coils of some decimetres

    def candidates(self, apparatus: Apparatus) -> Sequence[EmitterSizeTerm]:
        """Return a candidate for each emitter whose dipoles lie on one axis and point along it.

        Those of a drawn emitter do not, so that one whose size is known is no candidate.
        """
        light = apparatus.illumination
        axes = (
            symmetry_axis(light.positions, light.directions, m[:, None]) for m in light.moments.T
        )
        return [
            EmitterSizeTerm(
                self, {'coil': k}, np.zeros(1), axis=axis.direction,
                modelled_m2=axis.second_moment_m2,
            )
            for k, axis in enumerate(axes)
            if axis is not None
        ]  # fmt: skip

    def columns(self, term: EmitterSizeTerm, view: View) -> ComplexArray:
        """Return the flux that a unit of second moment adds."""
        unit = spread_along(view.illumination, term.site['coil'], term.axis, SIZE_UNIT)
        return view.along(unit.flux(*view.flat))[..., None]

    def sources(
        self, term: EmitterSizeTerm, base: Dipoles, light: Dipoles, omega: Array
    ) -> Dipoles | None:
        return spread_along(base, term.site['coil'], term.axis, SIZE_UNIT * float(term.theta[0]))

    def record(self, term: EmitterSizeTerm, covariance: Array) -> EffectRecord:
        sigma_m2 = SIZE_UNIT * float(np.sqrt(covariance[0, 0]))
        figures, sigmas = size_figures(term.second_moment_m2, sigma_m2)
        own = {'model_second_moment_m2': term.modelled_m2, 'axis': term.axis.tolist()}
        return EffectRecord(self.name, {'coil': term.site['coil'], **figures, **own}, sigmas)

    def term(self, record: EffectRecord) -> EmitterSizeTerm:
        modelled = float(record.needed('model_second_moment_m2'))
        theta = (float(record.needed('second_moment_m2')) - modelled) / SIZE_UNIT
        return EmitterSizeTerm(
            self, self.site_of(record), np.array([theta]),
            axis=np.asarray(record.needed('axis'), dtype=np.float64), modelled_m2=modelled,
        )  # fmt: skip


EFFECTS = (
    CoilGain(), CoilPhase(), CoilDrift(), CoilPhaseDrift(), CommonDrift(), CoilCrosstalk(),
    CoilMoved(), CoilTurned(), EmitterSize(),
)  # fmt: skip
