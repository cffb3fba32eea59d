"""Holds what complex gains share that are off, of a channel, a tool or an emitter."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, needed, recorded_site
from anser_ros.effects.term import Term
from anser_ros.effects.view import View
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
