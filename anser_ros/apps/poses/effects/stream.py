"""What is wrong with a stream: repeated, missing or outlying poses, stamps of receipt, noise."""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import minimize

from anser_ros.apps.poses.effect import PoseEffect
from anser_ros.apps.poses.effects.episodes import in_episode, is_passed
from anser_ros.apps.poses.problem import PoseResiduals, Sensing, jitter, stamp_step
from anser_ros.apps.poses.sequence import REFERENCE, PoseSequence, PoseSession, jumping_poses
from anser_ros.arrays import Array, Booleans
from anser_ros.diagnosis.decisions import FEWEST_OUTLIERS
from anser_ros.field.model import EffectRecord
from anser_ros.physics.pose_track import LONGEST_GAP_S
from anser_ros.sessions.plausibility import FROZEN_S

FEWEST_STALE = 0.02
"""Share (0 to 1) of poses in motion from which repeats are named: one in 60 harms nothing."""
FEWEST_MOVING = 20  # poses of a moving body by which repeats are judged
MOVING_M = 5e-4
"""Way between two poses, m, from which a body moves: trackers resolve a tenth of it."""
FROZEN_WAY_M = 0.01
"""Way of another stream, m, while one is frozen: far more than any tracker's jitter."""
NEAR = 3  # poses before and after that motion is judged by: one wrong neighbour decides nothing
FEWEST_MISSING = 0.005  # share of poses, or of the time, from which missing ones are named
FEWEST_MARKED, FEWEST_MARKED_SHARE = 5, 1e-3
"""Markers for no pose, and their share, from which they are named: a device wrote them itself."""
LONG_GAPS = 6.0
"""Gap in median intervals that counts as missing poses: a poll is late by one or two."""
PAUSE_S, MANY_PAUSES = 2.0, 4
"""Pauses of this length, s, where there are so many, lie between recordings and are no gaps."""
FEWEST_OUTLYING_POSES = 3  # outliers that must be there at least: one or two are an accident
MOST_TIMES = 20  # times of outliers, or spans without poses, of a stream that are listed
AT_ONCE = 0.6
"""Share of the largest error of a run of poses by which it begins or ends if it does so at once:
all of it, less noise; of a smooth error the part beyond what stands out, in some steps."""
FAR = 14.0
"""Distance of the median outlier in spreads of a coordinate from which it is one: errors of real
trackers have tails of half that."""


