"""Fits frames and active effects with the noise of the rest, and what the motion shows.

Which components of a lever arm the motion determines, and whether all sensors see one scale.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv, ndtri

from anser_ros.apps.poses.effect import PoseTerm, Role, effect_with
from anser_ros.apps.poses.problem import PoseNoise, PosePart, PoseProblem, PoseState, stamp_step
from anser_ros.apps.poses.sequence import PoseSequence, PoseSession
from anser_ros.arrays import Array, Booleans
from anser_ros.diagnosis.engine import JointFit, block_sums, descended, joined, stepped
from anser_ros.effects.effect import sigmas

EVEN = np.array([
    (np.outer(a, b) + np.outer(b, a)) / np.sqrt(2 + 2 * (a @ b))
    for i, a in enumerate(np.eye(3)) for b in np.eye(3)[i:]
])  # fmt: skip
"""Even matrices of unit size, six by 3 x 3."""
STUDENT_FREEDOM = 4.0
"""Degrees of freedom of Student's t in robust fits: between the mean (infinite) and Cauchy (1)."""
REWEIGHTINGS = 5
"""Fits of a robust fit after the first: fewer leave bad poses some of their first weight."""
STANDS_OUT, FAR_OUT = 7.0, 25.0
"""Distances of a pose from its prediction, in spreads, to stand out: where few do, and many."""
FEW_SHARE = 0.03
"""Share of a sensor's poses up to which those that stand out are few: between one window and the
two that metal must be near to be named (`episodes.WINDOWS`)."""
SMALLEST_NOISE = (1e-6, 1e-6)  # m and rad; what is exact would have an infinite weight
FEWEST_BLOCKS = 10
"""Blocks by whose scores the variance of a time beside a poll is judged; fewer show no course."""
SLOW = 6
"""Tapers of a slow course: fewer take chance for accuracy, more are as quick as a poll's teeth."""
CHANCE = 0.01
"""Chance that the poses' own noise makes a slow course: smaller leaves out beats of a poll."""
FILTER_STEPS = 3  # Newton's, to a time constant that is known to some percent
NEAR_TAU = 1.25
"""Factor by which positions alone may move a time constant; without a filter it leads anywhere."""
STRAINED = 1.85
"""Squares of five strains over those of their noise from which they are seen: chance, 1 in 10."""
FARTHEST_LOG = 100.0
"""Logarithm of a spread, either way, at which a search for the likeliest one stops: no number of
this size has an overflow."""
LARGEST_STAMP_S = 0.1
"""Spread of stamps, s, beyond which a time makes no pose of a hand's motion."""


