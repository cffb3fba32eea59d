"""Calibrates hand-eye: registration, lever arm, mount and clocks of two streams, jointly.

This is the first stage of a diagnosis of poses, by itself: the two frames, the offset and the rate
of the clocks, estimated robustly, with uncertainties, and a statement of what the motion does not
determine.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.effects.effect import sigmas
from anser_ros.errors import DiagnosisError
from anser_ros.field.model import EffectRecord
from anser_ros.poses.convention import read_rightly
from anser_ros.poses.effect import PoseTerm, Role, frames_of
from anser_ros.poses.fit import PoseFit, fit_poses
from anser_ros.poses.lever_arms import (
    LEAST_KNOWN_M,
    LEAST_KNOWN_RAD,
    turn_jitter,
)
from anser_ros.poses.problem import PoseProblem
from anser_ros.poses.records import hand_eye_record
from anser_ros.poses.registry import effect_with
from anser_ros.poses.search import frame_terms, with_noise
from anser_ros.poses.sequence import PoseSession
from anser_ros.poses.start import coarse_offset, first_fit, pose_problem, train_blocks

Array = NDArray[np.float64]

BETWEEN_PAIRS_S = 10.0
"""Time from one static pair to the next, s: long enough that each is a recording."""
LEAST_KNOWN_S = 0.02
"""Standard deviation of an offset, s, beyond which it is not given: a pose of a fast tracker."""
LEAST_KNOWN_PPM = 500.0
"""Standard deviation of a rate beyond which it is not given: crystals differ by a tenth of it."""
TILT_NEEDED_DEG = 20.0  # what is asked for where a lever arm is open


@dataclass(frozen=True)
class SensorFrames:
    """Holds place and mount of one sensor on the body with what is known of them."""

    lever_m: Array  # (3,), m, body's frame; NaN where the motion does not determine it
    lever_sigma_m: Array  # (3,)
    # (3, 3), rotation from the sensor's frame to the body's; None where it is not determined.
    mount: Array | None
    mount_sigma_rad: Array  # (3,)
    # Poses that took part, of those that could be compared with an optical pose; the others
    # contradict them.
    n: int
    n_compared: int
    # Distance (m) and angle (rad) that are left, root mean square, on those that took part.
    rms: tuple[float, float]
    # The same on all of the fifth of the recording that took no part in a fit of its own.
    held_out: tuple[float, float]


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
    middle_s: float  # s since the recording's start
    sensors: dict[str, SensorFrames]
    # What the recording does not determine, and what it would take, in words.
    undetermined: tuple[str, ...]
    fit: PoseFit


def as_pairs(session: PoseSession) -> PoseSession:
    """Return the n-th pose of every sensor beside the n-th of the reference, whatever their
    stamps.

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
    finished fraction.

    Raises `DiagnosisError` when there is no reference, or too few poses.
    Raises `PlausibilityError` when the two streams fit in no reading.
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
    fit = first_fit(problem, coarse_offset(problem), False)
    if problem.path.is_at_rest:
        return with_noise(fit_poses(fit.state.problem, frame_terms(fit.terms)))
    rate = effect_with(Role.RATE).sites(problem.setting)[0]
    whole = with_noise(fit_poses(fit.state.problem, [*fit.terms, rate]))
    if _sigma(whole, len(whole.terms) - 1) * 1e3 < LEAST_KNOWN_PPM:
        return whole
    return with_noise(fit)


def _sigma(fit: PoseFit, index: int) -> float:
    return float(np.sqrt(fit.covariance_of(index)[0, 0]))


def _clock(fit: PoseFit, role: Role, scale: float) -> tuple[float, float] | None:
    for index, term in enumerate(fit.terms):
        if term.role is role:
            return scale * float(term.theta[0]), scale * _sigma(fit, index)
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
        part = next(p for p in fit.state.parts if p.view.sensor == name)
        record = hand_eye_record(fit, index, shaking)
        lever = [np.nan if v is None else float(v) for v in record.parameters['lever_arm_m']]
        sigma = sigmas(fit.covariance_of(index))
        known = bool(np.all(sigma[3:] < LEAST_KNOWN_RAD))
        sensors[name] = SensorFrames(
            np.array(lever), sigma[:3], frames.mount if known else None, sigma[3:],
            int(np.count_nonzero(part.used)), len(part.used), fit.state.rms(name),
            held_out.get(name, (np.nan, np.nan)),
        )  # fmt: skip
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
    return HandEye(
        session, convention, frames.rotation, sigma[3:], place, sigma[:3], offset, rate,
        _middle(fit.terms), sensors, tuple(words), fit,
    )  # fmt: skip


def _middle(terms: tuple[PoseTerm, ...]) -> float:
    """When the offset is the offset: at stamp zero where no rate is known."""
    for term in terms:
        if term.role is Role.RATE:
            return float(term.effect.record(term, np.zeros((1, 1))).parameters['middle_s'])
    return 0.0


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


def matrix_of(rotation: Array, translation: Array) -> Array:
    """Return rotation and translation as one matrix (4, 4); NaN where either is unknown."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def turn_of(rotation: Array) -> tuple[list[float], list[float]]:
    """Return a rotation matrix as a rotation vector, degrees, and a quaternion x y z w."""
    turn = Rotation.from_matrix(rotation)
    return np.rad2deg(turn.as_rotvec()).tolist(), turn.as_quat().tolist()
