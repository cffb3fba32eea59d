"""Something comes and goes, or shifts, in a session: metal that moves, a mount that is loose."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from anser_ros.apps.poses.effect import PoseEffect
from anser_ros.apps.poses.problem import PoseResiduals, Sensing
from anser_ros.arrays import Array, Booleans, Integers
from anser_ros.field.model import EffectRecord

WINDOWS, FEWEST_WINDOWS, WINDOW_S = 40, 15, 1.0
"""Windows of time of a session, and fewest of a slow tracker: an episode of a twentieth is seen in
two. A long session has more, of a second, which a hand takes to pass a thing."""
FEWEST_POSES_OF_WINDOW = 4  # poses that a window needs to be judged: fewer may be outliers
POSES_OF_WINDOW = 4.5  # on average, so that most windows can be judged
TIMES = 9.0
"""Squared error of an episode over the median window's: the range of places hardly makes it."""
OWN = np.array([2e-3, 0.026])
"""Error of means, m and rad, that a tracker has: data sheets say 0.5 to 1.4 mm, 0.5 deg rms."""
LONGEST = 0.4
"""Share (0 to 1) of the windows that episodes may be: the median window must be a quiet one."""
ALIKE = 0.4  # share of a window's squared error that its mean must be; noise has a small one
NEAR_M = 0.03
"""Distance, m, of places that are the same: metal changes over its own size, centimetres."""
REVISITED_SHARE = 0.5  # share of the episode's places that must have been visited outside it
STRETCH, FILLED = 0.15, 0.8
"""Share of the windows that an episode of one sensor alone must span where its places were visited
at no other time, and the share of these that are in it: no hand stays so long in a distortion."""
FEWEST_VISITS, ALWAYS, SELDOM, FARTHER = 2, 0.6, 0.1, 90
"""Visits to a place that makes the episodes; shares of these there, and of the poses there that
are off; share of those elsewhere that may be; percentile of the right poses' distances that it
must be nearer than: the edge of the volume errs without metal."""
NEIGHBOURS = 3  # windows by which those of one episode are apart at most
PASSED = 'metal stands at one place, and the sensors are off whenever they pass it'
STANDING = np.array([2e-3, 0.0175])
"""Errors, m and rad, that neighbours share, beyond which metal bends all of the space: data sheets
say 0.5 to 1.4 mm and 0.5 deg, of which this is twice; maps of a tracker's own hardly turn."""
EACH = 0.25  # share of the mean squared turn that each sensor must have: a mount turns one alone
NEAR_STEPS = 3.0  # usual intervals by which neighbours in time are apart at most
BENDS = 'metal stands in the volume, and turns the sensors from place to place'
LOOSE, FAST = 0.5, 0.25
"""Share of a sensor's squared error that shifts in the body's frame explain if its mount is loose,
and up to which the others' must be lower."""


