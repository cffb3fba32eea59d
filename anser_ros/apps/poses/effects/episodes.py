"""Something comes and goes, or shifts, in a session: metal that moves, a mount that is loose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from anser_ros.apps.poses.effect import PoseEffect
from anser_ros.apps.poses.problem import PoseResiduals, Sensing
from anser_ros.field.model import EffectRecord

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

WINDOWS, FEWEST_WINDOWS = 40, 15
"""Windows of time that a session is cut into: an episode of a twentieth is seen in two. A slow
tracker has fewer; of fewer yet an episode is too large a part."""
FEWEST_POSES_OF_WINDOW = 4  # poses that a window needs to be judged: fewer may be outliers
POSES_OF_WINDOW = 4.5  # on average, so that most windows can be judged
TIMES = 9.0
"""Squared error over the median window's from which a window belongs to an episode: three times
the error, which the range of places in a session hardly makes."""
LOUD = 3.0
"""The same of a window in which a sensor leaves the others on its body by `TIMES`: stamps that
jitter make every window loud."""
LONGEST = 0.4
"""Share (0 to 1) of the windows that episodes may be: the median window must be a quiet one, and a
tenth is left for what else is loud."""
ALIKE = 0.4  # share of a window's squared error that its mean must be; noise has a small one
NEAR_M = 0.03
"""Distance within which a place outside the episode is the same place: metal changes over its own
size, centimetres."""
REVISITED_SHARE = 0.5  # share of the episode's places that must have been visited outside it
STRETCH, FILLED = 0.15, 0.8
"""Share of the windows that an episode of one sensor alone must span where its places were visited
at no other time, and the share of these that are in it: no hand stays so long in a distortion."""
LOOSE, FAST = 0.5, 0.25
"""Share of a sensor's squared error that shifts in the body's frame explain if its mount is loose,
and up to which the others' must be lower."""


