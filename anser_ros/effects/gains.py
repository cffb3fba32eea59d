"""A complex gain is off: of one channel, of all channels of a tool, or of an emitter."""

from collections.abc import Sequence
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
    unit_matrix,
    whole_numbers,
)
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.model import EffectRecord


class ComplexGain(Effect[Term]):
    """Theta is the real and imaginary part of (gain - 1) of what the site names."""

    plausible = {
        'gain': (0.2, 3.0),
        'phase_deg': (-60.0, 60.0),
    }
    remedy = Remedy.FLUX

    def prior(self, term: Term) -> Array:
        """Expect a gain within some ten percent of one."""
        return np.full(2, 0.3)

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the gain's size and phase."""
        figures, sigmas = figures_of(term.theta, covariance)
        return EffectRecord(self.name, {**recorded_site(term), **figures}, sigmas)


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


def figures_of(theta: Array, covariance: Array) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return ``gain`` and ``phase_deg`` of a record, and their standard deviations.

    Parameters
    ----------
    theta : ndarray, shape (2,)
        Real and imaginary part of (gain - 1).
    covariance : ndarray, shape (2, 2)
    """
    gain = 1 + complex(*theta)
    along = np.array([gain.real, gain.imag]) / abs(gain)
    across = np.array([-along[1], along[0]]) / abs(gain)
    sigma_gain, sigma_rad = (np.sqrt(way @ covariance @ way) for way in (along, across))
    return (
        {'gain': abs(gain), 'phase_deg': float(np.degrees(np.angle(gain)))},
        {'gain': float(sigma_gain), 'phase_deg': float(np.degrees(sigma_rad))},
    )


def theta_of(record: EffectRecord) -> Array:
    """Return theta (2,) of a record; one without a phase has none."""
    phase = np.radians(float(record.parameters.get('phase_deg', 0.0)))
    gain = float(needed(record, 'gain')) * np.exp(1j * phase)
    return np.array([gain.real - 1, gain.imag])


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

    def term(self, record: EffectRecord) -> Term:
        """Return the term of a gain and a phase."""
        return Term(self, {'coil': int(needed(record, 'coil'))}, theta_of(record))


class SensorGain(GainOfChannels):
    """Is the complex gain of one channel."""

    name = 'sensor_gain'
    summary = "one sensor's gain is off"
    units = {'channel': '1', 'gain': '1', 'phase_deg': 'deg'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a term for every channel, references too."""
        return [Term(self, {'channel': c}, np.zeros(2)) for c in apparatus.channels]

    def term(self, record: EffectRecord) -> Term:
        """Return the term of a gain and a phase."""
        return Term(self, {'channel': int(needed(record, 'channel'))}, theta_of(record))


class ToolGain(GainOfChannels):
    """Is the complex gain of all of a tool's channels."""

    name = 'tool_gain'
    summary = "the gain that all of a tool's sensors share is off"
    units = {'channels': '1', 'gain': '1', 'phase_deg': 'deg'}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return a candidate for every body with two sensors or more."""
        return [
            Term(self, {'channels': tuple(int(c) for c in table.channel)}, np.zeros(2))
            for table in apparatus.tools
            if len(table) > 1
        ]

    def term(self, record: EffectRecord) -> Term:
        """Return the term of a gain and a phase."""
        return Term(self, {'channels': whole_numbers(record, 'channels')}, theta_of(record))


EFFECTS = (
    CoilGain(),
    SensorGain(),
    ToolGain(),
)
