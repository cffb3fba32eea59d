"""Calibrates hand-eye jointly with the clocks, and records what a fit of poses came to."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.convention import read_rightly
from anser_ros.apps.poses.effect import Role, effect_of_record, effect_with, frames_of
from anser_ros.apps.poses.fit import (
    LEAST_KNOWN_M,
    LEAST_KNOWN_RAD,
    PoseFit,
    fit_poses,
    is_lever_determined,
    most_poses,
    turn_jitter,
)
from anser_ros.apps.poses.problem import PoseProblem
from anser_ros.apps.poses.search import PoseEvidence, frame_terms, with_noise
from anser_ros.apps.poses.sequence import PoseSession
from anser_ros.apps.poses.start import coarse_clock, first_fit, pose_problem, train_blocks
from anser_ros.arrays import Array
from anser_ros.effects.effect import sigmas
from anser_ros.errors import DiagnosisError
from anser_ros.field.model import EffectRecord

AGREE_S = 3.0
"""Time about a session's start or middle, s, at which clocks count as agreeing: programs set
clocks when they start, and a rate by regression is about the middle."""


class PoseClock:
    """Knows how late a tracker's stamps are by the records of its clock.

    ``records``: those of the clock are used; ``support``: ``first_ns`` and ``last_ns``, the stamps
    between which a rate was learnt. Beyond them the offset stays as it is at the nearer one,
    because nobody knows whether a clock was set since.
    """

    def __init__(self, records: Sequence[EffectRecord], support: Mapping[str, Any]) -> None:
        offsets = [r for r in records if _is(r, Role.OFFSET)]
        rate = next((r for r in records if _is(r, Role.RATE)), None)
        self._own = {
            r.parameters['sensor']: _offset(r) for r in offsets if 'sensor' in r.parameters
        }
        # The record of a rate has the offset of all sensors with it, or instead.
        shared = [r for r in offsets if 'sensor' not in r.parameters] if rate is None else [rate]
        self._shared = sum(map(_offset, shared))
        self._gain, self._first, self._last = 0.0, 0, 0
        if rate is not None and 'first_ns' in support:
            gain = 1e-6 * float(rate.needed('rate_ppm'))
            self._gain = gain / (1 + gain)
            self._first, self._last = int(support['first_ns']), int(support['last_ns'])

    def late_ns(self, sensor: str, stamp_ns: int) -> int:
        """Return by how much a sensor's stamp is late on the reference's clock, ns."""
        since = min(max(stamp_ns, self._first), self._last) - (self._first + self._last) // 2
        late = self._shared + self._own.get(sensor, 0.0)
        return round(1e9 * late + self._gain * since)


def _offset(record: EffectRecord) -> float:
    return float(record.needed('offset_s'))


def one_clock(records: Sequence[EffectRecord], duration: float) -> list[EffectRecord]:
    """Return the records with one for the clock: a rate takes the offset of all sensors with it.

    Clocks that agree about the start or the middle of a session of ``duration`` s have a rate and
    no offset besides.
    """
    shared = [r for r in records if _is(r, Role.OFFSET) and 'sensor' not in r.parameters]
    offset = shared[0] if shared else None
    rate = next((r for r in records if _is(r, Role.RATE)), None)
    if rate is None:
        return list(records)
    value = 0.0 if offset is None else float(offset.parameters['offset_s'])
    gained = 1e-6 * float(rate.parameters['rate_ppm'])
    # The offset is that at the middle, half a session after the start.
    apart = min(abs(value), abs(value - 0.5 * gained * duration))
    whole = replace(rate, parameters={**rate.parameters, 'offset_s': value})
    kept = [whole if r is rate else r for r in records]
    return [r for r in kept if r is not offset or apart > abs(gained) * AGREE_S]


def _is(record: EffectRecord, role: Role) -> bool:
    return effect_of_record(record).role is role


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
            **term.effect.words,
            'remedy': term.effect.remedy.value,
            'parameters_spent': int(term.theta.size),
            **one._asdict(),
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
    part = fit.state.part(name)
    is_known = (sigma[:3] < LEAST_KNOWN_M) & is_lever_determined(part, jitter_rad)
    lever = [float(v) if known else None for v, known in zip(frames.lever, is_known, strict=True)]
    values: dict[str, object] = {
        'sensor': name, 'lever_arm_m': lever, 'registration_rotation_deg': None,
        'mount_rotation_deg': turn_of(frames.mount)[0].tolist(),
        'registration_translation_m': None,
    }  # fmt: skip
    uncertainty: dict[str, object] = {
        'lever_arm_m': np.sqrt(sigma[:3] ** 2 + fit.faked_levers[name]).tolist(),
        'mount_rotation_deg': np.rad2deg(sigma[3:]).tolist(),
    }  # fmt: skip
    for base in (i for i, t in enumerate(fit.terms) if t.role is Role.REGISTRATION):
        apart = sigmas(fit.covariance_of(base))
        values['registration_rotation_deg'] = turn_of(frames.rotation)[0].tolist()
        values['registration_translation_m'] = frames.translation.tolist()
        uncertainty['registration_rotation_deg'] = np.rad2deg(apart[3:]).tolist()
        uncertainty['registration_translation_m'] = apart[:3].tolist()
    known = bool(is_known.all() and np.all(sigma[3:] < LEAST_KNOWN_RAD))
    effect = effect_with(Role.MOUNT)
    evidence = {'summary': effect.summary, 'observable': known}
    return EffectRecord(effect.name, values, uncertainty, evidence)


BETWEEN_PAIRS_S = 10.0
"""Time from one static pair to the next, s: long enough that each is a recording."""
LEAST_KNOWN_S = 0.02
"""Standard deviation of an offset, s, beyond which it is not given: a pose of a fast tracker."""
LEAST_KNOWN_PPM = 500.0
"""Standard deviation of a rate beyond which it is not given: crystals differ by a tenth of it."""
TILT_NEEDED_DEG = 20.0  # what is asked for where a lever arm is open


@dataclass(frozen=True)
class HandEye:
    """Holds what two streams of poses have between them."""

    session: PoseSession  # as it is meant (units, order of quaternions)
    convention: EffectRecord | None  # how it had to be read, where that is not as it says
    rotation: Array  # (3, 3), from the optical frame to the tracker's
    rotation_sigma_rad: Array  # (3,)
    # (3,), of the optical frame's origin in the tracker's, m; NaN where the motion does not
    # determine it.
    translation_m: Array
    translation_sigma_m: Array  # (3,)
    # At stamp t of a tracked pose the optical pose stamped t - offset applies; the tracked clock
    # gains on the optical one by the rate; the offset is that at ``middle_s``. None if the
    # recording does not determine it.
    offset_s: tuple[float, float] | None
    rate_ppm: tuple[float, float] | None
    middle_s: float  # s since the recording's start; 0 without a rate
    # Of each sensor lever arm and mount, None or NaN where the motion does not determine them; how
    # many poses took part (`n`) of those that could be compared, as the others contradict them;
    # and what is left on these, and on the fifth of the recording that took no part.
    sensors: dict[str, dict[str, Any]]
    # What the recording does not determine, and what it would take, in words.
    undetermined: tuple[str, ...]
    fit: PoseFit


def as_pairs(session: PoseSession) -> PoseSession:
    """Return the n-th poses of sensors beside the n-th of the reference, whatever their stamps.

    Raises `DiagnosisError` when numbers differ, or there is no reference.
    """
    if session.reference is None:
        raise DiagnosisError(f'{session.path}: pairs need a reference')
    count = session.reference.size
    for name, poses in session.sensors.items():
        if poses.size != count:
            raise DiagnosisError(
                f'{session.path}: {name} has {poses.size} poses and the reference {count}; pairs '
                'are the n-th with the n-th'
            )
    time = np.asarray(BETWEEN_PAIRS_S * np.arange(count), dtype=np.float64)
    sensors = {name: replace(p, time=time) for name, p in session.sensors.items()}
    return replace(session, sensors=sensors, reference=replace(session.reference, time=time))


def fit_hand_eye(
    session: PoseSession,
    *,
    pairs: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> HandEye:
    """Fit frames and clocks jointly.

    ``session``: with a reference; ``pairs``: whether the poses are static pairs (`as_pairs`),
    which say nothing about clocks; ``progress``: called with the name of the stage and its
    finished fraction. Raises `DiagnosisError` when there is no reference, or too few poses. Raises
    `PlausibilityError` when the two streams fit in no reading.
    """
    say = progress or (lambda text, share: None)
    if session.reference is None:
        raise DiagnosisError(
            f'{session.path}: no second stream of poses; name it with --optical or --reference'
        )
    say('conventions', 0.1)
    session, convention = read_rightly(as_pairs(session) if pairs else session)
    problem = pose_problem(session)
    if pairs:
        problem = replace(problem, path=replace(problem.path, is_at_rest=True))
    train, test = train_blocks(problem)
    say('held out', 0.4)
    learnt = _fitted(problem.in_blocks(train))
    unseen = replace(problem, noise=learnt.state.problem.noise).in_blocks(test)
    held_out = unseen.state(learnt.terms)
    say('all poses', 0.7)
    fit = _fitted(problem)
    apart = {part.view.sensor: held_out.rms(part.view.sensor) for part in held_out.parts}
    return _described(session, convention, fit, apart, pairs)


def _fitted(problem: PoseProblem) -> PoseFit:
    """The frames, and the clocks as far as the motion determines them."""
    fit = first_fit(problem, coarse_clock(problem), False)
    if problem.path.is_at_rest:
        return with_noise(fit_poses(fit.state.problem, frame_terms(fit.terms)))
    rate = effect_with(Role.RATE).sites(problem.setting)[0]
    whole = with_noise(fit_poses(fit.state.problem, [*fit.terms, rate]))
    _, sigma = _clock(whole, Role.RATE, 1e3) or (0.0, np.inf)
    return whole if sigma < LEAST_KNOWN_PPM else with_noise(fit)


def _clock(fit: PoseFit, role: Role, scale: float) -> tuple[float, float] | None:
    for index, term in enumerate(fit.terms):
        if term.role is role:
            sigma = float(sigmas(fit.covariance_of(index))[0])
            return scale * float(term.theta[0]), scale * sigma
    return None


def _described(
    session: PoseSession,
    convention: EffectRecord | None,
    fit: PoseFit,
    held_out: dict[str, tuple[float, float]],
    pairs: bool,
) -> HandEye:
    reference = session.reference
    assert reference is not None
    # Pairs are not in the order of a motion, so their differences tell no jitter.
    shaking = 0.0 if pairs else turn_jitter(reference)
    (base,) = (i for i, t in enumerate(fit.terms) if t.role is Role.REGISTRATION)
    frames = frames_of(fit.terms, '')
    sensors, words = {}, []
    for index, term in enumerate(fit.terms):
        if term.role is not Role.MOUNT:
            continue
        name = str(term.sensor)
        frames = frames_of(fit.terms, name)
        part = fit.state.part(name)
        record = hand_eye_record(fit, index, shaking)
        lever = [np.nan if v is None else float(v) for v in record.parameters['lever_arm_m']]
        sigma = sigmas(fit.covariance_of(index))
        known = bool(np.all(sigma[3:] < LEAST_KNOWN_RAD))
        vector, quaternion = turn_of(frames.mount) if known else (None, None)
        left, unseen = fit.state.rms(name), held_out.get(name, (np.nan, np.nan))
        sensors[name] = {
            'lever_arm_m': np.array(lever),
            'lever_arm_sigma_m': np.array(record.uncertainty['lever_arm_m']),
            'mount_rotation_deg': vector, 'mount_rotation_sigma_deg': np.rad2deg(sigma[3:]),
            'mount_quaternion_xyzw': quaternion,
            'n': int(np.count_nonzero(part.used)), 'n_compared': len(part.used),
            'position_rmse_m': left[0], 'orientation_rmse_rad': left[1],
            'heldout_position_rmse_m': unseen[0], 'heldout_orientation_rmse_rad': unseen[1],
        }  # fmt: skip
        words += _open_lever(name, np.array(lever), part.view.turn[part.used])
        if not known:
            words.append(f'{name}: its mount, known to {np.rad2deg(sigma[3:].max()):.0f} deg only')
    sigma = sigmas(fit.covariance_of(base))
    place = np.where(sigma[:3] < LEAST_KNOWN_M, frames.translation, np.nan)
    if np.isnan(place).any():
        words.append(
            'the origin of the optical frame, known to '
            f'{1e3 * sigma[:3].max():.0f} mm only; it goes with the lever arm'
        )
    offset = _clock(fit, Role.OFFSET, 1.0)
    rate = _clock(fit, Role.RATE, 1e3)
    if offset is None or offset[1] > LEAST_KNOWN_S:
        words.append('the offset of the clocks: the body was at rest, or moved too slowly')
        offset, rate = None, None
    elif rate is None:
        words.append(
            f'the rate of the clocks: in {fit.state.problem.setting.duration:.0f} s it is known '
            f'to more than {LEAST_KNOWN_PPM:.0f} ppm; record longer'
        )
    rated = next((t for t in fit.terms if t.role is Role.RATE), None)
    middle = 0.0 if rated is None else rated.middle_s
    return HandEye(
        session, convention, frames.rotation, sigma[3:], place, sigma[:3], offset, rate, middle,
        sensors, tuple(words), fit,
    )  # fmt: skip


def turn_of(rotation: Array) -> tuple[Array, Array]:
    """Return a rotation matrix as a rotation vector, degrees, and a quaternion x y z w."""
    turn = Rotation.from_matrix(rotation)
    return np.rad2deg(turn.as_rotvec()), turn.as_quat()


def _open_lever(name: str, lever: Array, turn: Array) -> list[str]:
    """State which components of a lever arm are open, and what motion would determine them."""
    if not np.isnan(lever).any():
        return []
    middle = turn.mean(axis=0)
    values = np.linalg.eigvalsh(np.eye(3) - middle.T @ middle)
    tilts = np.rad2deg(np.sqrt(np.maximum(values, 0.0)))
    axes = ', '.join(axis for axis, v in zip('xyz', lever, strict=True) if np.isnan(v))
    about = 'hardly turned' if tilts[2] < 5 else (
        'turned about one axis only' if tilts[0] < 0.25 * tilts[1] else 'was tilted too little'
    )  # fmt: skip
    return [
        f'{name}: its lever arm along {axes} of the body, which {about} ({tilts[0]:.1f}, '
        f'{tilts[1]:.1f}, {tilts[2]:.1f} deg rms); turn it about two axes by '
        f'{TILT_NEEDED_DEG:g} deg or more'
    ]
