"""Judges what the coils of a rigid body say of each other.

A body's pose predicts the place of each of its coils, and each coil has its own pose. The two may
differ by their errors, by the errors of the body's survey, and by the effect of an error of the
coil's gain. A coil that differs by more is in another place, or is another coil.

A coil that took part in the body's solve shares its noise with it: the difference of an estimate
and one that makes better use of the same data has the *difference* of their covariances (Hausman,
Econometrica 1978), which the coil's own bounds from above. A coil that was left out shares no
noise with the body, and the covariances add up.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from anser_ros.kernel_cache import kernel
from anser_ros.physics.tangent import fill_tangent

Array = NDArray[np.float64]

SELDOM = 1e-6
"""Probability that a sound coil contradicts its body."""
GATE = float(chdtri(5, SELDOM))
"""Squared Mahalanobis distance (three of the position, two of the axis) from which on a coil
contradicts its body; 36, six sigma in one direction."""


HARMFUL_M = 1e-3
"""An error of a pose that does harm, m, where the pose's own sigma does not say it."""
BODY_SIGMAS = 3.0
"""How many of its sigmas a pose may be away from where its body says. An error of a sound pose is
that large once in 10^5 frames: sigma is that of all three directions together."""
SURVEYS = 6.0
"""How many times the stated error of the survey, an axis, a coil may be away, if that is more: one
of 1e7 coils is, if the survey is as stated."""


def allowed_m(sigma_m: float, survey_m: float) -> float:
    """Return how far, m, a coil may be off its place in the body by its sigma and the survey's."""
    return max(BODY_SIGMAS * sigma_m, HARMFUL_M, SURVEYS * survey_m)


@dataclass(frozen=True)
class SurveyErrors:
    """Says how well a tool is known: its coils' places, m an axis, their axes, rad, and gains.

    A field over a board falls with the third power of the distance, so that a coil whose gain is
    wrong by g seems to be g/3 of its distance from the board elsewhere.
    """

    position_m: float
    axis_rad: float
    gain: float


@kernel
def fill_distances(  # type: ignore[no-untyped-def]
    position, rotation, covariance, offsets, axes, positions, directions, covariances, took_part,
    survey, found,
):  # fmt: skip
    """Write how far each coil is from its place in the body, ``found`` (3, S).

    The rows are the squared Mahalanobis distance, the distance, m, and the angle, rad.

    ``position`` (3,), ``rotation`` (3, 3), ``covariance`` (6, 6): the body's. ``offsets``,
    ``axes`` (S, 3): the coils in the body. ``positions``, ``directions`` (S, 3), ``covariances``
    (S, 6, 6): what the coils say. ``took_part`` (S,). ``survey`` (3,): m, rad, relative gain.
    """
    t, slopes, wide = np.empty((2, 3)), np.zeros((5, 6)), np.zeros((5, 6))
    apart = np.empty(5)
    arms, turned = np.dot(offsets, rotation.T), np.dot(axes, rotation.T)
    for s in range(offsets.shape[0]):
        n, m = turned[s], directions[s]
        fill_tangent(m, t)
        cross = np.cross(n, m)
        sine = math.sqrt(np.dot(cross, cross))
        angle = math.atan2(sine, np.dot(n, m))
        for i in range(3):
            apart[i] = positions[s, i] - position[i] - arms[s, i]
        for j in range(2):
            # The rotation vector from n to m lies across m; half a turn is about any such vector.
            along = np.dot(t[j], cross) / sine if sine > 1e-12 else 1.0 - j
            apart[3 + j] = along * angle
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            wide[i, i] = slopes[i, i] = 1.0
            wide[i, 3 + j], wide[i, 3 + k] = arms[s, k], -arms[s, j]
            wide[3, 3 + i] = slopes[3, 3 + i] = t[0, i]
            wide[4, 3 + i] = slopes[4, 3 + i] = t[1, i]
        total = np.dot(np.dot(slopes, covariances[s]), slopes.T)
        if not took_part[s]:
            total += np.dot(np.dot(wide, covariance), wide.T)
        radial = survey[2] * positions[s, 2] / 3.0
        for i in range(3):
            total[i, i] += survey[0] * survey[0] + radial * radial
        for i in range(3, 5):
            total[i, i] += survey[1] * survey[1]
        found[0, s] = np.dot(apart, np.linalg.solve(total, apart))
        found[1, s] = math.sqrt(apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2)
        found[2, s] = angle


def distances(
    body: tuple[Array, Array, Array],
    offsets: Array,
    axes: Array,
    coils: tuple[Array, Array, Array],
    took_part: NDArray[np.bool_],
    survey: SurveyErrors,
) -> Array:
    """Return how far each coil's own pose is from its place in the body, (3, S).

    The squared Mahalanobis distance, to be compared with `GATE`; the distance, m; the angle
    between the axes, rad.

    Parameters
    ----------
    body : position (3,), rotation (3, 3), covariance (6, 6)
        m and rad, frame fg.
    offsets, axes : ndarray, shape (S, 3)
        Of the coils, in the body's frame, m and unit vectors.
    coils : positions (S, 3), axes (S, 3), covariances (S, 6, 6)
        What the coils say of themselves, frame fg.
    took_part : ndarray of bool, shape (S,)
        Whether the body's pose made use of the coil.
    survey : SurveyErrors
    """
    found = np.empty((3, len(offsets)))
    survey_errors = np.array([survey.position_m, survey.axis_rad, survey.gain])
    fill_distances(*body, offsets, axes, *coils, took_part, survey_errors, found)
    return found


def reason(distance: float, away_m: float, turned_rad: float) -> str:
    """Return what is said of a coil that contradicts its body."""
    sigmas = math.sqrt(distance)
    return (
        f'{1e3 * away_m:.2g} mm and {math.degrees(turned_rad):.2g} deg from its place in the '
        f'body, {sigmas:.2g} sigma'
    )
