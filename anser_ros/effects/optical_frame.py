"""The optical frame is not fg: turned and shifted, of another scale, or drifting."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, Term, needed, sigmas
from anser_ros.effects.view import Apparatus, View
from anser_ros.field.model import EffectRecord
from anser_ros.physics.pose_track import PoseTrack


class Registration(Effect[Term]):
    """Theta is a rotation vector r (rad) and a translation t (m): optical = R(r) fg + t."""

    name = 'registration'
    summary = "the optical frame is not aligned with the field generator's"
    units = {'rotation_deg': 'deg', 'translation_m': 'm'}
    plausible = {
        'rotation_deg': (-10.0, 10.0),
        'translation_m': (-0.05, 0.05),
    }
    remedy = Remedy.OPTICAL

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return one candidate, as all bodies share one optical frame."""
        return [Term(self, {}, np.zeros(6))] if apparatus.tools else []

    def prior(self, term: Term) -> Array:
        """Return prior spreads of about a degree and of 5 mm."""
        return np.repeat([0.02, 5e-3], 3)

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the derivative by a turn about fg's origin and a shift, which all sensors make
        the other way round.
        """
        if view.is_reference:
            return None
        back = Rotation.from_rotvec(term.theta[:3]).as_matrix().T
        turn = np.cross(view.centres[..., :, None], view.d_position, axis=2)
        turn = turn + np.cross(view.axes[..., :, None], view.d_axis, axis=2)
        out = view.columns(6)
        # To first order a further turn w of the optical frame turns the true pose by -R^T w.
        out[..., :3] = -np.einsum('fsik,ij->fskj', turn, back)
        out[..., 3:] = -np.einsum('fsik,ij->fskj', view.d_position, back)
        return out

    def optical(self, term: Term, track: PoseTrack) -> PoseTrack:
        """Return the optical track as it is in fg."""
        back = Rotation.from_rotvec(term.theta[:3]).inv()
        return PoseTrack(
            track.time,
            back.apply(track.position - term.theta[3:]),
            (back * Rotation.from_quat(track.quaternion)).as_quat(),
        )

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the rotation vector, degrees, and the translation, m."""
        sigma = sigmas(covariance)
        return EffectRecord(
            self.name,
            {
                'rotation_deg': np.degrees(term.theta[:3]).tolist(),
                'translation_m': term.theta[3:].tolist(),
            },
            {
                'rotation_deg': np.degrees(sigma[:3]).tolist(),
                'translation_m': sigma[3:].tolist(),
            },
        )

    def term(self, record: EffectRecord) -> Term:
        """Read the rotation vector, degrees, and the translation, m, from a record."""
        turn = np.radians(np.asarray(needed(record, 'rotation_deg'), dtype=np.float64))
        shift = np.asarray(needed(record, 'translation_m'), dtype=np.float64)
        return Term(self, {}, np.concatenate([turn, shift]))


class OpticalScale(Effect[Term]):
    """Theta is the scale less one, and times it the point of fg that stays where it is (m).

    Optical positions are ``p (1 + e) - c``; the scale applies about the tracker's own origin,
    which may be anywhere, so the shift ``c`` is free.
    """

    name = 'optical_scale'
    summary = "the optical tracker's millimetre is too long or too short"
    units = {'scale': '1', 'shift_m': 'm'}
    plausible = {
        'scale': (0.9, 1.1),
        'shift_m': (-0.1, 0.1),
    }
    remedy = Remedy.OPTICAL

    def candidates(self, apparatus: Apparatus) -> Sequence[Term]:
        """Return one candidate, as all bodies are seen by one tracker."""
        return [Term(self, {}, np.zeros(4))] if apparatus.tools else []

    def prior(self, term: Term) -> Array:
        """Expect scales that err by a percent, and shifts of some millimetres."""
        return np.array([0.01, 5e-3, 5e-3, 5e-3])

    def amounts(self, term: Term) -> NDArray[np.int64]:
        """Return the scale's index alone: a shift is a registration's."""
        return np.array([0])

    def columns(self, term: Term, view: View) -> ComplexArray | None:
        """Return the flux that changes as all sensors move with scale and shift."""
        if view.is_reference:
            return None
        out = view.columns(4)
        larger = 1 + term.theta[0]
        out[..., 0] = -np.einsum('fsik,fi->fsk', view.d_position, view.position) / larger
        out[..., 1:] = np.moveaxis(view.d_position, 2, -1) / larger
        return out

    def optical(self, term: Term, track: PoseTrack) -> PoseTrack:
        """Return the optical track with positions at their true scale, m."""
        return replace(track, position=(track.position + term.theta[1:]) / (1 + term.theta[0]))

    def record(self, term: Term, covariance: Array) -> EffectRecord:
        """Record the scale and the shift."""
        sigma = sigmas(covariance)
        return EffectRecord(
            self.name,
            {'scale': 1 + float(term.theta[0]), 'shift_m': term.theta[1:].tolist()},
            {'scale': float(sigma[0]), 'shift_m': sigma[1:].tolist()},
        )

    def term(self, record: EffectRecord) -> Term:
        """Read the scale and the shift, m, from a record."""
        shift = np.asarray(needed(record, 'shift_m'), dtype=np.float64)
        return Term(self, {}, np.array([float(needed(record, 'scale')) - 1, *shift]))


