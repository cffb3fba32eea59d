"""The optical tracker's millimetre is not the tracker's, for all sensors alike."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from anser_ros.effects.base import Remedy
from anser_ros.effects.effect import needed, sigmas
from anser_ros.field.model import EffectRecord
from anser_ros.poses.effect import PoseEffect, PoseSetting, PoseTerm, PoseView, Role

Array = NDArray[np.float64]


class PoseOpticalScale(PoseEffect):
    """Theta is the scale of the optical positions less one, in 1e-3."""

    name = 'optical_scale'
    summary = "the optical tracker's millimetre is too long or too short for the tracker's"
    advice = 'Measure a known length with both: it shows which of them is wrong.'
    units: ClassVar[Mapping[str, str]] = {'scale': '1'}
    plausible: ClassVar[Mapping[str, tuple[float, float]]] = {'scale': (0.9, 1.1)}
    remedy = Remedy.OPTICAL
    blocks_in_space = True
    role = Role.SCALE

    def sites(self, setting: PoseSetting) -> Sequence[PoseTerm]:
        """Try one reference for all sensors, scaled about the middle of what it saw."""
        return [PoseTerm(self, {}, np.zeros(1))]

    def is_scale(self, term: PoseTerm) -> bool:
        """Return that it is a scale."""
        return True

    def prior(self, term: PoseTerm) -> Array:
        """Return a prior spread of 3 %, as scales are off by some percent."""
        return np.full(1, 30.0)

    def slopes(self, term: PoseTerm, view: PoseView) -> Array | None:
        """Shrink positions towards the optical origin; the registration takes the rest."""
        out = np.zeros((view.time.size, 6, 1))
        out[:, :3, 0] = -1e-3 * view.optical @ view.frame.T / (1 + 1e-3 * term.theta[0])
        return out

    def seen(self, term: PoseTerm, position: Array) -> Array:
        """Return the positions as the optical tracker scales them, m."""
        return position / (1 + 1e-3 * float(term.theta[0]))

    def record(self, term: PoseTerm, covariance: Array) -> EffectRecord:
        """Record the scale and its uncertainty."""
        sigma = 1e-3 * float(sigmas(covariance)[0])
        scale = 1 + 1e-3 * float(term.theta[0])
        return EffectRecord(self.name, {'scale': scale}, {'scale': sigma})

    def term(self, record: EffectRecord) -> PoseTerm:
        """Read the scale from a record."""
        return PoseTerm(self, {}, np.array([1e3 * (float(needed(record, 'scale')) - 1)]))


EFFECTS = (PoseOpticalScale(),)