def window_count(residuals: PoseResiduals) -> int:
    """Return how many windows a session is cut into, by the poses of its median sensor."""
    poses = np.median([np.count_nonzero(s.used | s.out) for s in residuals.sensors])
    return int(np.clip(poses // POSES_OF_WINDOW, FEWEST_WINDOWS, WINDOWS))


def windows_of(sensing: Sensing, residuals: PoseResiduals) -> NDArray[np.int64]:
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


def episode(sensing: Sensing, residuals: PoseResiduals) -> Episode:
    """Return when a sensor is off that was right at other times at the same places.

    Where it was there at no other time, the body shows it: all others on it are right meanwhile.
    """
    window = windows_of(sensing, residuals)
    square = np.sum(sensing.residual[:, :3] ** 2, axis=1)
    count = window_count(residuals)
    judged = [w for w in range(count) if np.count_nonzero(window == w) >= FEWEST_POSES_OF_WINDOW]
    if len(judged) < count // 3:
        return Episode()
    size = {w: float(np.median(square[window == w])) for w in judged}
    high = {w for w in _loud(size) if _is_shift(sensing, window == w)}
    runs = [w for w in judged if w in high and (w - 1 in high or w + 1 in high)]
    if runs and len(runs) <= LONGEST * len(judged):
        inside = np.isin(window, runs)
        outside = (window >= 0) & ~inside & (square < TIMES * np.median(list(size.values())))
        place = sensing.view.measured
        is_alone = _is_alone(sensing, residuals, runs)
        if is_alone or (outside.any() and _is_revisited(place[inside], place[outside])):
            return Episode(tuple(runs), is_alone)
    return _by_the_body(sensing, residuals, size)


def in_episode(sensing: Sensing, residuals: PoseResiduals) -> Mask:
    """Return the mask (n,) of a sensor's poses that are in one of its episodes."""
    inside = episode(sensing, residuals).windows
    return np.asarray(np.isin(windows_of(sensing, residuals), inside))


def _loud(size: Mapping[int, float]) -> list[int]:
    """The windows whose squared error is so many times that of the median window."""
    usual = float(np.median(list(size.values())))
    return [w for w, square in size.items() if square > TIMES * usual]


def _is_revisited(inside: Array, outside: Array) -> bool:
    """Whether most places (n, 3) of an episode are near some (m, 3) outside it."""
    distance, _ = cKDTree(outside).query(inside)
    return bool(np.mean(distance < NEAR_M) > REVISITED_SHARE)


def _by_the_body(sensing: Sensing, residuals: PoseResiduals, size: Mapping[int, float]) -> Episode:
    """When a sensor leaves the others on its body, whose clock and reference are the same.

    What all of them share, errors of the stamps before all, is in no difference of two.
    """
    own = _middles(sensing, residuals)
    others = [_middles(one, residuals) for one in residuals.sensors if one is not sensing]
    usual = float(np.median(list(size.values())))
    apart = {
        w: float(np.sum((own[w] - np.median([one[w] for one in others], axis=0)) ** 2))
        for w in size
        if others and all(w in one for one in others)
    }
    if not apart:
        return Episode()
    high = [w for w in _loud(apart) if size[w] > LOUD * usual]
    runs = [w for w in high if w - 1 in high or w + 1 in high]
    is_alone = 0 < len(runs) <= LONGEST * len(apart) and _is_alone(sensing, residuals, runs)
    return Episode(tuple(runs), True) if is_alone else Episode()


def _middles(sensing: Sensing, residuals: PoseResiduals) -> dict[int, Array]:
    """The median residual (3,), m, of each window that can be judged."""
    window = windows_of(sensing, residuals)
    return {
        int(w): np.median(sensing.residual[window == w, :3], axis=0)
        for w in np.unique(window[window >= 0])
        if np.count_nonzero(window == w) >= FEWEST_POSES_OF_WINDOW
    }


def _is_alone(sensing: Sensing, residuals: PoseResiduals, runs: list[int]) -> bool:
    """Whether a sensor is off for a long stretch in which the others on its body are right."""
    span = runs[-1] - runs[0] + 1
    if span < round(STRETCH * window_count(residuals)) or len(runs) < FILLED * span:
        return False

    def error(one: Sensing) -> float:
        middles = [v for w, v in _middles(one, residuals).items() if w in runs]
        return float(np.median(np.sum(np.square(middles), axis=1))) if middles else np.inf

    others = [error(one) for one in residuals.sensors if one is not sensing]
    return bool(others) and max(others) < FAST * error(sensing)


def _is_shift(sensing: Sensing, inside: Mask) -> bool:
    """Whether poses are off the same way, as metal makes them, and not at random."""
    residual = sensing.residual[inside, :3]
    mean = residual.mean(axis=0)
    return bool(mean @ mean > ALIKE * np.mean(np.sum(residual**2, axis=1)))


class PoseMovingMetal(PoseEffect):
    """Metal comes near and goes again: sensors are off for a while where all was well before."""

    name = 'moving_metal'
    summary = 'metal comes near for a while'
    advice = 'See what was near these sensors at that time, and do not use their poses of it.'
    units = {'t_start_s': 's', 't_end_s': 's'}
    needs_levers = True

    def observed(self, residuals: PoseResiduals) -> Sequence[EffectRecord]:
        """Return a record of the sensors that are off at one time, for each such time."""
        found = {s.view.sensor: episode(s, residuals) for s in residuals.sensors}
        alone = {w for one in found.values() if one.is_alone for w in one.windows}
        groups: list[tuple[int, int, list[str]]] = []
        for name, one in found.items():
            # A sensor that is off pulls the frames, and with them the others, a little way.
            windows = one.windows if one.is_alone else _apart(one.windows, alone)
            if not windows:
                continue
            group = windows[0], windows[-1], [name]
            for other in [g for g in groups if g[0] <= group[1] and group[0] <= g[1]]:
                groups.remove(other)
                ends = min(other[0], group[0]), max(other[1], group[1])
                group = *ends, other[2] + group[2]
            groups.append(group)
        start = residuals.setting.start
        length = residuals.setting.duration / window_count(residuals)
        return [
            EffectRecord(
                self.name,
                {'t_start_s': start + first * length, 't_end_s': start + (last + 1) * length,
                 'sensors': names},
                {'t_start_s': length, 't_end_s': length},
            )
            for first, last, names in sorted(groups)
        ]  # fmt: skip


def _apart(windows: Sequence[int], others: set[int]) -> list[int]:
    """The stretches of windows that have none in common with others."""
    stretches = np.split(np.array(windows), np.flatnonzero(np.diff(windows) > 1) + 1)
    return [
        int(w) for stretch in stretches if others.isdisjoint(stretch.tolist()) for w in stretch
    ]


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
            if not is_alone or episode(sensing, residuals).windows:
                continue
            values = {'sensor': name, 'rms_m': place, 'rms_deg': float(np.rad2deg(turn))}
            found.append(EffectRecord(self.name, values, {'rms_m': 0.15 * place}))
        return found


def _shifts(sensing: Sensing, residuals: PoseResiduals) -> tuple[float, float, float]:
    """Share of squared error that windows' means in the body's frame explain; rms, m, rad."""
    window = windows_of(sensing, residuals)
    back = (sensing.view.frame @ sensing.view.turn).transpose(0, 2, 1)
    body = np.concatenate(
        [np.einsum('nij,nj->ni', back, sensing.residual[:, k : k + 3]) for k in (0, 3)], axis=1
    )
    explained, total, count, means = 0.0, 0.0, 0, []
    for number in np.unique(window[window >= 0]):
        rows = body[(window == number) & sensing.used]
        if len(rows) < FEWEST_POSES_OF_WINDOW:
            continue
        mean = rows.mean(axis=0)
        means.append(mean)
        explained += len(rows) * float(np.sum(mean[:3] ** 2))
        total += float(np.sum(rows[:, :3] ** 2))
        count += len(rows)
    if count < window_count(residuals):
        return 0.0, 0.0, 0.0
    values = np.array(means)
    share = explained / max(total, 1e-18) - len(means) / count
    place, turn = (
        float(np.sqrt(np.mean(np.sum(values[:, k : k + 3] ** 2, axis=1)))) for k in (0, 3)
    )
    return share, place, turn


EFFECTS = (PoseMovingMetal(), LooseMount())
