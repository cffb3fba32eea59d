"""The optical tracker's millimetre is not the tracker's, for all sensors alike."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.base import Remedy
from anser_ros.poses.effect import NumberEffect, PoseSetting, PoseTerm, PoseView, Role

Array = NDArray[np.float64]


class PoseOpticalScale(NumberEffect):
    """Theta is the scale of the optical positions less one, in 1e-3."""

    name = 'optical_scale'
    summary = "the optical tracker's millimetre is too long or too short for the tracker's"
    advice = 'Measure a known length with both: it shows which of them is wrong.'
    units = {'scale': '1'}
    plausible = {'scale': (0.9, 1.1)}
    remedy = Remedy.OPTICAL
    blocks_in_space = True
    role = Role.SCALE
    key, base, factor = 'scale', 1.0, 1e-3
    spread = 30.0  # scales are off by some percent

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        """Try one reference for all sensors, scaled about the middle of what it saw."""
        return [PoseTerm(self, {}, np.zeros(1))]

    def is_scale(self, term: PoseTerm) -> bool:
        """Return that it is a scale."""
        return True

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Shrink positions towards the optical origin; the registration takes the rest."""
        out = np.zeros((view.time.size, 6, 1))
        out[:, :3, 0] = -1e-3 * view.optical @ view.frame.T / (1 + 1e-3 * term.theta[0])
        return out

    def seen(self, term: PoseTerm, position: Array) -> Array:
        """Return the positions as the optical tracker scales them, m."""
        return position / (1 + 1e-3 * float(term.theta[0]))


EFFECTS = (PoseOpticalScale(),)