@dataclass(frozen=True, kw_only=True)
class RegistrationDriftTerm(Term):
    """Holds the drift of the optical tracker."""

    duration: float  # Time over which the growth in theta is made, s


class RegistrationDrift(Effect[RegistrationDriftTerm]):
    """Theta is the translation (m) at the session's start, and its growth (m) to the end."""

    name = 'registration_drift'
    summary = 'the optical tracker moves steadily'
    units = {
        'translation_m': 'm',
        'velocity_m_per_s': 'm/s',
        'duration_s': 's',
    }
    plausible = {
        'translation_m': (-0.05, 0.05),
        'velocity_m_per_s': (-0.01, 0.01),
    }
    remedy = Remedy.OPTICAL

    def candidates(self, apparatus: Apparatus) -> Sequence[RegistrationDriftTerm]:
        """Return one candidate, as all bodies are seen by one tracker."""
        duration = max(apparatus.duration, 1e-3)
        term = RegistrationDriftTerm(self, {}, np.zeros(6), duration=duration)
        return [term] if apparatus.tools else []

    def prior(self, term: RegistrationDriftTerm) -> Array:
        """Return a prior spread of 5 mm: shifts are some millimetres."""
        return np.full(6, 5e-3)

    def amounts(self, term: RegistrationDriftTerm) -> NDArray[np.int64]:
        """Return the growth's index alone: a constant shift is a registration's."""
        return np.arange(3, 6)

    def columns(self, term: RegistrationDriftTerm, view: View) -> ComplexArray | None:
        """Move all sensors the other way, from the start and more and more."""
        if view.is_reference:
            return None
        out, back = view.columns(6), -np.moveaxis(view.d_position, 2, -1)
        share = (view.time / term.duration)[:, None, None, None]
        out[..., :3], out[..., 3:] = back, back * share
        return out

    def optical(self, term: RegistrationDriftTerm, track: PoseTrack) -> PoseTrack:
        """Return the optical track with the drift of its frame taken off, in fg."""
        share = (track.time / term.duration)[:, None]
        return replace(track, position=track.position - term.theta[:3] - share * term.theta[3:])

    def record(self, term: RegistrationDriftTerm, covariance: Array) -> EffectRecord:
        """Record the first translation and the velocity."""
        sigma, duration = sigmas(covariance), term.duration
        return EffectRecord(
            self.name,
            {
                'translation_m': term.theta[:3].tolist(),
                'velocity_m_per_s': (term.theta[3:] / duration).tolist(),
                'duration_s': duration,
            },
            {
                'translation_m': sigma[:3].tolist(),
                'velocity_m_per_s': (sigma[3:] / duration).tolist(),
            },
        )

    def term(self, record: EffectRecord) -> RegistrationDriftTerm:
        """Read the translation, m, and the velocity, m/s, from a record."""
        duration = float(needed(record, 'duration_s'))
        start = np.asarray(needed(record, 'translation_m'), dtype=np.float64)
        way = np.asarray(needed(record, 'velocity_m_per_s'), dtype=np.float64) * duration
        return RegistrationDriftTerm(self, {}, np.concatenate([start, way]), duration=duration)


EFFECTS = (
    Registration(),
    OpticalScale(),
    RegistrationDrift(),
)
