"""The tracker filters its poses by a low pass, which is more than a delay."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.base import Remedy
from anser_ros.poses.effect import NumberEffect, PoseSetting, PoseTerm, Role
from anser_ros.poses.path import OpticalPath

Array = NDArray[np.float64]

TAUS_S = (0.015, 0.03, 0.06, 0.12, 0.24)
"""Time constants that are tried, s: below a hundredth no hand's motion distinguishes a filter from
a delay, beyond a quarter nobody would work with the tracker."""


class TrackerLag(NumberEffect):
    """Theta is the time constant, s, of a first-order low pass on position and rotation.

    To first order a filter is a delay, so only its smoothing distinguishes it from one: it has no
    slopes of its own, and is tried at several time constants beside a free time offset.
    """

    name = 'tracker_lag'
    summary = 'the tracker filters its poses, which rounds off quick motions'
    advice = 'Switch the filter of the tracker off, or move slowly.'
    units = {'tau_s': 's'}
    plausible = {'tau_s': (0.0, 1.0)}
    remedy = Remedy.NONE
    role = Role.FILTER
    key = 'tau_s'
    spread = 0.1  # s: lags are some tenths of a second

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        """Return one term for all sensors, which a tracker filters alike."""
        return [PoseTerm(self, {}, np.array([tau])) for tau in TAUS_S]

    def filter(self, term: PoseTerm, path: OpticalPath) -> OpticalPath:
        """Return the optical path as it is behind the tracker's filter."""
        return path.filtered(float(term.theta[0]), 'two_sided' in term.site)

    def rival(self, term: PoseTerm) -> PoseTerm:
        """Return the same smoothing without a sense of time."""
        return PoseTerm(self, {'two_sided': True}, term.theta)


EFFECTS = (TrackerLag(),)
