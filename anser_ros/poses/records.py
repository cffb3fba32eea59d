"""Records what a fit of a session of poses came to: hand-eye of each sensor, and its effects."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.field.model import EffectRecord
from anser_ros.poses.clock_records import one_clock
from anser_ros.poses.effect import Frames, Role, frames_of
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
    covariances = [fit.covariance_of(i) for i in range(len(fit.terms))]
    base = next((i for i, t in enumerate(fit.terms) if t.role is Role.REGISTRATION), None)
    shaking = turn_jitter(most_poses(session))
    views = [part.view for part in fit.state.parts]
    records = []
    for i, term in enumerate(fit.terms):
        if term.role is Role.MOUNT:
            name = str(term.sensor)
            spread = None if base is None else covariances[base]
            part = next(p for p in fit.state.parts if p.view.sensor == name)
            is_determined = is_lever_determined(part, shaking)
            frames = frames_of(fit.terms, name)
            records.append(hand_eye_record(name, frames, covariances[i], spread, is_determined))
    for term, one, spread in zip(fit.terms, evidence, covariances, strict=True):
        if one is None:
            continue
        record = term.effect.record(term, spread)
        record = term.effect.seen_at(record, term, spread, views)
        words = {
            'summary': term.effect.summary, 'advice': term.effect.advice,
            'remedy': term.effect.remedy.value,
            'parameters_spent': int(term.theta.size), 'held_out_gain': one.gain,
            'held_out_share': one.share,
            'position_rmse_without_m': one.position_rmse_without_m,
            'position_rmse_with_m': one.position_rmse_with_m,
        }  # fmt: skip
        records.append(replace(record, evidence=words))
    return one_clock(records, fit.state.problem.setting.duration)


def hand_eye_record(
    sensor: str,
    frames: Frames,
    spread: Array,
    frame_spread: Array | None,
    is_determined: NDArray[np.bool_],
) -> EffectRecord:
    """Return optical frame, lever arm and mount of a sensor; None where the motion does not
    determine them, and for the optical frame where it was not fitted.
    """

    def degrees(matrix: Array) -> list[float]:
        turn = np.rad2deg(Rotation.from_matrix(matrix).as_rotvec())
        return [float(v) for v in turn]

    sigma = np.sqrt(np.maximum(np.diag(spread), 0.0))
    lever = [
        float(v) if s < LEAST_KNOWN_M and is_known else None
        for v, s, is_known in zip(frames.lever, sigma[:3], is_determined, strict=True)
    ]
    values: dict[str, object] = {
        'sensor': sensor,
        'lever_arm_m': lever,
        'mount_rotation_deg': degrees(frames.mount),
        'registration_rotation_deg': None,
        'registration_translation_m': None,
    }
    uncertainty: dict[str, object] = {
        'lever_arm_m': sigma[:3].tolist(),
        'mount_rotation_deg': np.rad2deg(sigma[3:]).tolist(),
    }
    if frame_spread is not None:
        frame_sigma = np.sqrt(np.maximum(np.diag(frame_spread), 0.0))
        values['registration_rotation_deg'] = degrees(frames.rotation)
        values['registration_translation_m'] = frames.translation.tolist()
        uncertainty['registration_rotation_deg'] = np.rad2deg(frame_sigma[3:]).tolist()
        uncertainty['registration_translation_m'] = frame_sigma[:3].tolist()
    known = all(v is not None for v in lever) and bool(np.all(sigma[3:] < LEAST_KNOWN_RAD))
    effect = effect_with(Role.MOUNT)
    evidence = {'summary': effect.summary, 'observable': known}
    return EffectRecord(effect.name, values, uncertainty, evidence)
