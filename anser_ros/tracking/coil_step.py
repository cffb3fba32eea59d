"""Solves, judges and remembers coils near where they are expected, in one call of compiled code.

`follow_coils` takes the coils' readings and what is remembered of each (`CoilMemory`), and writes
where each solve ended (`Followed`). It holds no interpreter lock. What it leaves `UNKNOWN` is
looked at again by `coil_track`, which shares its memory.
"""

import math
from typing import NamedTuple

import numpy as np

from anser_ros.arrays import Array, Integers
from anser_ros.kernel_cache import inlined, kernel
from anser_ros.stamps import NANO
from anser_ros.tracking.descent import descend
from anser_ros.tracking.estimate import TrackerSettings, add_frame, scale_of_frame, sigma_factor
from anser_ros.tracking.solve import MAX_EVALUATIONS, CoilSolution, coil_covariance
from anser_ros.tracking.solve_context import fill_model_errors, growth_at
from anser_ros.tracking.solve_verdict import IN_METAL, SOUND, Freedom, fault_of, usual_and_most

SUSPICIOUS_JUMP_M = 0.02
"""A pose that moved further from one frame to the next, m, is confirmed by a scan, for it may be
another solution of the same fluxes. Smaller, and fast tools are scanned for in every frame;
larger, and a wrong solution near by is followed."""
MOST_STEPS = 2.5
"""Motion is carried on for so many of the last step's durations."""
UNKNOWNS = 5
"""Numbers that a coil's pose has."""
SELDOM = 0.1
"""Probability of a residual beyond which it counts as more than noise and widens the sigma of its
frame. Smaller, and slight distortion is not seen; larger, and plain noise widens many poses."""
ERROR_REACH = 0.05
"""Move, as a part of the distance from the nearest uncertain dipole, and turn (chord of the axes)
up to which the model's error at a pose is reused."""


class CoilMemory(NamedTuple):
    """Holds what is remembered of S coils, as arrays for the compiled step."""

    good_ns: Integers  # (S,), stamp of the last good pose; 0 for none
    before_ns: Integers  # (S,), of the good pose before, from which motion is carried on; 0: none
    # good, before: (S, 6), position, m, and unit axis of these poses, frame fg
    good: Array
    before: Array
    noise: Array  # (S, 4), see `FRESH_NOISE`
    whitened: Array  # (S, 2K), residuals at the last good pose, in sigmas; NaN for none
    # What the model's uncertainty does to a coil at a pose, and is reused while the coil is near
    error_at: Array  # (S, 6), the pose
    reach_m: Array  # (S,), move up to which it is reused; negative where there is none
    # (S,): above 1, the coil is where dipoles that stand for metal describe the field no more
    among: Array
    errors: Array  # (S, R, 2K), flux errors of one standard deviation each, T
    whitening: Array  # (S, 2K, 2K), 1/T, or the diagonal alone, (S, 1, 2K)


class Rules(NamedTuple):
    """Holds settings, as the compiled step needs them."""

    gate: float
    has_gate: bool
    adaptive: bool
    freedom: float
    usual: float  # Power per freedom that noise seldom exceeds
    most: float  # Power per freedom from which on a misfit is systematic
    warm_age_s: float
    min_signal: float
    roll_variance: float
    max_sigma_m: float
    most_steps: int  # of a descent
    low: tuple[float, float, float]
    high: tuple[float, float, float]


class Followed(NamedTuple):
    """Holds where the solves of S coils ended, near where these were expected."""

    fault: Integers  # (S,), as `fault_of` names it; `UNKNOWN` where there is no such pose
    position: Array  # (S, 3), m, frame fg
    axis: Array  # (S, 3)
    normal: Array  # (S, 6, 6), see `CoilSolution`
    residual: Array  # (S, 2K), T
    found: Array  # (S, 3), chi-square, evaluations, whether it converged
    covariance: Array  # (S, 6, 6)
    residual_t: Array  # (S,), rms of the residual, T

    @classmethod
    def empty(cls, count: int, width: int) -> 'Followed':
        """Return arrays to be filled."""
        return cls(
            np.full(count, UNKNOWN), np.empty((count, 3)), np.empty((count, 3)),
            np.empty((count, 6, 6)), np.empty((count, width)), np.empty((count, 3)),
            np.empty((count, 6, 6)), np.empty(count),
        )  # fmt: skip

    def solution(self, i: int) -> CoilSolution:
        """Return one coil's solution."""
        chi2, used, converged = self.found[i].tolist()
        return CoilSolution(
            self.position[i], self.axis[i], chi2, self.normal[i], self.residual[i], int(used),
            bool(converged),
        )  # fmt: skip


UNKNOWN = -1
"""Stands for a coil that has to be looked at again: too little is known of its pose."""


@inlined
def distance(one, other):  # type: ignore[no-untyped-def]
    """Return the distance of two points."""
    x, y, z = one[0] - other[0], one[1] - other[1], one[2] - other[2]
    return math.sqrt(x * x + y * y + z * z)


