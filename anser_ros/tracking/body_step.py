"""Solves, judges and remembers a body near where it is expected, in one call of compiled code.

`follow_body` is to a body what `coil_step.follow_coils` is to coils. It holds no interpreter lock.
What it does not call sound is looked at again by `body_track`, which shares its memory.
"""

import math
from typing import NamedTuple

import numpy as np

from anser_ros.arrays import Array, Integers
from anser_ros.kernel_cache import inlined, kernel
from anser_ros.tracking.coil_step import MOST_STEPS, SUSPICIOUS_JUMP_M, distance, is_inside
from anser_ros.tracking.estimate import FRESH_NOISE, add_frame, scale_of_frame, sigma_factor
from anser_ros.tracking.rigid import carried_on, reach_of, solve_near, step_to_coils
from anser_ros.tracking.seed import SAME_PLACE_M
from anser_ros.tracking.solve_verdict import SOUND, fault_of

UNKNOWNS = 6
"""Numbers that a body's pose has."""


class BodyMemory(NamedTuple):
    """Holds what is remembered of a body of S coils, as arrays for the compiled step."""

    # (2,), stamps of the last good pose, and of the one before from which motion is carried on; 0
    # for none
    last: Integers
    # position: (2, 3), m, rotation: (2, 3, 3), of these poses, frame fg
    position: Array
    rotation: Array
    noise: Array  # (4,), see `FRESH_NOISE`
    whitened: Array  # (S 2K,), residuals at the last good pose, in sigmas; kept by `BodyTrack`

    @classmethod
    def empty(cls) -> 'BodyMemory':
        """Return the memory of a body that was never seen."""
        noise, stamps = np.array(FRESH_NOISE), np.zeros(2, dtype=np.int64)
        return cls(stamps, np.zeros((2, 3)), np.zeros((2, 3, 3)), noise, np.empty(0))


@kernel
def remember(stamp_ns, position, rotation, ratio, whitened, freedom, memory):  # type: ignore[no-untyped-def]
    """Take in a good solution: its power a freedom, and its ``whitened`` residuals."""
    last, places, turns, lasting = memory.last, memory.position, memory.rotation, 0.0
    if memory.whitened.size == whitened.size:
        lasting = np.dot(memory.whitened, whitened) / freedom
    add_frame(memory.noise, ratio, lasting)
    moved = last[0] == 0 or distance(places[0], position) >= SUSPICIOUS_JUMP_M
    last[1] = 0 if moved else last[0]
    last[0] = stamp_ns
    for i in range(3):  # assigned as arrays, they take 2 s more to be compiled
        places[1, i], places[0, i] = places[0, i], position[i]
        for j in range(3):
            turns[1, i, j], turns[0, i, j] = turns[0, i, j], rotation[i, j]


@inlined
def _expected(stamp_ns, memory):  # type: ignore[no-untyped-def]
    """Return where a body is if it moves on as it did between its last two good poses."""
    last, places, turns, steps = memory.last, memory.position, memory.rotation, 0.0
    if last[1] != 0:
        steps = (stamp_ns - last[0]) / max(last[0] - last[1], 1)
    if 0.0 < steps <= MOST_STEPS:
        return carried_on(places[0], turns[0], places[1], turns[1], steps)
    return places[0], turns[0]


@inlined
def _is_elsewhere(place, middle, rules):  # type: ignore[no-untyped-def]
    """Return whether the volume holds another place with such fields, see `OTHER_SIDES`."""
    opposite, above, found = np.empty(3), place.copy(), False
    for i in range(3):
        opposite[i] = middle[i] - (place[i] - middle[i])
    above[2] = opposite[2]
    for other in (opposite, above):
        found |= is_inside(other, rules) and distance(place, other) > SAME_PLACE_M
    return found


@kernel(nogil=True)
def follow_body(  # type: ignore[no-untyped-def]
    stamp_ns, flux, coils, used, is_whole, own, good, memory, model, middle, rules, limits
):  # fmt: skip
    """Solve a body where its last poses let expect it, judge it, remember it if it is sound.

    ``flux`` (S, 2K), T; ``coils`` are `BodyCoils.arrays`, of which those numbered ``used`` are
    solved with. Unless it ``is_whole``, others are left out, and nothing is remembered. ``good``
    are numbers of coils whose ``own`` positions (S, 3), axes (S, 3) and normal matrices (S, 6, 6)
    tell where the body is, or none. ``model`` is `SolveContext.arrays`, ``middle`` (3,), m, its
    middle, ``rules`` are `coil_step.Rules`, ``limits`` what `usual_and_most` says. Returns whether
    the model's covariance is finite; whether the pose is sound, and the volume holds no other
    place with such fields; its covariance (6, 6); the rms of the residual, T; and the
    `BodySolution`.
    """
    offsets, axes, lengths, changes = coils
    position, rotation = _expected(stamp_ns, memory)
    if good.size > 0:
        reach = reach_of(offsets[good])
        position, rotation = step_to_coils(
            position, rotation, offsets[good], axes[good], own[0][good], own[1][good],
            own[2][good], model.low - reach, model.high + reach,
        )  # fmt: skip
    arms, gains = offsets[used], np.ascontiguousarray(changes[:, used])
    is_finite, found = solve_near(
        position, rotation, (arms, axes[used], lengths[used], gains), flux[used], model
    )
    size, covariance, scale, power = found.residual.size, np.empty((6, 6)), 1.0, 0.0
    freedom = max(size - UNKNOWNS, 1)
    ratio = found.chi2 / freedom
    if rules.adaptive:
        share, follows = freedom / UNKNOWNS, model.modes.shape[0] > 0
        scale = scale_of_frame(memory.noise, ratio, limits, share, model.share, follows)
    for i in range(6):
        for j in range(6):
            by_gain = found.gain * found.carried[i] * (found.gain * found.carried[j])
            covariance[i, j] = scale * (found.covariance[i, j] + by_gain / scale)
    for value in found.residual.ravel():
        power += value * value
    place, sigma_m = found.position.copy(), 0.0
    for i in range(3):
        sigma_m += covariance[i, i]
        for s in range(arms.shape[0]):
            for j in range(3):
                place[i] += found.rotation[i, j] * arms[s, j] / arms.shape[0]
    most_m = rules.max_sigma_m * sigma_factor(rules.has_gate, scale)
    fault = fault_of(
        ratio, rules.gate, is_inside(place, rules), found.converged, math.sqrt(sigma_m), most_m,
        False,
    )  # fmt: skip
    is_sound = is_finite and fault == SOUND and not _is_elsewhere(place, middle, rules)
    if is_sound and is_whole:
        remember(
            stamp_ns, found.position, found.rotation, ratio, found.whitened, freedom, memory
        )  # fmt: skip
    return is_finite, is_sound, covariance, math.sqrt(power / size), found
