"""States which components of a sensor's place on the body the motion determines."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.effects.effect import sigmas
from anser_ros.poses.effect import Role
from anser_ros.poses.fit import PoseFit
from anser_ros.poses.problem import PosePart
from anser_ros.poses.sequence import PoseSequence, PoseSession

Array = NDArray[np.float64]

LEAST_JITTER_RAD = 1e-5  # no reference measures turns better; none at all has no inverse
FEWEST_TURNS = 20  # poses that tell a reference's jitter, to 16 %
MOST_BLUR = 0.1  # share by which a lever arm that is given may be too small
LEAST_KNOWN_M, LEAST_KNOWN_RAD = 0.01, 0.1
"""Standard deviation of a lever arm's component, m, or a turn, rad, beyond which it is not given:
the motion does not determine it."""
MUCH_TILT = 0.15
"""Turns of the body, rad rms, that move a lever arm of 5 cm by 8 mm, as much as a slow filter
moves a hand."""
HARDLY_DETERMINED_M = 0.022
"""Lever arm, m, that would make the median error by turns alone, from which the motion does not
determine it: beyond this levers of recordings were off by 9 mm and more, below by 4 and less."""

OWN_ERROR_M = 1e-3
"""Error, m, that a tracker has of itself (data sheets: 0.5 to 1.4 mm). A motion of some seconds
leaves less, as the frames take up what goes with its turns, and with it wrong levers."""


def is_lever_determined(
    part: PosePart, jitter_rad: float, error_m: float = OWN_ERROR_M
) -> NDArray[np.bool_]:
    """Return the mask (3,) of the components of a lever arm that the motion determines.

    The tracker's errors are taken to be ``error_m`` at least.
    """
    if not part.used.any():
        return np.zeros(3, dtype=np.bool_)
    is_near = lever_reach(part, error_m) < HARDLY_DETERMINED_M
    return (lever_blur(part, jitter_rad) < MOST_BLUR) & is_near


def lever_reach(part: PosePart, error_m: float = 0.0) -> Array:
    """Return the lever arm (3,), m, that makes the median error by the turns of the body alone, or
    an error of ``error_m`` if that is larger.
    """
    far = max(float(np.median(np.linalg.norm(part.residual[part.used, :3], axis=1))), error_m)
    information = np.linalg.inv(_turn_information(part) + LEAST_JITTER_RAD**2 * np.eye(3))
    return np.asarray(far * np.sqrt(np.diag(information)))


def _turn_information(part: PosePart) -> Array:
    """How much turns move a unit lever arm, shape (3, 3), squares, along the body's axes."""
    turns = Rotation.from_matrix(part.view.turn[part.used])
    tilt = np.cov((turns.mean().inv() * turns).as_rotvec().T)
    return np.asarray(np.trace(tilt) * np.eye(3) - tilt)


def lever_blur(part: PosePart, jitter_rad: float) -> Array:
    """Return by which share (3,) the reference's own jitter of orientation shrinks a lever arm.

    Errors of the measured rotations make a lever arm too small by their share of the rotations'
    variance, whatever its formal uncertainty.
    """
    information = _turn_information(part)
    error = 2 * max(jitter_rad, LEAST_JITTER_RAD) ** 2
    return np.asarray(error * np.diag(np.linalg.inv(information + 1e-3 * error * np.eye(3))))


def turn_jitter(reference: PoseSequence) -> float:
    """Return the jitter of a reference's orientation, rad a coordinate, from its quietest
    stretches.

    The squared second difference of noise has six times its variance per coordinate; the lowest
    quarter of that with three coordinates is at 1.21.
    """
    if reference.size < FEWEST_TURNS:
        return 0.0
    turns = Rotation.from_quat(reference.rows(~reference.repeated).quaternion)
    steps = (turns[:-1].inv() * turns[1:]).as_rotvec()
    second = np.sum(np.diff(steps, axis=0) ** 2, axis=1)
    return float(np.sqrt(np.percentile(second, 25) / (6 * 1.21)))


def most_poses(session: PoseSession) -> PoseSequence:
    """Return the reference, or without one the sensor with most poses, which takes its place."""
    return session.reference or max(session.sensors.values(), key=lambda poses: poses.size)


def knows_levers(fit: PoseFit, reference: PoseSequence) -> bool:
    """Return whether the motion determines two components of a sensor's lever arm.

    So many are determined by turns about one axis. Where they are not, a body was carried about
    with hardly a turn, or not moved at all. Much tilt determines them once the effects are found,
    however large the error is that these make before.
    """
    shaking = turn_jitter(reference)
    parts = {part.view.sensor: part for part in fit.state.parts}
    for index, term in enumerate(fit.terms):
        if term.role is Role.MOUNT:
            part = parts[str(term.sensor)]
            sigma = sigmas(fit.covariance_of(index))[:3]
            is_known = (sigma < LEAST_KNOWN_M) & is_lever_determined(part, shaking, 0.0)
            turns = _turn_information(part) if part.used.any() else np.zeros((3, 3))
            tilted = np.sqrt(np.diag(turns)) > MUCH_TILT
            if np.count_nonzero(is_known | tilted) >= 2:
                return True
    return False