@inlined
def is_inside(place, rules):  # type: ignore[no-untyped-def]
    """Return whether a place (3,), m, is in the volume."""
    inside = True
    for i in range(3):
        inside &= rules.low[i] <= place[i] <= rules.high[i]
    return inside


@inlined
def _knows_errors(s, position, axis, memory, model):  # type: ignore[no-untyped-def]
    """Return whether the error that is remembered for coil ``s`` is that at a pose, too."""
    at = memory.error_at[s]
    is_near = distance(position, at[:3]) < memory.reach_m[s]
    is_certain = model.modes.shape[0] == 0 and model.strengths.shape[0] == 0
    return is_certain or (is_near and distance(axis, at[3:]) < ERROR_REACH)


@inlined
def _take_errors_of(coils, positions, axes, lengths, flux, memory, model):  # type: ignore[no-untyped-def]
    """Remember the model's error for coils (C,) at poses, ``positions`` and ``axes`` (C, 3), where
    they read ``flux`` (C, 2K), T.

    All are worked out together, for reading the model's modes takes longest.
    """
    count, rank, width = coils.shape[0], memory.errors.shape[1], memory.errors.shape[2]
    errors, whitening = np.empty((count, rank, width)), np.empty((count, width, width))
    near = np.empty((count, 2))
    is_finite = fill_model_errors(
        positions, axes, lengths, model.uncertain, model.spacing, model.modes, model.sigma,
        flux, model.strengths, errors, whitening, near,
    )  # fmt: skip
    for c in range(count):
        s = coils[c]
        for k in range(width):  # assigned as arrays, they take 2 s more to be compiled
            for r in range(rank):
                memory.errors[s, r, k] = errors[c, r, k]
            for j in range(width):
                memory.whitening[s, k, j] = whitening[c, k, j]
        for i in range(3):
            memory.error_at[s, i], memory.error_at[s, 3 + i] = positions[c, i], axes[c, i]
        far = near[c, 0] if rank > 0 else positions[c, 2]  # over the board's own plane
        memory.reach_m[s] = ERROR_REACH * far if is_finite else -1.0
        memory.among[s] = near[c, 1]
    return is_finite


@kernel
def take_errors(s, position, axis, length, flux, memory, model):  # type: ignore[no-untyped-def]
    """Remember the model's error for coil ``s`` at a pose, unless what is remembered is near.

    ``length`` (1,), m; ``flux`` (1, 2K), T, is what it reads; ``model`` is `SolveContext.arrays`.
    Returns False where the covariance is not finite.
    """
    if _knows_errors(s, position, axis, memory, model):
        return True
    coil, here, along = np.array([s]), position.reshape(1, 3), axis.reshape(1, 3)
    return _take_errors_of(coil, here, along, length, flux, memory, model)


@kernel
def remember(s, stamp_ns, position, axis, residual, ratio, freedom, memory):  # type: ignore[no-untyped-def]
    """Take in a good solution of coil ``s``: ``residual`` (2K,), T, its power a freedom.

    The model's error there has been taken in before, by `take_errors`.
    """
    weights, last = memory.whitening[s], memory.whitened[s]
    lasting, has_last = 0.0, not math.isnan(last[0])
    for k in range(residual.shape[0] - 1, -1, -1):  # the factor is lower triangular
        white = 0.0
        if weights.shape[0] == 1:
            white = weights[0, k] * residual[k]
        else:
            for j in range(k + 1):
                white += weights[k, j] * residual[j]
        lasting += last[k] * white / freedom
        last[k] = white
    add_frame(memory.noise[s], ratio, lasting if has_last else 0.0)
    good, before = memory.good[s], memory.before[s]
    moved = memory.good_ns[s] == 0 or distance(good, position) >= SUSPICIOUS_JUMP_M
    memory.before_ns[s] = 0 if moved else memory.good_ns[s]
    memory.good_ns[s] = stamp_ns
    for i in range(3):
        before[i], before[3 + i] = good[i], good[3 + i]
        good[i], good[3 + i] = position[i], axis[i]


@inlined
def _expect(s, stamp_ns, memory, position, axis):  # type: ignore[no-untyped-def]
    """Write where coil ``s`` is if it moves on as between its last two good poses."""
    good, before, steps, norm = memory.good[s], memory.before[s], 0.0, 0.0
    if memory.before_ns[s] != 0:
        last_ns = memory.good_ns[s]
        steps = (stamp_ns - last_ns) / max(last_ns - memory.before_ns[s], 1)
        steps = steps if 0.0 < steps <= MOST_STEPS else 0.0
    for i in range(3):
        position[i] = good[i] + steps * (good[i] - before[i])
        axis[i] = good[3 + i] + steps * (good[3 + i] - before[3 + i])
        norm += axis[i] * axis[i]
    norm = math.sqrt(norm) if steps > 0.0 else 1.0
    for i in range(3):
        axis[i] /= norm


