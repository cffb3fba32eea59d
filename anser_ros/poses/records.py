"""Records what a fit of a session of poses came to: hand-eye of each sensor, and its effects."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.effects.effect import sigmas
from anser_ros.field.model import EffectRecord
from anser_ros.poses.clock_records import one_clock
from anser_ros.poses.effect import Role, frames_of
from anser_ros.poses.fit import PoseFit
from anser_ros.poses.lever_arms import (
    LEAST_KNOWN_M,
    LEAST_KNOWN_RAD,
    is_lever_determined,
    most_poses,
    turn_jitter,
)
from anser_ros.poses.registry import effect_with
from anser_ros.poses.search import PoseEvidence
from anser_ros.poses.sequence import PoseSession

Array = NDArray[np.float64]


def records_of(
    fit: PoseFit, evidence: tuple[PoseEvidence | None, ...], session: PoseSession
) -> list[EffectRecord]:
    """Return the hand-eye of each sensor, and the effects that were fitted."""
    shaking = turn_jitter(most_poses(session))
    views = [part.view for part in fit.state.parts]
    records = [
        hand_eye_record(fit, index, shaking)
        for index, term in enumerate(fit.terms)
        if term.role is Role.MOUNT
    ]
    for index, (term, one) in enumerate(zip(fit.terms, evidence, strict=True)):
        if one is None:
            continue
        spread = fit.covariance_of(index)
        record = term.effect.seen_at(term.effect.record(term, spread), term, spread, views)
        words = {
            'summary': term.effect.summary,
            'advice': term.effect.advice,
            'remedy': term.effect.remedy.value,
            'parameters_spent': int(term.theta.size),
            'held_out_gain': one.gain,
            'held_out_share': one.share,
            'position_rmse_without_m': one.position_rmse_without_m,
            'position_rmse_with_m': one.position_rmse_with_m,
        }
        records.append(replace(record, evidence=words))
    return one_clock(records, fit.state.problem.setting.duration)


def hand_eye_record(fit: PoseFit, index: int, jitter_rad: float) -> EffectRecord:
    """Return optical frame, lever arm and mount of the sensor whose mount the term is.

    None where the motion does not determine them, and for the optical frame where it was not
    fitted. ``jitter_rad`` is that of the reference's orientation.
    """
    name = str(fit.terms[index].sensor)
    frames, sigma = frames_of(fit.terms, name), sigmas(fit.covariance_of(index))
    part = next(p for p in fit.state.parts if p.view.sensor == name)
    is_known = (sigma[:3] < LEAST_KNOWN_M) & is_lever_determined(part, jitter_rad)
    lever = [float(v) if known else None for v, known in zip(frames.lever, is_known, strict=True)]
    values: dict[str, object] = {
        'sensor': name, 'lever_arm_m': lever, 'mount_rotation_deg': _degrees(frames.mount),
        'registration_rotation_deg': None, 'registration_translation_m': None,
    }  # fmt: skip
    uncertainty: dict[str, object] = {
        'lever_arm_m': sigma[:3].tolist(), 'mount_rotation_deg': np.rad2deg(sigma[3:]).tolist(),
    }  # fmt: skip
    for base in (i for i, t in enumerate(fit.terms) if t.role is Role.REGISTRATION):
        apart = sigmas(fit.covariance_of(base))
        values['registration_rotation_deg'] = _degrees(frames.rotation)
        values['registration_translation_m'] = frames.translation.tolist()
        uncertainty['registration_rotation_deg'] = np.rad2deg(apart[3:]).tolist()
        uncertainty['registration_translation_m'] = apart[:3].tolist()
    known = bool(is_known.all() and np.all(sigma[3:] < LEAST_KNOWN_RAD))
    effect = effect_with(Role.MOUNT)
    evidence = {'summary': effect.summary, 'observable': known}
    return EffectRecord(effect.name, values, uncertainty, evidence)


def _degrees(matrix: Array) -> list[float]:
    return [float(v) for v in np.rad2deg(Rotation.from_matrix(matrix).as_rotvec())]
