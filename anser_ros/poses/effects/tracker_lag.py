"""The tracker filters its poses by a low pass, which is more than a delay."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.base import Remedy
from anser_ros.effects.effect import needed, sigmas
from anser_ros.field.model import EffectRecord
from anser_ros.poses.effect import PoseEffect, PoseSetting, PoseTerm, Role
from anser_ros.poses.path import OpticalPath

Array = NDArray[np.float64]

TAUS_S = (0.015, 0.03, 0.06, 0.12, 0.24)
"""Time constants that are tried, s: below a hundredth no hand's motion distinguishes a filter from
a delay, beyond a quarter nobody would work with the tracker."""


class TrackerLag(PoseEffect):
    """Theta is the time constant, s, of a first-order low pass on position and rotation.

    To first order a filter is a delay, so only its smoothing distinguishes it from one: it has no
    slopes of its own, and is tried at several time constants beside a free time offset.
    """

    name = 'tracker_lag'
    summary = 'the tracker filters its poses, which rounds off quick motions'
    advice = 'Switch the filter of the tracker off, or move slowly.'
    units: ClassVar[Mapping[str, str]] = {'tau_s': 's'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'tau_s': (0.0, 1.0)}
    remedy = Remedy.NONE
    role = Role.FILTER

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        """Return one term for all sensors, which a tracker filters alike."""
        return [PoseTerm(self, {}, np.array([tau])) for tau in TAUS_S]

    def prior(self, term: PoseTerm) -> Array:
        """Return a prior spread of 0.1 s: lags are some tenths of a second."""
        return np.full(1, 0.1)

    def filter(self, term: PoseTerm, path: OpticalPath) -> OpticalPath:
        """Return the optical path as it is behind the tracker's filter."""
        return path.filtered(float(term.theta[0]), 'two_sided' in term.site)

    def rival(self, term: PoseTerm) -> PoseTerm:
        """Return the same smoothing without a sense of time."""
        return PoseTerm(self, {'two_sided': True}, term.theta)

    def record(self, term: PoseTerm, covariance: Array) -> EffectRecord:
        """Record the filter's time constant and its uncertainty, s."""
        sigma = float(sigmas(covariance)[0])
        return EffectRecord(self.name, {'tau_s': float(term.theta[0])}, {'tau_s': sigma})

    def term(self, record: EffectRecord) -> PoseTerm:
        """Read the filter's time constant, s, from a record."""
        return PoseTerm(self, {}, np.array([float(needed(record, 'tau_s'))]))


EFFECTS = (TrackerLag(),)
