"""A channel compresses large signals.

The amplifier sees the sum of all tones, v(t), and gives fs tanh(v / fs), or its first two terms v
- v^3 / (3 fs^2). The cube reduces tone k by ``(S / 2 - |V_k|^2 / 4) / fs^2``, where S is the sum
of the squared amplitudes of all tones, of independent phases: the other tones count twice.

What the amplifier sees is either the flux, as behind an integrator, or the voltage that it
induces, in which a tone counts in proportion to its frequency.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import (
    Array,
    ComplexArray,
    Effect,
    Remedy,
    Site,
    Term,
    needed,
    recorded_site,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.model import EffectRecord

UNIT = 1e12
"""theta counts 1/fs^2 in units of 1/uT^2."""
POINTS, GENERATOR = 1021, 331
"""Size and generator of the lattice of phases (Korobov)."""
SHAPES = ('cubic', 'tanh')
FLUX, VOLTAGE = 'flux', 'voltage'
"""What the amplifier may see."""
CURVE = 0.2
"""Share (0 to 1) of a saturation's power that its model may miss: the true curve is none of those
that are tried. It was chosen by hand on injected effects (`docs/log.md`)."""


def third_order(flux: ComplexArray) -> ComplexArray:
    """Return what one unit of 1/fs^2 adds to fluxes (..., K), to third order."""
    squared = np.abs(flux) ** 2
    total = squared.sum(axis=-1, keepdims=True)
    return np.asarray(-(0.5 * total - 0.25 * squared) * flux)


def compressed(flux: ComplexArray, per_full_scale_squared: float, shape: str) -> ComplexArray:
    """Return amplitudes (..., K) behind the amplifier, averaged over the phases of the tones.

    The third order is exact; what lies above it is an average over a fixed lattice of phases.
    """
    third = flux + per_full_scale_squared * third_order(flux)
    if shape == 'cubic' or per_full_scale_squared <= 0.0:
        return np.asarray(third)
    full_scale = 1 / np.sqrt(per_full_scale_squared)
    steps = np.array([pow(GENERATOR, k, POINTS) for k in range(flux.shape[-1])])
    phase = 2 * np.pi * ((np.arange(POINTS)[:, None] * steps) % POINTS) / POINTS
    turn = np.exp(1j * phase)
    x = ((flux / full_scale) @ turn.T).real
    rest = full_scale * (np.tanh(x) - x + x**3 / 3)
    return np.asarray(third + (rest @ turn.conj()) * (2 / POINTS))


@dataclass(frozen=True, kw_only=True)
class SaturationTerm(Term):
    """Holds the saturation of one channel."""

    weights: Array  # (K,), what each emitter's tone counts in what the amplifier sees


class Saturation(Effect[SaturationTerm]):
    """Theta is one over the squared full scale, in 1/uT^2."""

    name = 'saturation'
    summary = 'a channel compresses large signals'
    units = {
        'channel': '1', 'full_scale_t': 'T', 'shape': 'name of the curve',
        'sees': 'flux or voltage', 'tone_weights': '1',
    }  # fmt: skip
    plausible = {'full_scale_t': (1e-8, 1e-3)}
    remedy = Remedy.FLUX
    typical = 3.0  # full scales down to the size of the signals
    inexact = CURVE

    def candidates(self, apparatus: Apparatus) -> Sequence[SaturationTerm]:
        """Try every channel of a tool; references don't see signals of different size."""
        weights = {FLUX: np.ones(apparatus.emitters)}
        voltage = apparatus.omega / apparatus.omega.mean()
        if not np.allclose(voltage, 1.0):
            weights[VOLTAGE] = voltage
        return [
            SaturationTerm(
                self, {'channel': c, 'shape': shape, 'sees': sees}, np.zeros(1), weights=w
            )
            for c in apparatus.tool_channels
            for shape in SHAPES
            for sees, w in weights.items()
        ]

    def covers(self, term: SaturationTerm, candidate: Term) -> bool:
        """Return whether the term is on the candidate's channel, which has one curve only."""
        return candidate.effect is self and candidate.channels == term.channels

    def columns(self, term: SaturationTerm, view: View) -> ComplexArray | None:
        """Return the third-order loss, or differences along the whole curve."""
        row = view.row(term.site['channel'])
        if row is None:
            return None
        weights = term.weights
        out, own = view.columns(1), view.linear[:, row] * weights
        if term.theta[0] <= 0:
            slope = UNIT * third_order(own)
        else:
            step, shape = 0.01 * term.theta[0], term.site['shape']
            more = compressed(own, UNIT * (term.theta[0] + step), shape)
            slope = (more - compressed(own, UNIT * (term.theta[0] - step), shape)) / (2 * step)
        out[:, row, :, 0] = slope / weights
        return out

    def compress(
        self, term: SaturationTerm, channels: NDArray[np.int64], flux: ComplexArray
    ) -> ComplexArray:
        """Return the fluxes as the saturated channel's amplifier passes them on."""
        out, weights = flux.copy(), term.weights
        for row in np.flatnonzero(channels == term.site['channel']):
            seen = flux[:, row] * weights
            passed = compressed(seen, UNIT * float(term.theta[0]), term.site['shape'])
            out[:, row] = passed / weights
        return out

    def record(self, term: SaturationTerm, covariance: Array) -> EffectRecord:
        """Record the full scale and the curve."""
        value = max(float(term.theta[0]), 1e-9)
        full_scale = 1 / np.sqrt(UNIT * value)
        relative = 0.5 * float(np.sqrt(covariance[0, 0])) / value
        parameters = {
            **recorded_site(term),
            'full_scale_t': float(full_scale),
            'tone_weights': term.weights.tolist(),
        }
        return EffectRecord(self.name, parameters, {'full_scale_t': float(full_scale * relative)})

    def term(self, record: EffectRecord) -> SaturationTerm:
        """Read the channel's full scale, T, from a record."""
        full_scale = float(needed(record, 'full_scale_t'))
        site: Site = {
            **self.site_of(record),
            'shape': str(record.parameters.get('shape', SHAPES[0])),
            'sees': str(record.parameters.get('sees', FLUX)),
        }
        weights = np.asarray(record.parameters.get('tone_weights', 1.0), dtype=np.float64)
        theta = np.array([1 / (UNIT * full_scale**2)])
        return SaturationTerm(self, site, theta, weights=weights)


EFFECTS = (Saturation(),)
