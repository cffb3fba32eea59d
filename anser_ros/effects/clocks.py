"""The optical tracker's clock is ahead of the fluxes', or behind, or runs at another rate."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, Term, needed, sigmas
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.model import EffectRecord
from anser_ros.physics.pose_track import PoseTrack


def flux_rate(view: View) -> ComplexArray:
    """Return the time derivative of the flux by the body's motion, (F, S, K), T/s."""
    lever = view.centres - view.position[:, None, :]
    moving = view.velocity[:, None, :3] + np.cross(view.velocity[:, None, 3:], lever)
    turning = np.cross(view.velocity[:, None, 3:], view.axes)
    return np.asarray(
        np.einsum('fsik,fsi->fsk', view.d_position, moving)
        + np.einsum('fsik,fsi->fsk', view.d_axis, turning)
    )


class TimeOffset(Effect[Term]):
    """Applies the optical pose stamped t - theta at flux stamp t; theta is in s."""

    name = 'time_offset'
    summary = 'the optical stamps are early or late'
    units = {'offset_s': 's'}
    plausible = {'offset_s': (-0.5, 0.5)}
    remedy = Remedy.OPTICAL

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return one candidate, as one offset holds for all bodies."""
        return [Term(self, {}, np.zeros(1))] if apparatus.tools else []

    def prior(self, term: Term) -> Array:
        """Return a prior spread of a tenth of a second."""
        return np.full(1, 0.1)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return minus the flux's rate of change, or None for references."""
        return None if view.is_reference else -flux_rate(view)[..., None]

    def optical(self, term: Term, track: PoseTrack) -> PoseTrack:
        """Return the optical track with its stamps on the fluxes' clock."""
        return replace(track, time=track.time + term.theta[0])

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the offset and its uncertainty, s."""
        return EffectRecord(
            self.name,
            {'offset_s': float(term.theta[0])},
            {'offset_s': float(np.sqrt(covariance[0, 0]))},
        )

    def term(self, record: EffectRecord) -> Term:
        """Read the offset, s, from a record."""
        return Term(self, {}, np.array([float(needed(record, 'offset_s'))]))


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


EFFECTS = (
    TimeOffset(),
    ClockRate(),
)