class StalePoses(PoseEffect):
    """Reports the same pose, number for number, under a new stamp while the body moves."""

    name = 'stale_poses'
    summary = 'the same pose again under a new stamp'
    advice = 'Ask the device no more often than it measures, or leave the repeats out.'
    units = {'fraction': '1', 'runs': '1'}

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Return a record for each stream in which poses come again."""
        found = []
        for poses in residuals.session.streams.values():
            moving = _moving(poses)
            count, again = int(np.count_nonzero(moving)), poses.repeated & moving
            share = np.count_nonzero(again) / max(count, 1)
            if count < FEWEST_MOVING or share < FEWEST_STALE:
                continue
            runs = int(np.count_nonzero(np.diff(again.astype(int), prepend=0) == 1))
            values = {'stream': poses.name, 'fraction': share, 'runs': runs}
            sigma = float(np.sqrt(share / count))
            found.append(EffectRecord(self.name, values, {'fraction': sigma}))
        return found

    def frozen(self, session: PoseSession) -> Sequence[EffectRecord]:
        """Return streams that give one pose over and over while another moves."""
        streams, found = session.streams, []
        for name, poses in streams.items():
            fresh = np.flatnonzero(~poses.repeated)
            if not poses.size:
                continue
            begin, end = float(poses.time[fresh[-1]]), float(poses.time[-1])
            if end - begin < FROZEN_S:
                continue
            ways = [
                float(np.linalg.norm(np.ptp(other.position[other.time > begin], axis=0)))
                for key, other in streams.items()
                if key != name and np.count_nonzero(other.time > begin) > 1
            ]
            if max(ways, default=0.0) > FROZEN_WAY_M:
                again = poses.size - int(fresh[-1]) - 1
                values = {'stream': name, 'fraction': again / poses.size, 'runs': 1,
                          'since_s': begin}  # fmt: skip
                found.append(EffectRecord(self.name, values, {}))
        return found


class MissingPoses(PoseEffect):
    """Reports a device's marker for no pose, or no pose for much longer than usual."""

    name = 'missing_poses'
    summary = 'poses are missing, or marked as such by the device'
    advice = 'Keep sensors within the volume and markers in view.'
    units = {'fraction': '1', 'spans': 's'}

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Return a record for each stream that lacks poses."""
        found = []
        for poses in residuals.session.streams.values():
            spans = _gaps(poses, residuals.session)
            lost = poses.missing.size / max(poses.missing.size + poses.size, 1)
            length = max(float(np.ptp(poses.time)), 1e-9)
            silent = sum(b - a for a, b in spans) / length
            share = max(lost, silent)
            marked = poses.missing.size >= FEWEST_MARKED and lost > FEWEST_MARKED_SHARE
            if not marked and (share < FEWEST_MISSING or not (spans or poses.missing.size > 1)):
                continue
            found.append(EffectRecord(self.name, {
                'stream': poses.name, 'fraction': share, 'marked': int(poses.missing.size),
                'spans': [[round(a, 3), round(b, 3)] for a, b in spans[:MOST_TIMES]],
            }, {}))  # fmt: skip
        return found


class PoseOutliers(PoseEffect):
    """Reports poses that no explanation reaches, such as a marker seen in its other solution."""

    name = 'outliers'
    summary = 'poses that fit no model, such as those of a marker in its other solution'
    advice = 'Do not use these poses; show the marker from another side.'
    units = {'fraction': '1'}

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Return one record of the outlying poses of all sensors."""
        found = _leaping(residuals.session)
        # Those of an episode are off together, and errors of places come gradually.
        outs = [sudden_poses(s) & ~is_passed(s, residuals) for s in residuals.sensors]
        out = np.concatenate(outs)
        used = np.concatenate([s.used for s in residuals.sensors])
        count = int(np.count_nonzero(out))
        share = count / max(count + int(np.count_nonzero(used)), 1)
        if found or share < FEWEST_OUTLIERS or count < FEWEST_OUTLYING_POSES:
            return found
        every = list(zip(residuals.sensors, outs, strict=True))
        halves = np.concatenate([s.residual[m] for s, m in every]).reshape(-1, 2, 3)
        away = np.linalg.norm(halves, axis=2)
        noise = [[s.noise.position_m, s.noise.orientation_rad] for s in residuals.sensors]
        spreads = away / np.repeat(noise, [np.count_nonzero(m) for m in outs], axis=0)
        if float(np.median(spreads.max(axis=1))) < FAR:
            return []  # the tail of a distribution, and no poses of their own
        values = {
            'fraction': share,
            'position_m': float(np.median(away[:, 0])),
            'orientation_rad': float(np.median(away[:, 1])),
            'by_sensor': {s.view.sensor: int(m.sum()) for s, m in every},
            **_when(residuals.session, {s.view.sensor: s.view.time[m] for s, m in every}),
        }
        return [EffectRecord(self.name, values, {'fraction': float(np.sqrt(share / out.size))})]


def sudden_poses(sensing: Sensing) -> Booleans:
    """Return which poses (n,) stand out in runs of them that begin or end at once."""
    rows = np.flatnonzero(sensing.used | sensing.out)
    errors = sensing.noise.whitened(sensing.residual[rows], sensing.view.velocity[rows])
    size, step = (np.linalg.norm(e, axis=1) for e in (errors, np.diff(errors, axis=0)))
    out = sensing.out[rows]
    run = np.cumsum(np.diff(out, prepend=False))
    largest = np.zeros(run.max(initial=0) + 1)
    np.maximum.at(largest, run, np.where(out, size, 0.0))
    leaps = step > AT_ONCE * np.maximum(largest[run[1:]], largest[run[:-1]])
    sudden = np.isin(run, run[out & (np.r_[leaps, False] | np.r_[False, leaps])])
    return np.asarray(np.isin(np.arange(sensing.out.size), rows[out & sudden]))


