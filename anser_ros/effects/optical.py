"""The optical tracker's clock, frame or scale is not the one that is assumed, or drifts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, cast

import numpy as np
from numpy.polynomial.polynomial import polyval

from anser_ros.arrays import Array, ComplexArray, Integers
from anser_ros.effects.base import Apparatus, View
from anser_ros.effects.effect import Effect, Remedy, Site, Term, TermT, sigmas
from anser_ros.field.model import EffectRecord
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.rotations import rotation_of_vector


class OpticalEffect(Effect[TermT]):
    """Changes the optical track, which all bodies share; references have none."""

    remedy = Remedy.OPTICAL
    typical: ClassVar[tuple[float, ...]]

    def candidates(self, apparatus: Apparatus) -> Sequence[TermT]:
        zero = cast(TermT, Term(self, {}, np.zeros(len(self.typical))))
        return [zero] if apparatus.tools else []

    def columns(self, term: TermT, view: View) -> ComplexArray | None:
        """Return the derivative by a tool's motion, or None for references."""
        return None if view.is_reference else self.slopes(term, view)

    def slopes(self, term: TermT, view: View) -> ComplexArray:
        raise NotImplementedError


def flux_rate(view: View) -> ComplexArray:
    """Return the time derivative of the flux by the body's motion, (F, S, K), T/s."""
    lever = view.centres - view.position[:, None, :]
    moving = view.velocity[:, None, :3] + np.cross(view.velocity[:, None, 3:], lever)
    turning = np.cross(view.velocity[:, None, 3:], view.axes)
    return np.asarray(
        np.einsum('fsik,fsi->fsk', view.d_position, moving)
        + np.einsum('fsik,fsi->fsk', view.d_axis, turning)
    )


class TimeOffset(OpticalEffect[Term]):
    """Takes an optical stamp t' (s) for t' + a, theta, so that the pose of t - a belongs to t."""

    name = 'time_offset'
    summary = 'the optical stamps are early or late'
    units = {'offset_s': 's'}
    plausible = {'offset_s': (-0.5, 0.5)}
    recorded = {'offset_s': (1, 1.0)}
    typical: ClassVar[tuple[float, ...]] = (0.1,)

    def slopes(self, term: Term, view: View) -> ComplexArray:
        """Return minus the flux's rate of change, constant and, with a rate, growing with time."""
        rate, time = -flux_rate(view), view.time[:, None, None]
        return np.stack([rate * time**power for power in range(term.theta.size)], axis=-1)

    def optical(self, term: Term, track: PoseTrack) -> PoseTrack:
        return replace(track, time=track.time + polyval(track.time, term.theta))


class ClockRate(TimeOffset):
    """Theta is an offset a (s) and a rate b (s a second): optical t' counts as t' + a + b t'."""

    name = 'clock_rate'
    summary = "one of the two clocks runs slow, so that the stamps' offset grows"
    units = {'offset_s': 's', 'rate_ppm': '1e-6'}
    plausible = {'offset_s': (-0.5, 0.5), 'rate_ppm': (-2e4, 2e4)}
    recorded = {'offset_s': (1, 1.0), 'rate_ppm': (1, 1e6)}
    typical = (0.1, 3e-3)


class Registration(OpticalEffect[Term]):
    """Theta is a rotation vector r (rad) and a translation t (m): optical = R(r) fg + t."""

    name = 'registration'
    summary = "the optical frame is not aligned with the field generator's"
    units = {'rotation_deg': 'deg', 'translation_m': 'm'}
    plausible = {'rotation_deg': (-10.0, 10.0), 'translation_m': (-0.05, 0.05)}
    recorded = {'rotation_deg': (3, 180.0 / np.pi), 'translation_m': (3, 1.0)}
    typical = (0.02, 0.02, 0.02, 5e-3, 5e-3, 5e-3)
    installed = True
    is_frame = is_stand = True

    def slopes(self, term: Term, view: View) -> ComplexArray:
        """Return the derivative by a turn about fg's origin and a shift, made the other way."""
        back = rotation_of_vector(term.theta[:3]).T
        turn = np.cross(view.centres[..., :, None], view.d_position, axis=2)
        turn = turn + np.cross(view.axes[..., :, None], view.d_axis, axis=2)
        out = view.columns(6)
        # To first order a further turn w of the optical frame turns the true pose by -R^T w.
        out[..., :3] = -np.einsum('fsik,ij->fskj', turn, back)
        out[..., 3:] = -np.einsum('fsik,ij->fskj', view.d_position, back)
        return out

    def optical(self, term: Term, track: PoseTrack) -> PoseTrack:
        from scipy.spatial.transform import Rotation  # loads slowly, and no live node needs it

        back = Rotation.from_rotvec(term.theta[:3]).inv()
        return PoseTrack(
            track.time,
            back.apply(track.position - term.theta[3:]),
            (back * Rotation.from_quat(track.quaternion)).as_quat(),
        )


