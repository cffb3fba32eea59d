"""Finds widths of populations, and which kinds of errors the data support at all.

The likelihood of the parameters is Gaussian about the present estimate. A population's values are
random with one width, which is the one that makes the data most probable (empirical Bayes; MacKay,
Bayesian interpolation, Neural Computation 1992). A kind of error is kept if that probability is
larger with it than without. A channel far outside its population is removed from it and treated
separately. The jitter of an optical tracker is such a width too: that of the poses' errors.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from anser_ros.arrays import Array, Booleans, Integers
from anser_ros.calibration.sensor_parameters import (
    AS_PLACES,
    POPULATIONS,
    PRIOR,
    SHARED_SHIFT,
    STANDS,
    SURVEYED_M,
    USEFUL,
    SensorParameters,
)
from anser_ros.field.measurements import Measurements

WIDTH_STEPS = 40
"""Fixed-point steps of the widths; they settle within some ten."""
NARROWEST = {'gains': 1e-6, 'delays': 1e-12, 'axes': 1e-6, 'places': 1e-7, 'offsets': 1e-9,
             **dict.fromkeys(STANDS, 1e-7)}  # fmt: skip
"""Least width of a population, in its own unit: no spread at all."""
LEAST_EVIDENCE = 5.0
"""Gain of the log probability for which a kind of error is kept: odds of 150 to 1."""
LEAST_POWER = 0.01
"""Power of what a population does to the fluxes, relative to their noise, from which on it is one:
smaller errors change no pose."""
FAR = 6.0
"""Size of a channel's value, in widths of the others' population, from which on it stands alone:
once in ten million values of a Gaussian one."""
FEWEST_PLACES = 4
"""Places with several sensors from which on it can be said what these have in common."""
FEWEST_POPULATION = 4
"""Channels that a population needs for one of them to be judged by the others."""


@dataclass(frozen=True)
class Likelihood:
    """Holds what the data say of Q parameters: a Gaussian about ``values``."""

    information: Array  # (Q, Q): inverse covariance
    natural: Array  # (Q,): information times the most probable values
    readings: float = 0.0  # phasor components of independent noise that the information is from


@dataclass(frozen=True)
class Posterior:
    """Holds parameters with their widths."""

    # values, width (Q,): most probable values, and their prior widths
    values: Array
    width: Array
    covariance: Array  # (Q, Q)
    evidence: float  # log probability of the data, up to a constant
    shared: float = 0.0  # share of the gains' variance that sensors at one place have in common

    @property
    def sigma(self) -> Array:
        """Return the standard deviations of the values, (Q,)."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


def width_by_evidence(square: Array, ratio: Array, least: float) -> tuple[float, float]:
    """Return the prior width that makes values most probable, and how many the data determine.

    It is the fixed point of MacKay's rule, taken once: the squared values over their number less
    what is not determined of them, the ``ratio`` of each one's variance to the squared width that
    it was found with; ``least`` is the least such number.
    """
    freedom = square.size - float(ratio.sum())
    return float(np.sqrt(float(square.sum()) / max(freedom, least))), freedom


def solve(likelihood: Likelihood, width: Array, root: Array | None = None) -> Posterior:
    """Return the parameters for given prior widths, or a root (Q, Q) of the prior covariance."""
    known, unit = likelihood.information, np.eye(width.size)
    # In units of the widths, a parameter that is held fixed does no harm.
    if root is None:
        inner = unit + width[:, None] * known * width
        covariance = width[:, None] * np.linalg.solve(inner, np.diag(width))
    else:
        inner = unit + root.T @ known @ root
        covariance = root @ np.linalg.solve(inner, root.T)
    covariance = (covariance + covariance.T) / 2.0
    values = covariance @ likelihood.natural
    log_size = float(np.linalg.slogdet(inner)[1])
    evidence = 0.5 * float(likelihood.natural @ values) - 0.5 * log_size
    return Posterior(values, width, covariance, evidence)