def _leaping(session: PoseSession) -> list[EffectRecord]:
    """A record of the reference's poses that leap."""
    reference = session.reference
    if reference is None:
        return []
    away = jumping_poses(reference)
    share = float(away.mean()) if away.size else 0.0
    if share <= FEWEST_OUTLIERS or np.count_nonzero(away) < FEWEST_OUTLYING_POSES:
        return []
    values = {
        'fraction': share, 'stream': reference.name,
        **_when(session, {REFERENCE: reference.time[away]}),
    }  # fmt: skip
    sigma = float(np.sqrt(share / away.size))
    return [EffectRecord(PoseOutliers.name, values, {'fraction': sigma})]


def _moving(poses: PoseSequence) -> Booleans:
    """Where a body moves between poses, judged by those some before and after."""
    n = poses.size
    before = np.maximum(np.arange(n) - NEAR, 0)
    after = np.minimum(np.arange(n) + NEAR, n - 1)
    way = np.linalg.norm(poses.position[after] - poses.position[before], axis=1)
    apart = poses.time[after] - poses.time[before]
    near = apart < 2 * NEAR * LONGEST_GAP_S
    return np.asarray(near & (way > 2 * NEAR * MOVING_M))


def _when(session: PoseSession, times: Mapping[str, Array]) -> dict[str, object]:
    """The first times, s, of each stream's poses, and of several recordings the number of each."""
    first = {
        name: [round(float(t), 3) for t in every[:MOST_TIMES]] for name, every in times.items()
    }
    ends = _ends(session)
    numbers = {name: (1 + np.searchsorted(ends, t)).tolist() for name, t in first.items()}
    return {'times_s': first, **({'recordings': numbers} if ends.size else {})}


def _ends(session: PoseSession) -> Array:
    """Times, s, after which all streams pause, as between the recordings of two files."""
    every = np.sort(np.concatenate([np.r_[p.time, p.missing] for p in session.streams.values()]))
    return np.asarray(every[:-1][np.diff(every) > PAUSE_S])


def _gaps(poses: PoseSequence, session: PoseSession) -> list[tuple[float, float]]:
    """Spans, s, without poses; none in which all streams pause, as between two recordings."""
    steps = np.diff(poses.time)
    if steps.size < 10:
        return []
    long = max(LONGEST_GAP_S, LONG_GAPS * float(np.median(steps)))
    gaps = np.flatnonzero(steps > long)
    pauses = gaps[steps[gaps] > PAUSE_S]
    if pauses.size >= MANY_PAUSES:
        gaps = np.setdiff1d(gaps, pauses)
    ends = _ends(session)
    spans = [(float(poses.time[g]), float(poses.time[g + 1])) for g in gaps]
    return [(a, b) for a, b in spans if not np.any((ends >= a) & (ends < b))]


LEAST_S = 2e-3
"""Error of the stamps, s, from which it is named: less moves a hand by a tenth of a millimetre."""
LEAST_LIKELIHOOD_GAIN = 25.0
"""Minus twice the log likelihood that it must take off in the median sensor; chance takes one."""
STEP_SHARE = (0.15, 0.45)
"""Error over the step that rounding to a step makes: 0.29 if even, 0.41 if late by as much."""


