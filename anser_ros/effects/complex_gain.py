"""Writes a complex gain as its deviation from one, and as the size and phase of a record."""

from typing import Any

import numpy as np

from anser_ros.effects.effect import Array, needed
from anser_ros.field.model import EffectRecord


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