class Population:
    """Finds the widths of all kinds of parameters."""

    def __init__(self, parameters: SensorParameters) -> None:
        self.parameters = parameters
        self.groups = parameters.groups()
        self.alone: dict[str, Integers] = {
            kind: np.zeros(0, dtype=np.int64) for kind in POPULATIONS
        }

    def fit(self, likelihood: Likelihood, fixed: Sequence[str] = ()) -> Posterior:
        """Return the parameters with the most probable widths; ``fixed`` kinds stay at zero."""
        width = self.parameters.prior_width()
        for kind in fixed:
            width[self.parameters.rows(kind)] = 1e-12
        shared = [
            (kind, np.setdiff1d(rows, self.alone[kind]))
            for kind, rows in self.groups
            if kind in POPULATIONS and kind not in fixed
        ]
        found = solve(likelihood, width)
        for _ in range(WIDTH_STEPS if shared else 0):
            for kind, rows in shared:
                if not rows.size:
                    continue
                ratio = np.diag(found.covariance)[rows] / width[rows] ** 2
                new, _ = width_by_evidence(found.values[rows] ** 2, ratio, 1e-3)
                width[rows] = np.clip(new, NARROWEST[kind], PRIOR[kind])
            found = solve(likelihood, width)
        return found

    def with_common_gains(self, likelihood: Likelihood, found: Posterior) -> Posterior:
        """Weigh gains with what sensors at one place have in common, as much as the data say.

        The prior covariance of the gains at a place is ``a + b`` on its diagonal and ``a`` beside
        it; both are those that make the data most probable (expectation maximisation). Channels
        that are treated separately are not included.
        """
        places = [
            rows for rows in self.parameters.gains_at_one_place()
            if not np.isin(rows, self.alone['gains']).any()
        ]  # fmt: skip
        if len(places) < FEWEST_PLACES:
            return found
        freedom, width = sum(rows.size - 1 for rows in places), found.width.copy()
        common = own = 0.5 * float(width[places[0][0]]) ** 2
        for _ in range(WIDTH_STEPS):
            root = np.diag(width)
            for rows in places:
                block = np.full((rows.size, rows.size), common) + own * np.eye(rows.size)
                root[np.ix_(rows, rows)] = np.linalg.cholesky(block)
            found = solve(likelihood, width, root)
            second = found.covariance + np.outer(found.values, found.values)
            blocks = [second[np.ix_(rows, rows)] for rows in places]
            inside = sum(float(np.trace(b) - b.mean() * len(b)) for b in blocks)
            own = max(inside / freedom, NARROWEST['gains'] ** 2)
            common = float(np.mean([b.mean() - own / len(b) for b in blocks]))
            common = max(common, NARROWEST['gains'] ** 2)
        width[np.concatenate(places)] = np.sqrt(common + own)
        return replace(found, width=width, shared=common / (common + own))

    def stand_alone(self, found: Posterior) -> bool:
        """Take channels far outside their population out of it; return whether there are any."""
        changed, each = False, self.parameters.each
        for kind in POPULATIONS:
            rows = self.parameters.rows(kind).reshape(-1, each[kind])
            inside = ~np.isin(rows[:, 0], self.alone[kind])
            size = np.sqrt((found.values[rows] ** 2).mean(axis=1))
            if inside.sum() < FEWEST_POPULATION:
                continue
            worst = int(np.argmax(np.where(inside, size, -1.0)))
            others = inside.copy()
            others[worst] = False
            typical = float(np.sqrt(np.mean(size[others] ** 2)))
            spread = np.sqrt(np.diag(found.covariance)[rows[worst]].mean())
            if size[worst] > FAR * max(typical, float(spread)):
                self.alone[kind] = np.concatenate([self.alone[kind], rows[worst]])
                changed = True
        return changed

    def undetermined(self, likelihood: Likelihood) -> dict[str, float]:
        """Return the kinds that the data do not usefully determine, with their uncertainty."""
        sigmas = self._data_sigmas(likelihood)
        # What a turn about one axis leaves open between frame and mount does the same as either.
        return {k: s for k, s in sigmas.items() if s > USEFUL[k] and k not in STANDS}

    def _data_sigmas(self, likelihood: Likelihood) -> dict[str, float]:
        """How far the data determine each kind, whatever it is: its typical standard deviation.

        The other populations are as wide as the data make them: places that are free by
        millimetres would leave gains open that places of a few micrometres determine.
        """
        found, start, out = self.fit(likelihood).width, self.parameters.prior_width(), {}
        for kind in self.parameters.kinds:
            width, rows = found.copy(), self.parameters.rows(kind)
            width[rows] = start[rows]
            variance = np.maximum(np.diag(solve(likelihood, width).covariance)[rows], 0.0)
            out[kind] = float(np.sqrt(np.mean(variance)))
        return out

    def shift_sigma_m(
        self, likelihood: Likelihood, found: Posterior, surveyed_m: float = SURVEYED_M
    ) -> float:
        """Return how well a shift of all of a body's sensors is known, m along each axis."""
        parameters, sigmas = self.parameters, self._data_sigmas(likelihood)
        if SHARED_SHIFT not in parameters.asked:
            return 0.0
        if sigmas.get(SHARED_SHIFT, np.inf) <= USEFUL[SHARED_SHIFT]:
            variance = np.diag(found.covariance)[parameters.rows(SHARED_SHIFT)].reshape(-1, 3)
            return float(np.sqrt(variance.mean(axis=1).min()))
        if 'places' not in sigmas or all(len(table) < 2 for table in parameters.tables):
            return surveyed_m
        width = np.sqrt(np.mean(found.width[parameters.rows('places')] ** 2))
        return float(min(surveyed_m, AS_PLACES * np.hypot(width, sigmas['places'])))

    def _power(self, likelihood: Likelihood, found: Posterior, kind: str) -> float:
        """What a kind of error does to the fluxes, in the power of their noise."""
        rows = self.parameters.rows(kind)
        values = found.values[rows]
        power = values @ likelihood.information[np.ix_(rows, rows)] @ values
        return float(power / max(likelihood.readings, 1.0))

    def chosen(
        self, likelihood: Likelihood
    ) -> tuple[Posterior, tuple[str, ...], dict[str, float]]:
        """Leave out every kind that the data are more probable without.

        Returns the posterior with the kinds that are kept, the others, which stay at zero, and the
        gain of the log probability by each kind that is kept.
        """
        # What the data do not determine stays at zero. Otherwise the field's prior, which does not
        # know the tools, would divide what the field and, say, a lever arm could both explain; and
        # the width of a population is found from its values.
        left_out = tuple(self.undetermined(likelihood))
        while True:
            found = self.fit(likelihood, left_out)
            gains = {
                kind: found.evidence - self.fit(likelihood, (*left_out, kind)).evidence
                for kind in self.parameters.kinds
                if kind not in left_out
            }
            for kind in POPULATIONS:
                if kind in gains and self._power(likelihood, found, kind) < LEAST_POWER:
                    gains[kind] = 0.0
            if not gains or min(gains.values()) >= LEAST_EVIDENCE:
                return found, left_out, gains
            left_out = (*left_out, min(gains, key=lambda kind: gains[kind]))