def _stamp_error(residuals: PoseResiduals) -> tuple[float, float, float]:
    """The median error of the stamps over the sensors, its gain, and the step that makes it.

    All zero where the error is small or not clear, or fewer than half of the sensors have one. The
    step is zero where no grid of the stamps makes the error.
    """
    errors = [s.noise.stamp_s for s in residuals.sensors]
    rms = float(np.median(errors))
    gain = float(np.median([s.stamp_gain for s in residuals.sensors]))
    if np.percentile(errors, 50, method='lower') < LEAST_S or gain < LEAST_LIKELIHOOD_GAIN:
        return 0.0, 0.0, 0.0
    for sensing in residuals.sensors:
        step = stamp_step(residuals.session.sensors[sensing.view.sensor].time)
        if step and STEP_SHARE[0] * step < rms < STEP_SHARE[1] * step:
            return rms, gain, step
    return rms, gain, 0.0


def _sigma(residuals: PoseResiduals) -> float:
    """Standard deviation of the median error of the stamps, s.

    By Fisher's information about a variance, of which a pose has one degree of freedom. Sensors
    that differ by more have errors of their own; those that share stamps share the error.
    """
    sensors = residuals.sensors
    errors = np.array([s.noise.stamp_s for s in sensors])
    told = np.array([np.sum(_stamp_share(s) ** 2) for s in sensors])
    sigmas = errors / np.sqrt(2 * np.maximum(told, 1.0))
    apart = len({s.view.time.tobytes() for s in sensors})
    scatter = np.std(errors) / np.sqrt(len(sensors))
    return float(max(scatter, np.median(sigmas) / np.sqrt(apart)))


def _stamp_share(sensing: Sensing) -> Array:
    """Share (n,) of the variance along the velocity that errors of the stamps make."""
    velocity = sensing.view.velocity[sensing.used]
    scale = np.repeat([sensing.noise.position_m, sensing.noise.orientation_rad], 3)
    moved = sensing.noise.stamp_s**2 * np.sum((velocity / scale) ** 2, axis=1)
    return np.asarray(moved / (1 + moved))


class ReceiptJitter(PoseEffect):
    """Stamps are off at random: poses are off along their own velocity."""

    name = 'stamp_jitter'
    summary = 'stamps are those of receipt, and jitter'
    advice = 'Use the counter of the device (import_poses --stamps device), if it is not in use.'
    units = {'rms_s': 's'}
    needs_levers = True
    makes_jitter = True
    is_polled = False

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Look for a residual along the velocity that grows with it; a grid may make it."""
        rms, gain, step = _stamp_error(residuals)
        if not rms or bool(step) != self.is_polled:
            return []
        values: dict[str, object] = {'rms_s': rms}
        if step:
            values, sigma = {'step_s': step, **values}, {'step_s': 0.01 * step}
        else:
            values['by_sensor'] = {s.view.sensor: s.noise.stamp_s for s in residuals.sensors}
            sigma = {'rms_s': _sigma(residuals)}
        return [EffectRecord(self.name, values, sigma, {'likelihood_gain': gain})]


class QuantisedStamps(ReceiptJitter):
    """Stamps lie on the grid of a poll, and poses are off along their velocity by as much."""

    name = 'quantised_stamps'
    summary = 'stamps are those of a poll'
    advice = 'Use the counter of the device as stamp, if it is not in use, or poll more often.'
    units = {'step_s': 's'}
    is_polled = True


NOISIER = 2.0
"""Factor over other sensors' median noise to be named; those of one kind differ by a half."""
SURE = 2.0  # sigmas within which an exponent may be what makes a farther sensor noisier
SMALLEST_STEP_M = 1e-8  # by which positions differ that are the same: their rounding
GROWN = 2.0
"""Factor over a first look's jitter to be reported: over a tracker's volume it grows by half."""
WIDEST = 1.3
"""Ratio of far to near distances (95 to 5 %) without which no power law of it can be seen."""
LEAST_LAW_SIGMAS = 5.0
"""Sigmas by which the noise must differ from a constant, by likelihood and by its exponent."""
EXPONENTS = (2.8, 6.5)
"""Exponents of a field's noise: the signal falls with the third power, its gradient the fourth."""
SHARES = np.array([1, 4, 1]) / 6
"""Shares of the variances of three poses in that of their second difference."""
NEW_SHARE = 18 / 35
"""Share of squared second differences that is new: neighbours share values. Their correlations are
-2/3 and 1/6, those of squares 4/9 and 1/36, on both sides."""
REACHED = 12.0
"""Squared deviation over its variance by the law that noise does not reach: once in 1e5."""
AT_REST_M_S, HARDLY_EVER = 0.01, 0.1
"""Speed, m/s, below which a body counts as at rest (a hand drifts by less), and share of poses in
motion below which it always is."""
FEWEST_DIFFERENCES = 60  # differences of neighbours that a power law is fitted to


