"""The optical tracker's clock runs at another rate than the fluxes'."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from anser_ros.effects.apparatus import Apparatus
from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, needed, sigmas
from anser_ros.effects.term import Term
from anser_ros.effects.time_offset import flux_rate
from anser_ros.effects.view import View
from anser_ros.field.model import EffectRecord
from anser_ros.physics.pose_track import PoseTrack


class ClockRate(Effect[Term]):
    """Theta is an offset a (s) and a rate b (s a second): optical t' counts as t' + a + b t'."""

    name = 'clock_rate'
    summary = "one of the two clocks runs slow, so that the stamps' offset grows"
    units = {'offset_s': 's', 'rate_ppm': '1e-6'}
    plausible = {
        'offset_s': (-0.5, 0.5),
        'rate_ppm': (-2e4, 2e4),
    }
    remedy = Remedy.OPTICAL

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return one candidate, as all bodies share the optical clock."""
        return [Term(self, {}, np.zeros(2))] if apparatus.tools else []

    def prior(self, term: Term) -> Array:
        """Expect a tenth of a second, and a few thousand parts per million."""
        return np.array([0.1, 3e-3])

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return minus the flux's rate of change, constant and growing with time."""
        if view.is_reference:
            return None
        rate = -flux_rate(view)
        return np.stack([rate, rate * view.time[:, None, None]], axis=-1)

    def optical(self, term: Term, track: PoseTrack) -> PoseTrack:
        """Return the optical track with its stamps on the fluxes' clock."""
        return replace(track, time=track.time * (1 + term.theta[1]) + term.theta[0])

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the offset and the rate."""
        sigma = sigmas(covariance)
        return EffectRecord(
            self.name,
            {'offset_s': float(term.theta[0]), 'rate_ppm': 1e6 * float(term.theta[1])},
            {'offset_s': float(sigma[0]), 'rate_ppm': 1e6 * float(sigma[1])},
        )

    def term(self, record: EffectRecord) -> Term:
        """Return the term of an offset and a rate."""
        rate = 1e-6 * float(needed(record, 'rate_ppm'))
        return Term(self, {}, np.array([float(needed(record, 'offset_s')), rate]))


EFFECTS = (ClockRate(),)