class OpticalScale(OpticalEffect[Term]):
    """Theta is the scale less one, and a shift (m); along one axis, two shears after the scale.

    Optical positions are ``p (1 + e) - c``; the scale applies about the tracker's own origin,
    which may be anywhere, so the shift ``c`` is free. Where a stage gives the poses each of its
    axes has its own: ``p + (a . p) w - c`` along the axis a, with ``w = e a + f b + g c`` for the
    two other axes b and c, towards which it may be skew.
    """

    name = 'optical_scale'
    summary = "the optical tracker's millimetre is too long or too short"
    units = {'scale': '1', 'shift_m': 'm', 'axis': '1', 'shear': '1'}
    plausible = {'scale': (0.9, 1.1), 'shift_m': (-0.1, 0.1), 'shear': (-0.05, 0.05)}

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        along = [Term(self, {'axis': tuple(axis)}, np.zeros(6)) for axis in np.eye(3).tolist()]
        return [Term(self, {}, np.zeros(4)), *along] if apparatus.tools else []

    def prior(self, term: Term) -> Array:
        return np.concatenate([np.full(term.theta.size - 3, 0.01), np.full(3, 5e-3)])

    def rivals(self, term: Term, other: Term) -> bool:
        """Rival a frame that stands elsewhere; what it leaves then shows the axis."""
        return 'axis' in term.site and other.effect.is_frame

    def complexity(self, term: Term) -> int:
        """Return that of a registration and its own: a frame that stands elsewhere goes before."""
        return 6 + term.theta.size if 'axis' in term.site else super().complexity(term)

    def amounts(self, term: Term) -> Integers:
        """Return the scale's index alone: a shift is a registration's."""
        return np.array([0])

    @staticmethod
    def _stretches(term: Term) -> Array:
        """Return what a unit of scale and of each shear adds to a position, (q, 3, 3)."""
        if 'axis' not in term.site:
            return np.eye(3)[None]
        first = int(np.argmax(term.site['axis']))
        return np.array(
            [np.outer(np.eye(3)[k % 3], np.eye(3)[first]) for k in range(first, first + 3)]
        )

    def _matrix(self, term: Term) -> Array:
        return np.asarray(np.eye(3) + np.tensordot(term.theta[:-3], self._stretches(term), 1))

    def slopes(self, term: Term, view: View) -> ComplexArray:
        """Return the flux that changes as all sensors move with scale and shift."""
        back = np.linalg.inv(self._matrix(term))
        ways = np.einsum('ij,qjk,fk->fqi', back, self._stretches(term), view.position)
        out = view.columns(term.theta.size)
        out[..., :-3] = -np.einsum('fsik,fqi->fskq', view.d_position, ways)
        out[..., -3:] = np.einsum('fsik,ij->fskj', view.d_position, back)
        return out

    def optical(self, term: Term, track: PoseTrack) -> PoseTrack:
        back = np.linalg.inv(self._matrix(term))
        return replace(track, position=(track.position + term.theta[-3:]) @ back.T)

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        def figures(scale: float, values: Array) -> dict[str, Any]:
            shear = {'shear': values[1:-3].tolist()} if 'axis' in term.site else {}
            return {'scale': scale + float(values[0]), **shear, 'shift_m': values[-3:].tolist()}

        parameters = {**figures(1.0, term.theta), **term.recorded_site}
        return EffectRecord(self.name, parameters, figures(0.0, sigmas(covariance)))

    def term(self, record: EffectRecord) -> Term:
        shift, given = record.needed('shift_m'), record.parameters
        theta = [float(record.needed('scale')) - 1, *given.get('shear', ()), *shift]
        axis = given.get('axis')
        site: Site = {} if axis is None else {'axis': tuple(float(value) for value in axis)}
        return Term(self, site, np.array(theta))


@dataclass(frozen=True, kw_only=True)
class RegistrationDriftTerm(Term):
    """Holds the drift of the optical tracker."""

    duration: float  # Time over which the growth in theta is made, s


class RegistrationDrift(OpticalEffect[RegistrationDriftTerm]):
    """Theta is the translation (m) at the session's start, and its growth (m) to the end."""

    name = 'registration_drift'
    summary = 'the optical tracker moves steadily'
    units = {'translation_m': 'm', 'velocity_m_per_s': 'm/s', 'duration_s': 's'}
    plausible = {'translation_m': (-0.05, 0.05), 'velocity_m_per_s': (-0.01, 0.01)}
    typical = (5e-3,) * 6

    def candidates(self, apparatus: Apparatus) -> Sequence[RegistrationDriftTerm]:
        duration = max(apparatus.duration, 1e-3)
        zero = RegistrationDriftTerm(self, {}, np.zeros(6), duration=duration)
        return [zero] if apparatus.tools else []

    def amounts(self, term: RegistrationDriftTerm) -> Integers:
        """Return the growth's index alone: a constant shift is a registration's."""
        return np.arange(3, 6)

    def slopes(self, term: RegistrationDriftTerm, view: View) -> ComplexArray:
        """Move all sensors the other way, from the start and more and more."""
        out, back = view.columns(6), -np.moveaxis(view.d_position, 2, -1)
        share = (view.time / term.duration)[:, None, None, None]
        out[..., :3], out[..., 3:] = back, back * share
        return out

    def optical(self, term: RegistrationDriftTerm, track: PoseTrack) -> PoseTrack:
        share = (track.time / term.duration)[:, None]
        return replace(track, position=track.position - term.theta[:3] - share * term.theta[3:])

    def record(self, term: RegistrationDriftTerm, covariance: Array) -> EffectRecord:
        def figures(values: Array) -> dict[str, list[float]]:
            velocity = (values[3:] / term.duration).tolist()
            return {'translation_m': values[:3].tolist(), 'velocity_m_per_s': velocity}

        parameters = {**figures(term.theta), 'duration_s': term.duration}
        return EffectRecord(self.name, parameters, figures(sigmas(covariance)))

    def term(self, record: EffectRecord) -> RegistrationDriftTerm:
        duration = float(record.needed('duration_s'))
        start = np.asarray(record.needed('translation_m'), dtype=np.float64)
        way = np.asarray(record.needed('velocity_m_per_s'), dtype=np.float64) * duration
        return RegistrationDriftTerm(self, {}, np.concatenate([start, way]), duration=duration)


EFFECTS = (TimeOffset(), ClockRate(), Registration(), OpticalScale(), RegistrationDrift())