@dataclass(frozen=True)
class PoseFit(JointFit[PoseState]):
    """Holds the terms of poses at their joint optimum."""

    @property
    def terms(self) -> tuple[PoseTerm, ...]:
        """Return all terms with their fitted parameters."""
        return self.state.terms

    def held_out(self, in_space: bool = False) -> float:
        """Return the cross-validated sum of squares over blocks of time, or of space."""
        return self._held_out_in_space if in_space else super().held_out()

    @cached_property
    def _held_out_in_space(self) -> float:
        state = self.state.in_space
        return state.sums(state.numbers).held_out(self.prior, state.folds)

    @cached_property
    def covariance(self) -> Array:
        """Return the covariance of all parameters, of a scale with what distortions fake of it."""
        whole, scale = self.noise_covariance, np.ones(self.prior.size)
        for index in (i for i, term in enumerate(self.terms) if term.role is Role.SCALE):
            own = self.rows(index)
            scale[own] = np.sqrt(1 + strain_variance(self) / np.diag(whole)[own])
        return np.asarray(whole * scale[:, None] * scale[None, :])

    @cached_property
    def faked_levers(self) -> dict[str, Array]:
        """Return the variance (3,), m^2, of each sensor's lever arm that smooth errors make.

        Of the nine ways in which an error goes with the turn (rad, from the middle) three are a
        lever arm; the scatter of the six others, less that of noise, is that of any: a twelfth for
        each, and six tell it to 3/2 (Student's t). So does a stretch that no map takes up.
        """
        state, sensors = self.state, len(self.state.parts)
        columns: list[Array | None] = []
        for k, part in enumerate(state.parts):
            turns = Rotation.from_matrix(part.view.turn)
            middle = turns[part.used].mean() if part.used.any() else turns.mean()
            about = part.view.frame @ middle.as_matrix()
            own = np.zeros((*part.residual.shape, 6 * sensors))
            moved = np.einsum('ij,mjk,nk->nim', about, EVEN, (middle.inv() * turns).as_rotvec())
            own[:, :3, 6 * k : 6 * k + 6] = moved
            white = part.noise.whitened(own, part.view.velocity)
            columns.append(white * part.weight[:, None, None])
        sums = block_sums(state.parts, joined([state.designs(state.terms), columns]), self.blocks)
        prior = np.concatenate([self.prior, np.full(6 * sensors, LEAST_KNOWN_M)])
        values, spread = sums.solve(prior)[0], np.diag(sums.covariance(prior, self.misfit))
        other = (values**2 - spread)[self.prior.size :].reshape(sensors, 6).sum(axis=1)
        roles = {term.role for term in state.terms}
        is_bent = Role.MAP in roles and Role.SCALE not in roles
        strain = 0.0 if is_bent else 1e-6 * strain_variance(self)
        return {
            p.view.sensor: max(float(one), 0.0) / 8 + strain * p.view.lever**2
            for p, one in zip(state.parts, other, strict=True)
        }

    @cached_property
    def noise_covariance(self) -> Array:
        """Return the covariance of all parameters, as `BlockSums.covariance`.

        Errors of stamps on the grid of a poll are a sawtooth. What it adds to the poses' own noise
        is seen in the slow course of the blocks' scores (by sine tapers).
        """
        filtered = any(term.role is Role.FILTER for term in self.terms)
        sums = self.state.sums_with(filter_slopes=True) if filtered else self.sums
        whole = sums.covariance(self.prior, self.misfit)
        clocks = np.repeat(
            [t.role.is_clock for t in self.terms], [t.theta.size for t in self.terms]
        )
        blocks = sums.squares.size
        if not clocks.any() or blocks <= FEWEST_BLOCKS or not self._is_polled():
            return whole
        formal = sums.solve(self.prior)[1][clocks]
        exact = self.state.sums_with(filtered, stamps_exact=True).normal.sum(axis=0)
        exact += np.diag(1 / self.prior**2)
        least = np.einsum('ci,ij,cj->c', formal, exact, formal) * max(self.misfit, 1.0)
        course = np.outer(np.arange(1, SLOW + 1), np.arange(1, blocks + 1))
        tapers = np.sin(np.pi * course / (blocks + 1)) * np.sqrt(2 * blocks / (blocks + 1))
        slow = np.mean((tapers @ sums.right @ formal.T) ** 2, axis=0)
        limit = 2 * gammaincinv(SLOW / 2, 1 - CHANCE)  # of chi-square; scipy.stats loads slowly
        variance = np.where(slow > least * limit / SLOW, slow, least)
        scale = np.ones(clocks.size)
        scale[clocks] = np.sqrt(variance / np.diag(whole)[clocks])
        return np.asarray(whole * scale[:, None] * scale[None, :])

    def _is_polled(self) -> bool:
        """Whether the stamps of a sensor have errors and lie on a grid."""
        sensors = zip(self.state.problem.sensors, self.state.parts, strict=True)
        return any(part.noise.stamp_s and stamp_step(poses.time) for poses, part in sensors)


def fit_poses(problem: PoseProblem, terms: Sequence[PoseTerm], iterations: int = 10) -> PoseFit:
    """Fit all parameters of all terms together, the two frames among them, from their values."""
    state = problem.state(terms)
    return PoseFit(*descended(state, state.numbers, iterations))


def strain_variance(fit: PoseFit) -> float:
    """Return the variance, 1e-6, of a scale by a smooth distortion of the size that is seen.

    Space stretches in six ways, of which a scale is one. The scatter of the five others, of the
    map that stands beside it or of a linear one in its place, less that of noise, is that of any:
    a third of it is the mean's, and five tell it to 5/3 (Student's t).
    """
    setting = fit.state.problem.setting
    index = next((i for i, term in enumerate(fit.terms) if term.is_beside_scale), 0)
    if not fit.terms[index].is_beside_scale:
        linear = next(t for t in effect_with(Role.MAP).sites(setting) if t.theta.size == 9)
        rest = (t for t in fit.terms if t.sensor or t.role not in (Role.SCALE, Role.MAP))
        fit, index = fit_poses(fit.state.problem, [linear, *rest], 3), 0
    own = fit.rows(index).start + np.arange(9)
    other = np.eye(9) + np.eye(9).reshape(3, 3, 9).swapaxes(0, 1).reshape(9, 9)
    unequal = other / 2 - np.outer(np.eye(3), np.eye(3)).reshape(9, 9) / 3
    strains = unequal @ fit.terms[index].theta[:9] / setting.size
    noise = np.trace(unequal @ fit.noise_covariance[np.ix_(own, own)] @ unequal) / setting.size**2
    seen = float(strains @ strains)
    return (seen - float(noise)) / 9 if seen > STRAINED * noise else 0.0


