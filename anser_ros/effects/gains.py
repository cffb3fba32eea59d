"""A gain is off: of a channel, a tool, or an emitter, which may also drift; or phasors are late."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Term,
    needed,
    recorded_site,
    sigmas,
    unit_matrix,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.model import EffectRecord


class ComplexGain(Effect[Term]):
    """Theta is the real and imaginary part of (gain - 1) of what the site names."""

    plausible = {'gain': (0.2, 3.0), 'phase_deg': (-60.0, 60.0)}
    remedy = Remedy.FLUX
    typical = 0.3  # gains are within some ten percent of one

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the gain's size and phase."""
        figures, deviations = figures_of(term.theta, covariance)
        return EffectRecord(self.name, {**recorded_site(term), **figures}, deviations)

    def term(self, record: EffectRecord) -> Term:
        """Return the term of a gain and a phase; a record without a phase has none."""
        phase = np.radians(float(record.parameters.get('phase_deg', 0.0)))
        gain = float(needed(record, 'gain')) * np.exp(1j * phase)
        return Term(self, self.site_of(record), np.array([gain.real - 1, gain.imag]))


def figures_of(theta: Array, covariance: Array) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return ``gain`` and ``phase_deg`` of a record, and their standard deviations.

    ``theta`` (2,) is the real and imaginary part of (gain - 1).
    """
    gain = 1 + complex(*theta)
    along = np.array([gain.real, gain.imag]) / abs(gain)
    across = np.array([-along[1], along[0]]) / abs(gain)
    sigma_gain, sigma_rad = (np.sqrt(way @ covariance @ way) for way in (along, across))
    return (
        {'gain': abs(gain), 'phase_deg': float(np.degrees(np.angle(gain)))},
        {'gain': float(sigma_gain), 'phase_deg': float(np.degrees(sigma_rad))},
    )


class CoilGain(ComplexGain):
    """Is the complex gain of one emitter."""

    name = 'coil_gain'
    summary = "an emitter's strength is not the calibrated one"
    units = {'coil': '1', 'gain': '1', 'phase_deg': 'deg'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every emitter."""
        return [Term(self, {'coil': k}, np.zeros(2)) for k in range(apparatus.emitters)]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the emitter's own flux, for the real and the imaginary part of its gain."""
        own = view.linear[:, :, term.site['coil']] / (1 + complex(*term.theta))
        out = view.columns(2)
        out[:, :, term.site['coil'], 0], out[:, :, term.site['coil'], 1] = own, 1j * own
        return out

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        """Return a unit matrix with the emitter's complex gain on its diagonal."""
        matrix = unit_matrix(omega.size)
        matrix[term.site['coil'], term.site['coil']] = 1 + complex(*term.theta)
        return matrix[None]


class GainOfChannels(ComplexGain):
    """Is a complex gain of the channels that a term's site names."""

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the channels' own flux, in phase and turned by a quarter."""
        rows = np.isin(view.sensors.channel, term.channels)
        if not rows.any():
            return None
        out = view.columns(2)
        own = view.linear[:, rows] / (1 + complex(*term.theta))
        out[:, rows] = np.stack([own, 1j * own], axis=-1)
        return out

    def channel_matrix(self, term: Term, channels: NDArray[np.int64]) -> ComplexArray:
        """Return a unit matrix with the gain in the channels' rows."""
        own = np.isin(channels, term.channels)
        return np.diag(np.where(own, 1 + complex(*term.theta), 1.0))