SMALLEST_M = 1e-7
"""Least jitter, m; it keeps the weights of perfect poses finite."""
SMALLEST_RAD = 1e-7
"""The same, rad."""


@dataclass(frozen=True)
class OpticalNoise:
    """Holds the jitter of an optical pose along and about each axis, before interpolation."""

    # position_m, rotation_rad: standard deviations of a component
    position_m: float
    rotation_rad: float
    poses: float = 0.0  # number of poses' worth of data behind them
    # share of the variance that is left in a pose at a flux's stamp, on the average
    interpolated: float = 1.0

    @property
    def jitter(self) -> Array:
        """Return the jitter of a pose along (m) and about (rad) the three axes, shape (6,)."""
        return np.repeat([self.position_m, self.rotation_rad], 3)

    @property
    def relative_uncertainty(self) -> float:
        """Return the relative standard deviation of both figures: three components per pose."""
        return float(1.0 / np.sqrt(max(6.0 * self.poses, 1.0)))

    def mean_sigma_m(self, frames: int) -> float:
        """Return the jitter of the mean of so many frames' poses along each axis, m."""
        return float(self.position_m * np.sqrt(self.interpolated / max(frames, 1)))


def interpolation_share(measurements: Measurements) -> Array:
    """Return which share of a pose's variance linear interpolation leaves at each frame, (F,).

    Between two poses of independent jitter, at the fraction a of the way, it is
    ``(1 - a)^2 + a^2``.
    """
    track = measurements.track
    if track is None or track.time.size < 2:
        return np.ones(len(measurements.time))
    right = np.clip(np.searchsorted(track.time, measurements.time), 1, track.time.size - 1)
    before, after = track.time[right - 1], track.time[right]
    along = np.clip((measurements.time - before) / np.maximum(after - before, 1e-9), 0.0, 1.0)
    return np.asarray((1.0 - along) ** 2 + along**2)