def power_law(square: Array, distance: Array) -> tuple[float, float, float]:
    """Return the exponent of the noise by distance, its sigma, and the likelihood's gain.

    Square (n,) and distances (n, 3) are as of `jitter`. A squared deviation across the velocity
    has two degrees of freedom, so it is distributed exponentially about the variance, which is
    that of the three poses with their shares of a second difference.
    """
    place = np.log(distance / np.median(distance))
    near = REACHED * np.median(square) * np.exp(8 * np.maximum(place[:, 1], 0))
    first = _likeliest(np.minimum(square, near), place)
    reached = square < REACHED * _variance(first, place)
    square, place = square[reached], place[reached]
    best = _likeliest(square, place)
    least, step = _cost(best, square, place), 0.2

    def beside(exponent: float) -> float:
        """Least cost with the exponent held: level and floor go with it."""
        found = minimize(
            lambda v: _cost(np.array([exponent, *v]), square, place), best[1:],
            method='Nelder-Mead',
        )  # fmt: skip
        return float(found.fun)

    sides = [beside(float(best[0]) + way * step) for way in (-1, 1)]
    curvature = max((sum(sides) - 2 * least) / step**2, 1e-9) * NEW_SHARE
    plain = square.size * float(np.log(np.mean(square)) + 1)
    return float(best[0]), float(1 / np.sqrt(curvature)), 2 * NEW_SHARE * (plain - least)


def _variance(law: Array, place: Array) -> Array:
    """Variance (n,) of second differences by a law's exponent, level and floor.

    ``place`` (n, 3) is the logarithm of the distances; level and floor are logarithms too.
    """
    exponent, level, floor = law
    grown = np.exp(np.clip(level + 2 * exponent * place, -60, 60)) @ SHARES
    return np.asarray(grown + np.exp(np.clip(floor, -60, 60)))


def _cost(law: Array, square: Array, place: Array) -> float:
    """Minus the log likelihood of squared deviations (n,), which are distributed exponentially."""
    variance = _variance(law, place)
    return float(np.sum(np.log(variance) + square / variance))


def _likeliest(square: Array, place: Array) -> Array:
    """The law (exponent, level, floor) that is likeliest."""
    level = float(np.log(np.mean(square)))
    tries = [
        minimize(_cost, [n, level, level - 2], args=(square, place), method='Nelder-Mead')
        for n in (3.0, 5.0)
    ]
    return np.asarray(min(tries, key=lambda result: float(result.fun)).x)


def _jitter(sensing: Sensing, chosen: Booleans) -> tuple[Array, Array]:
    """`jitter` of those of some poses (n,) in which the body moves; of all where it hardly does.

    A body that rests at one place and moves at others jitters less at the one.
    """
    moving = chosen & (np.linalg.norm(sensing.view.velocity[:, :3], axis=1) > AT_REST_M_S)
    hardly = np.count_nonzero(moving) < HARDLY_EVER * np.count_nonzero(chosen)
    return jitter(sensing, chosen if hardly else moving, sensing.noise.stamp_s > 0)