@inlined
def _judge_coil(s, memory, model, rules, out):  # type: ignore[no-untyped-def]
    """Write covariance and figures of coil ``s`` into ``out``; return what is wrong with it."""
    ratio, scale, power, position = out.found[s, 0] / rules.freedom, 1.0, 0.0, out.position[s]
    if rules.adaptive:
        share, follows = rules.freedom / UNKNOWNS, model.modes.shape[0] > 0
        limits = rules.usual, rules.most
        scale = scale_of_frame(memory.noise[s], ratio, limits, share, model.share, follows)
    covariance = coil_covariance(out.normal[s], out.axis[s], rules.roll_variance / scale)
    for i in range(6):
        for j in range(6):
            out.covariance[s, i, j] = scale * covariance[i, j]
    covariance = out.covariance[s]
    sigma_m = math.sqrt(covariance[0, 0] + covariance[1, 1] + covariance[2, 2])
    for value in out.residual[s]:
        power += value * value
    out.residual_t[s] = math.sqrt(power / out.residual.shape[1])
    most_m = rules.max_sigma_m * sigma_factor(rules.has_gate, scale)
    in_metal = memory.among[s] > 1.0 and rules.has_gate
    return fault_of(ratio, rules.gate, is_inside(position, rules), True, sigma_m, most_m, in_metal)


@kernel(nogil=True)
def follow_coils(stamp_ns, values, sound, lengths, memory, model, rules, out):  # type: ignore[no-untyped-def]
    """Solve, judge and remember all coils that are where their last poses let expect them.

    ``values`` (S, 2K): flux components, T; ``sound`` (S,): which coils have good readings;
    ``lengths`` (S,), m; ``model`` is `SolveContext.arrays`, ``rules`` are `Rules`. ``out`` is
    `Followed`, with `UNKNOWN` on entry. Returns False where the model's covariance is not finite.
    """
    # Where they are expected, and for which of them the model's error there is not known
    is_warm = np.zeros(values.shape[0], np.bool_)
    unknown, count = np.empty_like(memory.good_ns), 0
    for s in range(values.shape[0]):
        power, flux = 0.0, values[s]
        if not sound[s] or memory.good_ns[s] == 0:
            continue
        if (stamp_ns - memory.good_ns[s]) * NANO > rules.warm_age_s:
            continue
        for k in range(flux.shape[0]):
            power += (flux[k] / model.sigma[k]) ** 2
        if math.sqrt(power / flux.shape[0]) < rules.min_signal:
            continue
        is_warm[s] = True
        _expect(s, stamp_ns, memory, out.position[s], out.axis[s])
        if not _knows_errors(s, out.position[s], out.axis[s], memory, model):
            unknown[count] = s
            count += 1
    coils = unknown[:count]
    if count > 0 and not _take_errors_of(
        coils, out.position[coils], out.axis[coils], lengths[coils], values[coils], memory, model
    ):
        return False
    for s in range(values.shape[0]):
        if not is_warm[s]:
            continue
        position, axis, row = out.position[s], out.axis[s], slice(s, s + 1)
        descend(
            out.position[row], out.axis[row], lengths[row], values[row], memory.whitening[row],
            model.columns, model.moments, model.low, model.high, rules.most_steps,
            out.normal[row], out.residual[row], out.found[row],
        )  # fmt: skip
        growth = growth_at(position, model)
        out.found[s, 0] /= growth
        out.normal[s] /= growth
        ratio = out.found[s, 0] / rules.freedom
        is_confirmed = not ratio > rules.gate * rules.gate and out.found[s, 2] != 0.0
        if not is_confirmed or distance(position, memory.good[s]) > SUSPICIOUS_JUMP_M:
            continue
        out.fault[s] = _judge_coil(s, memory, model, rules, out)
        if out.fault[s] == SOUND:
            if not take_errors(s, position, axis, lengths[row], values[row], memory, model):
                return False
            if memory.among[s] > 1.0 and rules.has_gate:  # where it is now, not where expected
                out.fault[s] = IN_METAL
                continue
            freedom = rules.freedom * growth
            remember(s, stamp_ns, position, axis, out.residual[s], ratio, freedom, memory)
    return True


def freedom_of(width: int, readings: int) -> Freedom:
    """Return what so many flux components, and readings among them, leave to a coil's pose."""
    return Freedom(max(width - UNKNOWNS, 1), UNKNOWNS, SELDOM, readings - UNKNOWNS)


def rules_of(settings: TrackerSettings, freedom: Freedom) -> Rules:
    """Return the rules for coils of such a freedom."""
    box, (usual, most) = settings.box, usual_and_most(settings, freedom)
    return Rules(
        float(settings.gate), settings.has_gate, settings.adaptive, float(freedom.of_residual),
        usual, most, float(settings.warm_age_s),
        float(settings.min_signal), float(settings.roll_variance), float(settings.max_sigma_m),
        MAX_EVALUATIONS,
        (float(box.low[0]), float(box.low[1]), float(box.low[2])),
        (float(box.high[0]), float(box.high[1]), float(box.high[2])),
    )  # fmt: skip