def with_time_constants(fit: PoseFit) -> PoseFit:
    """Return the fit with the time constants of filters, which lie near, fitted by their slopes.

    Positions alone tell them (`PoseState.sums_with`), so that steps need not lower the sum of
    squares.
    """
    filters = [i for i, term in enumerate(fit.terms) if term.role is Role.FILTER]
    if not filters:
        return fit
    state = fit.state
    for _ in range(FILTER_STEPS):
        terms = stepped(state.terms, state.sums_with(filter_slopes=True).step(fit.prior, 0.0))
        moved = [float(terms[i].theta[0] / fit.terms[i].theta[0]) for i in filters]
        if not all(1 / NEAR_TAU < factor < NEAR_TAU for factor in moved):
            return fit
        state = state.moved(terms)
    return PoseFit(state, state.numbers)


def robust_fit(problem: PoseProblem, terms: Sequence[PoseTerm]) -> PoseFit:
    """Fit with poses weighted by how far they are off, and with the spread that they show."""
    problem = replace(problem, noise=tuple(_spread(p) for p in problem.state(terms).parts))
    fit = fit_poses(problem, terms, 4)
    for _ in range(REWEIGHTINGS):
        parts = fit.state.parts
        noise = tuple(_spread(part) for part in parts)
        weight = tuple(
            np.where(w > 0, _student(part, n), 0.0)
            for part, n, w in zip(parts, noise, problem.weight, strict=True)
        )
        fit = fit_poses(replace(problem, noise=noise, weight=weight), fit.terms, 4)
    return fit


def _student(part: PosePart, noise: PoseNoise) -> Array:
    white = noise.whitened(part.residual, part.view.velocity)
    far = np.sum(white**2, axis=1)
    return np.asarray(np.sqrt((STUDENT_FREEDOM + 6) / (STUDENT_FREEDOM + far)))


def _spread(part: PosePart) -> PoseNoise:
    """Robust spread of a coordinate: the median of |normal| is 0.6745 of its deviation."""
    used = part.used
    if not used.any():
        return part.noise
    sizes = np.median(np.abs(part.residual[used]), axis=0) / 0.6745
    place, turn = np.sqrt(np.mean(sizes[:3] ** 2)), np.sqrt(np.mean(sizes[3:] ** 2))
    return PoseNoise(
        max(float(place), SMALLEST_NOISE[0]), max(float(turn), SMALLEST_NOISE[1]), 0.0
    )


def weights_of(state: PoseState) -> tuple[Array, ...]:
    """Return weights, zero of poses far beyond the spread of their sensor's others."""
    found = []
    for part in state.parts:
        noise = replace(_spread(part), stamp_s=part.noise.stamp_s)
        white = noise.whitened(part.residual, part.view.velocity)
        far = np.maximum(*(np.linalg.norm(half, axis=1) for half in np.hsplit(white, 2)))
        out = part.used & (far > STANDS_OUT)
        few = np.count_nonzero(out) <= FEW_SHARE * np.count_nonzero(part.used)
        found.append(np.where(out if few else part.used & (far > FAR_OUT), 0.0, 1.0))
    return tuple(found)


def noise_of(part: PosePart, with_stamps: bool = True) -> tuple[PoseNoise, float]:
    """Return the likeliest noise of a sensor's residuals, and minus twice its log likelihood."""
    used = part.used
    residual, velocity = part.residual[used], part.view.velocity[used]
    if not len(residual):
        return part.noise, 0.0
    own, speed, moved = (
        values.reshape(-1, 2, 3).sum(axis=2).T
        for values in (np.mean(residual**2, axis=0), velocity**2, velocity * residual)
    )
    start = np.maximum(np.sqrt(own[:, 0] / 3), SMALLEST_NOISE)
    if not with_stamps:  # the mean squares are the likeliest
        cost = float(own[:, 0] @ start**-2 + 6 * np.log(start).sum())
        return PoseNoise(float(start[0]), float(start[1])), cost * len(residual)

    def cost_and_slopes(log: Array) -> tuple[float, Array]:
        """Sum of the whitened squares (`PoseNoise.whitened`) and of the spreads' logarithms."""
        log = np.clip(log, -FARTHEST_LOG, FARTHEST_LOG)
        weight, stamp = np.exp(-2 * log[:2]), np.exp(2 * log[2])
        along, off = stamp * (weight @ speed), weight @ moved
        share = stamp / (1 + along)
        fixed = weight @ own[:, 0] + 6 * log[:2].sum()
        value = fixed + np.mean(np.log1p(along) - share * off**2)
        slopes = np.mean(share * (1 + share * off**2) * speed - 2 * share * off * moved, axis=1)
        last = 2 * np.mean(along / (1 + along) - share**2 * off**2 / stamp)
        return float(value), np.r_[6 - 2 * weight * (own[:, 0] + slopes), last]

    tries = [np.log([*start, stamp]) for stamp in (0.002, 0.02)]
    found = [minimize(cost_and_slopes, at, method='BFGS', jac=True) for at in tries]
    best = min(found, key=lambda result: float(result.fun))
    values = np.exp(best.x)
    stamp = min(float(values[2]), LARGEST_STAMP_S)
    return PoseNoise(float(values[0]), float(values[1]), stamp), float(best.fun) * len(residual)