class SensorGain(GainOfChannels):
    """Is the complex gain of one channel."""

    name = 'sensor_gain'
    summary = "one sensor's gain is off"
    units = {'channel': '1', 'gain': '1', 'phase_deg': 'deg'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a term for every channel, references too."""
        return [Term(self, {'channel': c}, np.zeros(2)) for c in apparatus.channels]


class ToolGain(GainOfChannels):
    """Is the complex gain of all of a tool's channels."""

    name = 'tool_gain'
    summary = "the gain that all of a tool's sensors share is off"
    units = {'channels': '1', 'gain': '1', 'phase_deg': 'deg'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every body with two sensors or more."""
        tools = [tuple(table.channel.tolist()) for table in apparatus.tools if len(table) > 1]
        return [Term(self, {'channels': channels}, np.zeros(2)) for channels in tools]


PROBED_SHARES = (0.1, 0.5, 2.5)
"""Time constants of the probe, as shares of the session: from one that has ended early to one that
is nearly a straight line. Closer ones have nearly parallel columns; fewer miss courses between
them."""


def _shape(time: Array, tau: float) -> Array:
    return np.asarray(1 - np.exp(-np.maximum(time, 0.0) / tau))


@dataclass(frozen=True, kw_only=True)
class CoilDriftTerm(Term):
    """Holds the drift of one emitter."""

    duration: float = 1.0  # Of the session, s; only the search needs it


class CoilDrift(Effect[CoilDriftTerm]):
    """Multiplies an emitter by 1 + a (1 - exp(-t/tau)); theta is a and log(tau / s)."""

    name = 'coil_drift'
    summary = "an emitter's strength changes with time"
    units = {'coil': '1', 'amount': '1', 'tau_s': 's'}
    plausible = {'amount': (-0.5, 0.5), 'tau_s': (0.5, 1000.0)}
    remedy = Remedy.FLUX
    typical = (0.1, 1.6)  # some percent, and a time constant within a factor of five
    drifts = True

    def candidates(self, apparatus: Apparatus) -> Sequence[CoilDriftTerm]:
        """Return a candidate for every emitter."""
        duration = max(apparatus.duration, 1.0)
        start, coils = np.array([0.0, np.log(0.5 * duration)]), range(apparatus.emitters)
        return [CoilDriftTerm(self, {'coil': k}, start, duration=duration) for k in coils]

    def amounts(self, term: CoilDriftTerm) -> NDArray[np.int64]:
        """Return the amount's index alone: a drift of nothing has any time constant."""
        return np.array([0])

    def _own(self, term: CoilDriftTerm, view: View) -> ComplexArray:
        coil, (amount, log_tau) = term.site['coil'], term.theta
        factor = 1 + amount * _shape(view.time, float(np.exp(log_tau)))
        return np.asarray(view.linear[:, :, coil] / factor[:, None])

    def columns(self, term: CoilDriftTerm, view: View) -> ComplexArray | None:
        """Return the emitter's flux times the derivatives of the curve."""
        amount, log_tau = term.theta
        tau = float(np.exp(log_tau))
        own, late = self._own(term, view), np.maximum(view.time, 0.0) / tau
        out = view.columns(2)
        out[:, :, term.site['coil'], 0] = own * _shape(view.time, tau)[:, None]
        out[:, :, term.site['coil'], 1] = own * (-amount * late * np.exp(-late))[:, None]
        return out

    def probe(self, term: CoilDriftTerm, view: View) -> ComplexArray | None:
        """Return the flux of drifts with three different time constants."""
        own = self._own(term, view)
        out = view.columns(len(PROBED_SHARES))
        for i, share in enumerate(PROBED_SHARES):
            curve = _shape(view.time, share * term.duration)
            out[:, :, term.site['coil'], i] = own * curve[:, None]
        return out

    def started(self, term: CoilDriftTerm, solution: Array) -> Sequence[CoilDriftTerm]:
        """Start with the time constant whose curve comes nearest to the probe's sum."""
        duration = term.duration
        time = np.linspace(0.0, duration, 60)
        curves = [_shape(time, share * duration) for share in PROBED_SHARES]
        wanted = sum(a * c for a, c in zip(solution, curves, strict=True))
        misfits = []
        for tau in duration * np.geomspace(0.03, 5.0, 25):
            curve = _shape(time, float(tau))
            amount = float(curve @ wanted / (curve @ curve))
            misfits.append((float(np.sum((wanted - amount * curve) ** 2)), amount, np.log(tau)))
        return (term.with_theta(np.array(min(misfits)[1:])),)

    def bounded(self, term: CoilDriftTerm) -> CoilDriftTerm:
        """Keep the time constant between half a second and a quarter of an hour."""
        amount, log_tau = term.theta
        return term.with_theta(np.array([amount, np.clip(log_tau, np.log(0.3), np.log(1500.0))]))

    def emitter_matrix(self, term: CoilDriftTerm, time: Array, omega: Array) -> ComplexArray:
        """Return the emitter's factor at each time, on the diagonal."""
        amount, log_tau = term.theta
        matrix = np.repeat(unit_matrix(omega.size)[None], time.size, axis=0)
        coil = term.site['coil']
        matrix[:, coil, coil] = 1 + amount * _shape(time, float(np.exp(log_tau)))
        return matrix

    def record(self, term: CoilDriftTerm, covariance: Array) -> EffectRecord:
        """Record the emitter, the amount of its drift and the time constant, s."""
        sigma, tau = sigmas(covariance), float(np.exp(term.theta[1]))
        return EffectRecord(
            self.name,
            {'coil': term.site['coil'], 'amount': float(term.theta[0]), 'tau_s': tau},
            {'amount': float(sigma[0]), 'tau_s': tau * float(sigma[1])},
        )

    def term(self, record: EffectRecord) -> CoilDriftTerm:
        """Read the emitter, the amount of its drift and the time constant, s, from a record."""
        theta = np.array([float(needed(record, 'amount')), np.log(float(needed(record, 'tau_s')))])
        return CoilDriftTerm(self, self.site_of(record), theta)


DELAY_UNIT = 1e-6
"""theta counts microseconds."""


class PhaseDelay(Effect[Term]):
    """Theta is the delay d, us: a phasor at w becomes exp(-j w d) times itself."""

    name = 'phase_delay'
    summary = 'a common acquisition delay turns all phasors'
    units = {'delay_s': 's'}
    plausible = {'delay_s': (-5e-5, 5e-5)}
    remedy = Remedy.FLUX
    typical = 5.0  # delays are some microseconds
    recorded = {'delay_s': (1, DELAY_UNIT)}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return one candidate, as one delay holds for all channels."""
        return [Term(self, {}, np.zeros(1))]

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return minus j omega times the flux, for a microsecond of delay."""
        return np.asarray((-1j * DELAY_UNIT * view.omega * view.linear)[..., None])

    def emitter_matrix(self, term: Term, time: Array, omega: Array) -> ComplexArray:
        """Return the turn of each emitter's phasors on the diagonal."""
        return np.diag(np.exp(-1j * omega * term.theta[0] * DELAY_UNIT))[None]


EFFECTS = (
    CoilGain(),
    SensorGain(),
    ToolGain(),
    CoilDrift(),
    PhaseDelay(),
)