APART_S = 1.0
"""Time, s, from which on two poses of the reference share no sample of it."""
NEAREST = 8
"""Poses beside each one among which the nearest of another time is looked for."""
NEAR = 0.2
"""Distance of these at most, as a fraction of the poses' extent: farther errors are other ones."""


def alike_sigma_m(
    parts: Sequence[Measurements], steps: Sequence[Array], kept: Sequence[Booleans]
) -> float:
    """Return how far poses at the same place are off together, m along each axis, one sigma.

    That is what field and sensors cannot explain, and the reference's own errors by place; the
    jitter of poses has no part in it.
    For each of the measurements, ``steps`` (F, 6) to where the fluxes put the poses.
    """
    place = np.concatenate([m.position[k] for m, k in zip(parts, kept, strict=True)])
    time = np.concatenate([m.time[k] for m, k in zip(parts, kept, strict=True)])
    step = np.concatenate([s[k, :3] for s, k in zip(steps, kept, strict=True)])
    of = np.repeat(np.arange(len(parts)), [int(k.sum()) for k in kept])
    if len(place) <= NEAREST:
        return 0.0
    distance, row = cKDTree(place).query(place, NEAREST + 1)
    other = (np.abs(time[row] - time[:, None]) >= APART_S) | (of[row] != of[:, None])
    other &= distance < NEAR * float(np.ptp(place, axis=0).max())
    some, first = np.flatnonzero(other.any(axis=1)), other.argmax(axis=1)
    if len(some) <= NEAREST:
        return 0.0
    product = (step[some] * step[row[some, first[some]]]).mean()
    return float(np.sqrt(max(product, 0.0)))


def estimate_noise(
    steps: Sequence[Array],
    variances: Sequence[Array],
    shares: Sequence[Array],
    kept: Sequence[Booleans],
    present: OpticalNoise,
) -> OpticalNoise:
    """Estimate the jitter from the poses' most probable steps.

    The squares of the steps are divided by the number of steps that the fluxes determined (MacKay,
    Bayesian interpolation, Neural Computation 1992): a single coil does not see every direction.

    For each of the measurements: the ``steps`` (F, 6), m and rad, found with the ``present``
    jitter, their ``variances``, the ``shares`` of `interpolation_share`, and which frames to use.
    """
    parts = [
        (step[keep] ** 2 / share[keep, None], variance[keep] / share[keep, None])
        for step, variance, share, keep in zip(steps, variances, shares, kept, strict=True)
    ]
    square, uncertain = (np.concatenate(part) for part in zip(*parts, strict=True))
    ratio = uncertain / present.jitter**2
    (along, seen), (about, turned) = (
        width_by_evidence(square[:, own], ratio[:, own], 1.0) for own in (slice(0, 3), slice(3, 6))
    )
    left = np.concatenate([share[keep] for share, keep in zip(shares, kept, strict=True)])
    return OpticalNoise(
        max(along, SMALLEST_M),
        max(about, SMALLEST_RAD),
        min(seen, turned) / 3.0,
        float(left.sum()) / max(left.size, 1),
    )