LEAST_JITTER_RAD = 1e-5  # no reference measures turns better; none at all has no inverse
FEWEST_TURNS = 20  # poses that tell a reference's jitter, to 16 %
MOST_BLUR = 0.1  # share by which a lever arm that is given may be too small
LEAST_KNOWN_M, LEAST_KNOWN_RAD = 0.01, 0.1
"""Standard deviation of a lever arm's component, m, or turn, rad, beyond which it is not given."""
MUCH_TILT = 0.15
"""Turns, rad rms, that move a lever arm of 5 cm by 8 mm, as much as a slow filter does a hand."""
HARDLY_DETERMINED_M = 0.022
"""Lever arm, m, that would make the median error by turns alone, from which the motion does not
determine it: beyond this levers of recordings were off by 9 mm and more, below by 4 and less."""

OWN_ERROR_M = 1e-3
"""Error, m, that a tracker has of itself (data sheets: 0.5 to 1.4 mm). A motion of some seconds
leaves less, as the frames take up what goes with its turns, and with it wrong levers."""


def is_lever_determined(
    part: PosePart, jitter_rad: float, error_m: float = OWN_ERROR_M
) -> Booleans:
    """Return the mask (3,) of the components of a lever arm that the motion determines.

    The reference's own jitter must be little of the rotations, by whose share it makes a lever arm
    too small, and the lever arm that makes the median error, ``error_m`` at least, must be short.
    """
    if not part.used.any():
        return np.zeros(3, dtype=np.bool_)
    turns, one = _turn_information(part), np.eye(3)
    error = 2 * max(jitter_rad, LEAST_JITTER_RAD) ** 2
    blur = error * np.diag(np.linalg.inv(turns + 1e-3 * error * one))
    far = max(float(np.median(np.linalg.norm(part.residual[part.used, :3], axis=1))), error_m)
    reach = far * np.sqrt(np.diag(np.linalg.inv(turns + LEAST_JITTER_RAD**2 * one)))
    return np.asarray((blur < MOST_BLUR) & (reach < HARDLY_DETERMINED_M))


def _turn_information(part: PosePart) -> Array:
    """How much turns move a unit lever arm, shape (3, 3), squares, along the body's axes."""
    turns = Rotation.from_matrix(part.view.turn[part.used])
    tilt = np.cov((turns.mean().inv() * turns).as_rotvec().T)
    return np.asarray(np.trace(tilt) * np.eye(3) - tilt)


def turn_jitter(reference: PoseSequence) -> float:
    """Return a reference's jitter of orientation, rad a coordinate, from its quietest stretches.

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

    So many are determined by turns about one axis. Much tilt determines them once the effects are
    found, however large the error is that these make before.
    """
    shaking = turn_jitter(reference)
    for index, term in enumerate(fit.terms):
        if term.role is Role.MOUNT:
            part = fit.state.part(str(term.sensor))
            sigma = sigmas(fit.covariance_of(index))[:3]
            is_known = (sigma < LEAST_KNOWN_M) & is_lever_determined(part, shaking, 0.0)
            turns = _turn_information(part) if part.used.any() else np.zeros((3, 3))
            tilted = np.sqrt(np.diag(turns)) > MUCH_TILT
            if np.count_nonzero(is_known | tilted) >= 2:
                return True
    return False


SAME_SCALE = 1 / 370
"""Chance that noise makes any two sensors' scales differ so much: three sigmas of one pair."""
SCALE_DIFFERS = 0.003  # difference of scales that matters: 1 mm in a tracked volume


def is_one_scale(fit: PoseFit) -> bool:
    """Return whether each sensor alone sees the same scale as the others do."""
    problem, found = fit.state.problem, []
    if len(problem.sensors) < 2:
        return True
    for i, poses in enumerate(problem.sensors):
        # A map of its own would take up what differs.
        terms = [t for t in fit.terms if t.acts_on(poses.name) and t.role is not Role.MAP]
        one = fit_poses(problem.sensor(i), terms)
        index = next(k for k, t in enumerate(one.terms) if t.role is Role.SCALE)
        scale = 1e-3 * float(one.terms[index].theta[0])
        found.append((scale, 1e-3 * float(np.sqrt(one.covariance_of(index)[0, 0]))))
    pairs = list(combinations(found, 2))
    times = -float(ndtri(SAME_SCALE / (2 * len(pairs))))
    return all(
        abs(scale - other) <= max(times * float(np.hypot(sigma, apart)), SCALE_DIFFERS)
        for (scale, sigma), (other, apart) in pairs
    )