class PoseExcessNoise(PoseEffect):
    """One sensor's noise is a multiple of the others'."""

    name = 'excess_noise'
    summary = "a sensor's noise is larger than the others'"
    advice = 'Record again with sensors at equal distances: its place and rounding may make it.'
    units = {'factor': '1'}
    makes_jitter = True

    def more_jitter(self, factor: float) -> Sequence[EffectRecord]:
        """Return a record without a sensor: all of them jitter more."""
        if factor < GROWN:
            return ()
        return [EffectRecord(self.name, {'factor': factor}, {'factor': 0.1 * factor})]

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Return each sensor that is noisier than the median of the others.

        Not where its distance, or the step on which positions lie, may make it so.
        """
        exponent, sigma, _, is_clear = _law(residuals)
        possible = np.clip([exponent - SURE * sigma, exponent + SURE * sigma], 0.0, EXPONENTS[1])
        noise, exponent = {}, exponent if is_clear else 0.0
        for sensing in residuals.sensors:
            square, distance = _jitter(sensing, sensing.used & ~in_episode(sensing, residuals))
            if square.size >= FEWEST_DIFFERENCES:
                steps = np.diff(np.sort(sensing.view.measured, axis=0), axis=0)
                step = np.min(steps[steps > SMALLEST_STEP_M], initial=1.0) / np.sqrt(12)
                far = float(np.median(distance))
                size = np.sqrt(np.median(square / (distance[:, 1] / far) ** (2 * exponent)))
                noise[sensing.view.sensor] = max(float(size), step), far
        found = []
        for name, (size, far) in noise.items():
            others = np.array([pair for other, pair in noise.items() if other != name])
            if not others.size:
                continue
            usual, middle = np.median(others, axis=0)
            factor = float(size / usual / (far / middle) ** exponent)
            if factor > NOISIER * np.max((far / middle) ** (possible - exponent), initial=1.0):
                values = {'sensor': name, 'factor': factor}
                found.append(EffectRecord(self.name, values, {'factor': 0.1 * factor}))
        return found


def _law(residuals: PoseResiduals) -> tuple[float, float, float, bool]:
    """Exponent of a power law of all sensors together, each with a level of its own; its sigma,
    infinite where nothing tells it; their median distance, m; and whether it is clear.
    """
    # Far poses stand out from one common noise; those of an episode have another cause.
    every = [
        _jitter(one, (one.used | one.out) & ~in_episode(one, residuals))
        for one in residuals.sensors
    ]
    pairs = [pair for pair in every if pair[0].size >= FEWEST_DIFFERENCES]
    if not pairs:
        return 0.0, np.inf, 1.0, False
    middle = float(np.median(np.concatenate([distance for _, distance in pairs])))
    square = np.concatenate([one / np.median(one) for one, _ in pairs])
    distance = np.concatenate([one / np.median(one) for _, one in pairs])
    low, high = np.percentile(distance, [5, 95])
    if high < WIDEST * low:
        return 0.0, np.inf, middle, False
    exponent, sigma, gain = power_law(square, distance)
    is_clear = gain > LEAST_LAW_SIGMAS**2 and exponent > LEAST_LAW_SIGMAS * sigma
    return exponent, sigma, middle, is_clear and EXPONENTS[0] <= exponent <= EXPONENTS[1]


class RangeNoise(PoseEffect):
    """Jitter grows as a power of the distance from the field generator."""

    name = 'range_noise'
    summary = 'jitter grows with the distance from the field generator'
    advice = 'Compare it with the data sheet; nearer to the field generator it is less.'
    units = {'exponent': '1', 'reference_m': 'm'}
    makes_jitter = True

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Return the law of all sensors together."""
        exponent, sigma, middle, is_clear = _law(residuals)
        values = {'exponent': exponent, 'reference_m': middle}
        return [EffectRecord(self.name, values, {'exponent': sigma})] if is_clear else []


EFFECTS = (
    StalePoses(),
    MissingPoses(),
    PoseOutliers(),
    ReceiptJitter(),
    QuantisedStamps(),
    PoseExcessNoise(),
    RangeNoise(),
)