def window_count(residuals: PoseResiduals) -> int:
    """Return how many windows a session is cut into, by the poses of its median sensor."""
    poses = np.median([np.count_nonzero(s.used | s.out) for s in residuals.sensors])
    most = max(WINDOWS, int(residuals.setting.duration / WINDOW_S))
    return int(np.clip(poses // POSES_OF_WINDOW, FEWEST_WINDOWS, most))


def windows_of(sensing: Sensing, residuals: PoseResiduals) -> Integers:
    """Return the window of each pose of a sensor that counts; -1 for the others."""
    share = (sensing.view.time - residuals.setting.start) / max(residuals.setting.duration, 1e-9)
    count = window_count(residuals)
    window = np.clip((count * share).astype(np.int64), 0, count - 1)
    return np.where(sensing.used | sensing.out, window, -1)


@dataclass(frozen=True)
class Episode:
    """Holds when a sensor is off."""

    windows: tuple[int, ...] = ()  # of time; none where it never is
    is_alone: bool = False  # whether the others on its body are right meanwhile
    place: Array | None = None  # (3,), where it is off whenever it passes, m; None where it moved


def _sizes(
    sensing: Sensing, residuals: PoseResiduals, is_beside: bool
) -> tuple[Array, dict[int, Array]]:
    """Squared errors of places and of turns over those of the median window: of poses (n, 2), and
    of the means of windows (3,), in which jitter cancels; last these over `OWN`, the larger.

    Errors count from the middle of the windows, as frames go a little way with an episode; or
    beside the other sensors, which have the same clock and reference.
    """
    window, errors = windows_of(sensing, residuals), sensing.residual
    plain = middles = _middles(sensing, residuals)
    if is_beside:
        others = [_middles(one, residuals) for one in residuals.sensors if one is not sensing]
        plain = middles = {
            w: middle - np.median([one[w] for one in others], axis=0)
            for w, middle in middles.items()
            if others and all(w in one for one in others)
        }
    else:  # without what errors of the stamps make
        errors = sensing.noise.whitened(errors, sensing.view.velocity)
        middles = _middles(sensing, residuals, errors)
    if not middles:
        return np.zeros((window.size, 2)), {}
    off, means = (
        _halves(np.array(list(m.values())) - np.median(list(m.values()), axis=0))
        for m in (plain, middles)
    )
    square = _halves(errors - np.median(list(middles.values()), axis=0))
    usual = np.median([np.median(square[window == w], axis=0) for w in middles], axis=0)
    means /= np.maximum(np.median(means, axis=0), 1e-18)
    means = np.column_stack([means, np.max(off / OWN**2, axis=1)])
    return square / np.maximum(usual, 1e-18), dict(zip(middles, means, strict=True))


def _halves(errors: Array) -> Array:
    """Squares of errors (n, 6) of places and of turns, (n, 2)."""
    return np.asarray(np.sum(errors.reshape(-1, 2, 3) ** 2, axis=2))


@lru_cache(maxsize=8)  # of the sensors of a session, for each effect that is observed
def episode(sensing: Sensing, residuals: PoseResiduals) -> Episode:
    """Return when a sensor is off that was right at other times at the same places.

    Where it was there at no other time, the body shows it, if all others on it are right
    meanwhile; or the place does, if the sensor is off in the same way whenever it comes back.
    """
    own = _episode(sensing, residuals, False)
    return own if own.windows else _episode(sensing, residuals, True)


def _episode(sensing: Sensing, residuals: PoseResiduals, is_beside: bool) -> Episode:
    window, count = windows_of(sensing, residuals), window_count(residuals)
    poses, sizes = _sizes(sensing, residuals, is_beside)
    is_off, place = poses.max(axis=1) > TIMES, sensing.view.measured
    loud = [w for w, size in sizes.items() if size[:2].max() > TIMES]
    shifted = [w for w in loud if is_beside or _is_shift(sensing, window == w)]
    large = [s for s in _stretches(shifted) if np.mean([sizes[w][2] for w in s]) > 1]
    high = [w for stretch in large for w in stretch]
    if len(sizes) < count // 3 or len(high) > LONGEST * len(sizes):
        return Episode()
    passed = _place_of(sensing, window, high, is_off)
    if passed is not None and not is_beside:
        return Episode(tuple(high), place=passed)
    runs = [w for w in high if w - 1 in high or w + 1 in high]
    if not runs:
        return Episode()
    inside = np.isin(window, runs)
    is_alone = _is_alone(sensing, residuals, runs)
    if is_alone or is_beside:
        return Episode(tuple(runs), True) if is_alone else Episode()
    if not any(sizes[w][0] > TIMES for w in runs):
        # Turns err with orientation as well as place, but not for so long.
        is_other = _lasts(runs, count) and _spread(place[inside]) > 0.5 * _spread(place)
    else:
        outside = (window >= 0) & ~inside & ~is_off
        # A slow tracker comes near no place again.
        near = _nearest_later(place[inside], window[inside]) if _lasts(runs, count) else NEAR_M
        distance, _ = cKDTree(place[outside]).query(place[inside])
        is_other = bool(np.mean(distance < near) > REVISITED_SHARE)
    return Episode(tuple(runs)) if is_other else Episode()


def _spread(place: Array) -> float:
    """Mean distance, m, of places (n, 3) from their middle."""
    return float(np.mean(np.linalg.norm(place - place.mean(axis=0), axis=1)))


def _lasts(runs: Sequence[int], count: int) -> bool:
    """Whether windows are a long stretch of all with hardly a break."""
    span = runs[-1] - runs[0] + 1
    return span >= round(STRETCH * count) and len(runs) >= FILLED * span


def _place_of(
    sensing: Sensing, window: Integers, high: Sequence[int], is_off: Booleans
) -> Array | None:
    """The place (3,), m, of what a sensor passes, and is off whenever it does; None for none.

    It is passed twice at least, and poses farther from the field generator are right.
    """
    place, judged = sensing.view.measured, window >= 0
    means = [place[np.isin(window, visit)].mean(axis=0) for visit in _stretches(high)]
    if len(means) < FEWEST_VISITS:
        return None
    middle = np.asarray(np.median(means, axis=0))
    away = np.linalg.norm(place - middle, axis=1)
    near = [mean for mean in means if np.linalg.norm(mean - middle) < NEAR_M]
    is_there = len(near) >= max(FEWEST_VISITS, ALWAYS * len(means))
    there, elsewhere = judged & (away < NEAR_M), judged & (away > 2 * NEAR_M)
    right = np.linalg.norm(place[judged & ~is_off], axis=1)
    if not (is_there and there.any() and elsewhere.any() and right.size):
        return None
    is_off_there = np.mean(is_off[there]) > ALWAYS
    is_right_elsewhere = np.mean(is_off[elsewhere]) < SELDOM
    is_inside = np.linalg.norm(middle) < np.percentile(right, FARTHER)
    return middle if is_off_there and is_right_elsewhere and is_inside else None


def in_episode(sensing: Sensing, residuals: PoseResiduals) -> Booleans:
    """Return the mask (n,) of a sensor's poses that are in one of its episodes."""
    inside = episode(sensing, residuals).windows
    return np.asarray(np.isin(windows_of(sensing, residuals), inside))


def is_passed(sensing: Sensing, residuals: PoseResiduals) -> Booleans:
    """Return the mask (n,) of a sensor's poses while any sensor on its body is in an episode.

    What one sensor passes is near the others.
    """
    windows = {w for one in residuals.sensors for w in episode(one, residuals).windows}
    return np.asarray(np.isin(windows_of(sensing, residuals), list(windows)))


def _nearest_later(place: Array, window: Integers) -> Array:
    """Distance (n,), m, of places (n, 3) from the nearest at another time; `NEAR_M` at least."""
    out = np.full(len(place), NEAR_M)
    for number in np.unique(window):
        here, later = window == number, place[np.abs(window - number) > NEIGHBOURS]
        if len(later):
            out[here] = np.maximum(cKDTree(later).query(place[here])[0], NEAR_M)
    return out


def _middles(
    sensing: Sensing, residuals: PoseResiduals, errors: Array | None = None
) -> dict[int, Array]:
    """The median of errors (n, 6), or of the residual, in each window that can be judged."""
    errors = sensing.residual if errors is None else errors
    window = windows_of(sensing, residuals)
    return {
        int(w): np.median(errors[window == w], axis=0)
        for w in np.unique(window[window >= 0])
        if np.count_nonzero(window == w) >= FEWEST_POSES_OF_WINDOW
    }


def _is_alone(sensing: Sensing, residuals: PoseResiduals, runs: list[int]) -> bool:
    """Whether a sensor is off for a long stretch in which the others on its body are right."""
    if not _lasts(runs, window_count(residuals)):
        return False

    def error(one: Sensing) -> float:
        middles = [v[:3] for w, v in _middles(one, residuals).items() if w in runs]
        return float(np.median(np.sum(np.square(middles), axis=1))) if middles else np.inf

    others = [error(one) for one in residuals.sensors if one is not sensing]
    return bool(others) and max(others) < FAST * error(sensing)


def _is_shift(sensing: Sensing, inside: Booleans) -> bool:
    """Whether poses are off or turned the same way, as metal makes them, and not at random."""
    errors = sensing.residual[inside]
    return bool(np.any(_halves(errors.mean(axis=0)) > ALIKE * _halves(errors).mean(axis=0)))


class PoseMovingMetal(PoseEffect):
    """Metal comes near and goes again: sensors are off for a while where all was well before."""

    name = 'moving_metal'
    summary = 'metal comes near for a while'
    advice = 'See what was near these sensors at that time or place; do not use their poses of it.'
    units = {'t_start_s': 's', 't_end_s': 's'}
    needs_levers = True

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Return a record of the sensors that are off at one time, for each such time."""
        found = {s.view.sensor: episode(s, residuals) for s in residuals.sensors}
        alone = {w for one in found.values() if one.is_alone for w in one.windows}
        groups: list[tuple[int, int, list[str]]] = []
        for name, one in found.items():
            # A sensor that is off pulls the frames, and with them the others, a little way.
            stretches = [s for s in _stretches(one.windows) if one.is_alone or not alone & set(s)]
            for windows in stretches:
                group = windows[0], windows[-1], [name]
                for other in [g for g in groups if g[0] <= group[1] and group[0] <= g[1]]:
                    groups.remove(other)
                    ends = min(other[0], group[0]), max(other[1], group[1])
                    group = *ends, list(dict.fromkeys(other[2] + group[2]))
                groups.append(group)
        start = residuals.setting.start
        length = residuals.setting.duration / window_count(residuals)
        records = []
        for first, last, names in sorted(groups):
            places = [p.tolist() for n in names if (p := found[n].place) is not None]
            records.append(EffectRecord(
                self.name,
                {'t_start_s': start + first * length, 't_end_s': start + (last + 1) * length,
                 'sensors': names, **({'place_m': places[0]} if places else {})},
                {'t_start_s': length, 't_end_s': length},
                {'summary': PASSED} if places else {},
            ))  # fmt: skip
        return records or _standing(residuals)


def _standing(residuals: PoseResiduals) -> list[EffectRecord]:
    """Metal that stands in the volume: it moves and turns all sensors, alike at near poses."""
    squares, turns, places = [], [], []
    for sensing in residuals.sensors:
        rows, view = np.flatnonzero(sensing.used), sensing.view
        step = np.diff(view.time[rows])
        near = np.flatnonzero(step <= NEAR_STEPS * np.median(step)) if step.size else step
        if len(near) < FEWEST_POSES_OF_WINDOW:
            return []
        errors = np.hstack([view.measured - view.position, sensing.residual[:, 3:]])[rows]
        # What goes along the turning is an error of times.
        spin = view.velocity[rows, 3:]
        spin = spin / np.maximum(np.linalg.norm(spin, axis=1, keepdims=True), 1e-9)
        errors[:, 3:] -= np.sum(errors[:, 3:] * spin, axis=1, keepdims=True) * spin
        common = np.sum((errors[near] * errors[near + 1]).reshape(-1, 2, 3), axis=2)
        squares.append(common.mean(axis=0))
        turns.append(common[:, 1].max())
        places.append(view.measured[rows[near[np.argmax(common[:, 1])]]].tolist())
    mean = np.mean(squares, axis=0)
    if (mean < STANDING**2).any() or min(squares, key=lambda s: s[1])[1] < EACH * mean[1]:
        return []
    start, names = residuals.setting.start, [s.view.sensor for s in residuals.sensors]
    values = {'t_start_s': start, 't_end_s': start + residuals.setting.duration,
              'sensors': names, 'place_m': places[int(np.argmax(turns))]}  # fmt: skip
    return [EffectRecord(PoseMovingMetal.name, values, {}, {'summary': BENDS})]


def _stretches(windows: Sequence[int]) -> list[list[int]]:
    """Windows, ascending, in groups of neighbours: the ends of an episode fluctuate."""
    groups: list[list[int]] = []
    for w in windows:
        if groups and w - groups[-1][-1] <= NEIGHBOURS:
            groups[-1].append(w)
        else:
            groups.append([w])
    return groups


class LooseMount(PoseEffect):
    """A sensor shifts on its body: it is off by the same in the body's frame for a while."""

    name = 'loose_mount'
    summary = 'a sensor moves against the body and the other sensors'
    advice = 'Fasten the sensor on its body, and record again.'
    units = {'rms_m': 'm', 'rms_deg': 'deg'}
    needs_levers = True

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Return the sensor whose shifts are its own; a single sensor's could be anything else."""
        if len(residuals.sensors) < 2:
            return []
        shifts = {s.view.sensor: _shifts(s, residuals) for s in residuals.sensors}
        found = []
        for sensing in residuals.sensors:
            name = sensing.view.sensor
            share, place, turn = shifts[name]
            others = [shifts[other][0] * shifts[other][1] for other in shifts if other != name]
            is_alone = share >= LOOSE and max(others) <= FAST * share * place
            passes = episode(sensing, residuals).windows
            if not is_alone or passes or _follows_place(sensing, residuals):
                continue
            values = {'sensor': name, 'rms_m': place, 'rms_deg': float(np.rad2deg(turn))}
            found.append(EffectRecord(self.name, values, {'rms_m': 0.15 * place}))
        return found


def _follows_place(sensing: Sensing, residuals: PoseResiduals) -> bool:
    """Whether errors come again at the same place at other times, as no mount's do."""
    window, used = windows_of(sensing, residuals)[sensing.used], sensing.used
    pairs = cKDTree(sensing.view.measured[used]).query_pairs(NEAR_M, output_type='ndarray')
    pairs = pairs[np.abs(np.subtract(*window[pairs].T)) > NEIGHBOURS]
    one, other = (sensing.residual[used, :3][pairs[:, k]] for k in (0, 1))
    return bool(np.sum(one * other) > LOOSE * 0.5 * np.sum(one**2 + other**2)) and len(pairs) > 0


def _shifts(sensing: Sensing, residuals: PoseResiduals) -> tuple[float, float, float]:
    """Share of squared error that windows' means in the body's frame explain; rms, m, rad.

    Without the windows in which something is near a sensor.
    """
    window = windows_of(sensing, residuals)
    back = (sensing.view.frame @ sensing.view.turn).transpose(0, 2, 1)
    body = np.einsum('nij,nkj->nki', back, sensing.residual.reshape(-1, 2, 3)).reshape(-1, 6)
    numbers = np.unique(window[(window >= 0) & ~is_passed(sensing, residuals)])
    groups = [body[(window == number) & sensing.used] for number in numbers]
    groups = [rows for rows in groups if len(rows) >= FEWEST_POSES_OF_WINDOW]
    sizes = np.array([len(rows) for rows in groups])
    if sizes.sum() < window_count(residuals):
        return 0.0, 0.0, 0.0
    means = _halves(np.array([rows.mean(axis=0) for rows in groups]))
    total = float(np.sum(np.concatenate(groups)[:, :3] ** 2))
    share = float(sizes @ means[:, 0]) / max(total, 1e-18) - sizes.size / int(sizes.sum())
    place, turn = np.sqrt(means.mean(axis=0)).tolist()
    return share, place, turn


EFFECTS = (PoseMovingMetal(), LooseMount())
