"""The optical tracker's clock is ahead of the fluxes', or behind."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from anser_ros.effects.apparatus import Apparatus
from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, needed
from anser_ros.effects.term import Term
from anser_ros.effects.view import View
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


EFFECTS = (TimeOffset(),)
