"""An emitter's strength changes with time, as its copper or its driver warms up."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Term,
    needed,
    sigmas,
    unit_matrix,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.model import EffectRecord

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
    plausible = {
        'amount': (-0.5, 0.5),
        'tau_s': (0.5, 1000.0),
    }
    remedy = Remedy.FLUX
    drifts = True

    def candidates(self, apparatus: Apparatus) -> Sequence[CoilDriftTerm]:
        """Return a candidate for every emitter."""
        start = np.array([0.0, np.log(0.5 * max(apparatus.duration, 1.0))])
        return [
            CoilDriftTerm(self, {'coil': k}, start, duration=max(apparatus.duration, 1.0))
            for k in range(apparatus.emitters)
        ]

    def amounts(self, term: CoilDriftTerm) -> NDArray[np.int64]:
        """Return the amount's index alone: a drift of nothing has any time constant."""
        return np.array([0])

    def prior(self, term: CoilDriftTerm) -> Array:
        """Expect amounts of some percent, and time constants known to a factor of five."""
        return np.array([0.1, 1.6])

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
        best: tuple[float, Array] | None = None
        for tau in duration * np.geomspace(0.03, 5.0, 25):
            curve = _shape(time, float(tau))
            amount = float(curve @ wanted / (curve @ curve))
            misfit = float(np.sum((wanted - amount * curve) ** 2))
            if best is None or misfit < best[0]:
                best = (misfit, np.array([amount, np.log(tau)]))
        return (term.with_theta(best[1] if best else term.theta),)

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
        return CoilDriftTerm(self, {'coil': int(needed(record, 'coil'))}, theta)


EFFECTS = (CoilDrift(),)
