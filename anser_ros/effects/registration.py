"""The optical tracker's frame is not the field generator's."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.effects.apparatus import Apparatus
from anser_ros.effects.effect import Array, ComplexArray, Effect, Remedy, needed, sigmas
from anser_ros.effects.term import Term
from anser_ros.effects.view import View
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


EFFECTS = (Registration(),)
