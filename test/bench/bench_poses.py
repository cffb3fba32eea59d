"""Diagnosis of simulated trackers of poses: which of their errors are named, and how honestly.

    python test/bench/bench_poses.py [--seeds 301,302] [--kinds late,bent] [--pairs 6]
        [--repeats 30 --repeat-seeds 303]

Sessions of `test/pose_world.py`, whose shapes the engine knows nothing of: 25 to 60 s, 1 to 4
sensors, 5 to 100 Hz, a reference of 20 to 60 Hz, every effect at three sizes, pairs of them, and
none. A session is right when the names are those and no others. Of parameters and lever arms the
error over the told sigma is taken; a few sessions say little of it, so kinds that have a parameter
are repeated on short sessions of one slow sensor. Seeds below 300 are for choosing, others for
reports.
"""

from __future__ import annotations

import argparse
import sys
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

HERE = Path(__file__).resolve().parent
sys.path[1:1] = [str(HERE.parents[1]), str(HERE.parent)]

from pose_world import World  # noqa: E402

from anser_ros.poses.diagnosis import PoseDiagnosis, diagnose_poses  # noqa: E402

REPORTED, REPEATED = (341,), (342,)
REPEATS = 24  # sessions of a kind by which sigmas are judged: their rms is then known to 14 %
MIDDLE = np.array([0.05, 0.02, -0.3])
TARGET, HONEST = 0.95, (0.8, 1.3)
WIDE = {
    'stale_poses.fraction': 'repeats are counted, and fall on every n-th pose',
    'quantised_stamps.step_s': 'stamps lie on the grid exactly',
    'excess_noise.factor': 'the sigma is a tenth: sensors of one kind differ',
}
"""Parameters whose sigma is meant to be wider than the error in a simulation, and why."""

Truth = MutableMapping[str, tuple[str, float] | None]
"""By the name of an effect its parameter and true value, or None where only the name is judged."""
Stream = list[np.ndarray]


@dataclass(frozen=True)
class Kind:
    """One thing that is wrong, at three sizes.

    Attributes
    ----------
    change : callable
        Takes a world and a size, makes it so, and returns what has to be found.
    sensors : int
        Fewest sensors that it needs.
    parts : tuple of str
        What of a world it uses; two kinds that share one make no pair.
    """

    change: Callable[[World, float], Truth]
    sizes: tuple[float, ...]
    parts: tuple[str, ...]
    sensors: int = 1


def _each(world: World, change: Callable[[str, Stream], None], *, also: bool = False) -> None:
    """Change the tracked streams of a world, or the reference's alone."""
    before = world.after

    def after(streams: dict[str, Stream]) -> dict[str, Stream]:
        streams = before(streams)
        for name, rows in streams.items():
            if (name == 'optical') == also:
                change(name, rows)
        return streams

    world.after = after


def late(world: World, size: float) -> Truth:
    world.offset = 1e-3 * size
    return {'time_offset': ('offset_s', world.offset)}


def fast(world: World, size: float) -> Truth:
    world.rate_ppm = size
    return {'clock_rate': ('rate_ppm', size)}


def scaled(world: World, size: float) -> Truth:
    world.scale = size
    return {'optical_scale': ('scale', size)}


def jittery(world: World, size: float) -> Truth:
    world.jitter = 1e-3 * size
    return {'stamp_jitter': ('rms_s', world.jitter)}


def filtered(world: World, size: float) -> Truth:
    world.tau = 1e-3 * size
    return {'tracker_lag': ('tau_s', world.tau)}


def _bend(world: World, size: float, first: int) -> Truth:
    def bend(sensor: int, place: np.ndarray) -> np.ndarray:
        away = (place - MIDDLE) / 0.06
        return place + (1e-3 * size * away[:, [0]] * away if sensor >= first else 0.0)

    world.bend = bend
    return {'field_distortion': None}


def bent(world: World, size: float) -> Truth:
    return _bend(world, size, 0)


def bent_one(world: World, size: float) -> Truth:
    return _bend(world, size, len(world.levers) - 1)


def shrunk_one(world: World, size: float) -> Truth:
    last = len(world.levers) - 1
    world.bend = lambda sensor, place: (
        MIDDLE + (1 - size) * (place - MIDDLE) if sensor == last else place
    )
    return {'field_distortion': None}


def far_noise(world: World, size: float) -> Truth:
    world.spread = lambda sensor, place: (np.linalg.norm(place, axis=1) / 0.3) ** size
    return {'range_noise': ('exponent', size)}


def noisy(world: World, size: float) -> Truth:
    world.spread = lambda sensor, place: np.full(len(place), size if sensor == 0 else 1.0)
    return {'excess_noise': ('factor', size)}


def stale(world: World, size: float) -> Truth:
    every = round(1 / size)

    def change(name: str, rows: Stream) -> None:
        for one in rows[1:]:
            again = np.arange(every - 1, len(one), every)
            one[again] = one[again - 1]

    _each(world, change, also=True)
    return {'stale_poses': ('fraction', 1 / every)}


def missing(world: World, size: float) -> Truth:
    def change(name: str, rows: Stream) -> None:
        if name == 'sensor_0':
            first = len(rows[0]) // 3
            rows[1][first : first + round(size * len(rows[0]))] = -3.697314e28

    _each(world, change)
    return {'missing_poses': ('fraction', size)}


def mirrored(world: World, size: float) -> Truth:
    every = round(1 / size)

    def change(name: str, rows: Stream) -> None:
        rows[1][::every] += [0.057, 0, 0]
        flipped = Rotation.from_quat(rows[2][::every]) * Rotation.from_rotvec([1.5, 0, 0])
        rows[2][::every] = flipped.as_quat()

    _each(world, change, also=True)
    return {'outliers': None}


def loose(world: World, size: float) -> Truth:
    turn = world.rng.uniform(0, 2 * np.pi)

    def shift(sensor: int, time: np.ndarray) -> np.ndarray:
        wave = np.sin(0.5 * time + turn)[:, None] * [1.0, -0.5, 0.3]
        return 1e-3 * size * wave if sensor == 0 else np.zeros((time.size, 3))

    world.shift = shift
    return {'loose_mount': None}


def metal(world: World, size: float) -> Truth:
    first = 0.35 * world.duration

    def change(name: str, rows: Stream) -> None:
        near = np.exp(-(((rows[0] - first) / (0.05 * world.duration)) ** 4))[:, None]
        rows[1] += 1e-3 * size * near * [0.6, -0.5, 0.6]

    _each(world, change)
    return {'moving_metal': None}


def polled(world: World, size: float) -> Truth:
    step = 1e-3 * size
    truth: Truth = {
        'quantised_stamps': ('step_s', step),
        'time_offset': ('offset_s', step / 2),
    }
    delays: Stream = []

    def change(name: str, rows: Stream) -> None:
        on_grid = np.ceil(rows[0] / step) * step
        delays.append(on_grid - rows[0])
        rows[0] = on_grid
        # Half a step, but for what is left of the last tooth of the sawtooth.
        truth['time_offset'] = 'offset_s', float(np.mean(np.concatenate(delays)))

    _each(world, change)
    return truth


KINDS = {
    'late': Kind(late, (8, 30, 100), ('offset',)),
    'fast': Kind(fast, (600, 1200, 2500), ('rate',)),
    'scaled': Kind(scaled, (1.006, 0.987, 1.03), ('scale',)),
    'jittery': Kind(jittery, (4, 8, 14), ('stamps',)),
    'filtered': Kind(filtered, (40, 80, 160), ('offset', 'stamps')),
    'bent': Kind(bent, (1, 2, 4), ('place', 'scale')),
    'bent_one': Kind(bent_one, (1, 2, 4), ('place', 'scale'), 2),
    'shrunk_one': Kind(shrunk_one, (0.01, 0.02, 0.04), ('place', 'scale'), 2),
    'far_noise': Kind(far_noise, (3, 4, 5), ('noise',)),
    'noisy': Kind(noisy, (2.5, 4, 6), ('noise',), 3),
    'stale': Kind(stale, (0.1, 0.25, 0.5), ('reference',)),
    'missing': Kind(missing, (0.02, 0.05, 0.1), ('tracked',)),
    'mirrored': Kind(mirrored, (0.01, 0.02, 0.04), ('reference',)),
    'loose': Kind(loose, (2, 4, 8), ('place', 'noise'), 2),
    'metal': Kind(metal, (4, 8, 16), ('place', 'noise', 'tracked')),
    'polled': Kind(polled, (10, 16, 30), ('offset', 'stamps')),
}
WITH_PARAMETER = ('late', 'fast', 'scaled', 'jittery', 'filtered', 'far_noise', 'polled')
REPEATED_NAME = 'one slow sensor'


def world_of(seed: int, fewest: int) -> World:
    """A world of a seed, with at least so many sensors."""
    rng = np.random.default_rng(seed)
    return World(
        seed, duration=float(rng.uniform(25, 60)), sensors=max(int(rng.integers(1, 5)), fewest),
        rate=float(np.exp(rng.uniform(np.log(5), np.log(100)))),
        optical_rate=float(rng.uniform(20, 60)),
    )  # fmt: skip


def small_world(seed: int) -> World:
    """A world of a seed with one slow sensor for half a minute, which is diagnosed within 1 s."""
    rng = np.random.default_rng(seed)
    return World(
        seed, duration=float(rng.uniform(25, 40)), sensors=1, rate=float(rng.uniform(8, 20)),
        optical_rate=float(rng.uniform(20, 60)),
    )  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What came of one session: names that had to be found, that were, and errors over sigma."""

    expected: tuple[str, ...]
    found: tuple[str, ...]
    errors: Mapping[str, float]
    levers: tuple[float, ...]

    @property
    def is_right(self) -> bool:
        """Whether the names are those that had to be found, and no others."""
        return set(self.expected) == set(self.found)


def outcome(world: World, truth: Truth) -> Outcome:
    """Diagnose a world, and compare with what is wrong with it."""
    found = diagnose_poses(world.session())
    named = {r.name: r for r in found.records if r.name != 'hand_eye'}
    errors = {}
    for name, true in truth.items():
        if true is not None and name in named:
            key, value = true
            sigma = named[name].uncertainty.get(key)
            if sigma:
                errors[f'{name}.{key}'] = (named[name].parameters[key] - value) / sigma
    return Outcome(tuple(truth), tuple(named), errors, tuple(_levers(found, world)))


def _levers(found: PoseDiagnosis, world: World) -> Iterator[float]:
    for record in found.records:
        if record.name == 'hand_eye':
            true = world.levers[int(record.parameters['sensor'].rpartition('_')[2])]
            told = record.parameters['lever_arm_m'], record.uncertainty['lever_arm_m']
            for value, sigma, exact in zip(*told, true, strict=True):
                if value is not None:
                    yield (value - exact) / sigma


def singles(seeds: Sequence[int], kinds: Sequence[str]) -> Iterator[tuple[str, float, Outcome]]:
    """Every kind at every size, and nothing wrong, for every seed."""
    for number, name in enumerate(('clean', *kinds)):
        kind = KINDS.get(name)
        for place, size in enumerate(kind.sizes if kind else (0, 1, 2)):
            for seed in seeds:
                world = world_of(1000 * seed + 10 * number + place, kind.sensors if kind else 1)
                truth = kind.change(world, size) if kind else {}
                yield name, size, outcome(world, truth)


def pairs(seeds: Sequence[int], count: int) -> Iterator[tuple[str, float, Outcome]]:
    """Pairs of kinds that do not touch the same part of a world, at their middle sizes."""
    free = [
        pair for pair in combinations(KINDS, 2)
        if not set(KINDS[pair[0]].parts) & set(KINDS[pair[1]].parts)
    ]  # fmt: skip
    for seed in seeds:
        chosen = np.random.default_rng(seed).permutation(len(free))[:count]
        for number in chosen.tolist():
            one, other = (KINDS[name] for name in free[number])
            world = world_of(1000 * seed + 500 + number, max(one.sensors, other.sensors))
            # Not copied: what a poll makes of the stamps is known with the session.
            changed = (kind.change(world, kind.sizes[1]) for kind in (one, other))
            truth: Truth = ChainMap(*changed)
            yield ' + '.join(free[number]), 0.0, outcome(world, truth)


def repeats(seeds: Sequence[int], count: int) -> Iterator[tuple[str, float, Outcome]]:
    """Kinds with a parameter whose sigma is judged, so many sessions each, sizes in turn."""
    for seed in seeds:
        for place, name in enumerate(WITH_PARAMETER):
            kind = KINDS[name]
            for number in range(count):
                world = small_world(1000 * seed + 600 + 50 * place + number)
                size = kind.sizes[number % len(kind.sizes)]
                yield f'{REPEATED_NAME}, {name}', size, outcome(world, kind.change(world, size))


def summary(outcomes: Sequence[tuple[str, float, Outcome]]) -> Iterator[dict[str, Any]]:
    """Rows for `run.py`: what was right of each kind, and the errors over their sigmas."""
    for name in dict.fromkeys(kind for kind, _, _ in outcomes):
        own = [one for kind, _, one in outcomes if kind == name]
        yield {
            'name': f'poses: {name} named, nothing else',
            'value': sum(one.is_right for one in own) / len(own), 'unit': f'of {len(own)}',
            'target': TARGET, 'target_is': 'least',
        }  # fmt: skip
    right = [one for _, _, one in outcomes if one.is_right]
    errors: dict[str, list[float]] = {'lever arm': [v for one in right for v in one.levers]}
    for one in right:
        for key, value in one.errors.items():
            is_poll = key.startswith('time_offset') and 'quantised_stamps' in one.expected
            errors.setdefault(f'{key} beside a poll' if is_poll else key, []).append(value)
    for key, values in errors.items():
        if len(values) > 1:
            size = float(np.sqrt(np.mean(np.square(values))))
            if key in WIDE:
                yield {
                    'name': f'poses: {key}, rms of error over sigma ({WIDE[key]})',
                    'value': size, 'unit': f'of {len(values)}', 'target': 'at most 1.3',
                    'met': bool(size <= HONEST[1]),
                }  # fmt: skip
                continue
            yield {
                'name': f'poses: {key}, rms of error over sigma', 'value': size,
                'unit': f'of {len(values)}', 'target': '0.8 to 1.3',
                'met': bool(HONEST[0] <= size <= HONEST[1]),
            }  # fmt: skip


def rows() -> Iterator[dict[str, Any]]:
    """Every kind, some pairs and the repeats, on the seeds for reports."""
    found = [*singles(REPORTED, list(KINDS)), *pairs(REPORTED, 12), *repeats(REPEATED, REPEATS)]
    yield from summary(found)


def main() -> None:
    """Print each session as it comes, and the table."""
    parser = argparse.ArgumentParser(description='diagnosis of simulated trackers of poses')
    parser.add_argument('--seeds', default=','.join(map(str, REPORTED)))
    parser.add_argument('--kinds', default=','.join(KINDS), help='of them, with none wrong first')
    parser.add_argument('--pairs', type=int, default=12, help='pairs for every seed')
    parser.add_argument('--repeats', type=int, default=0, help='short sessions of one sensor')
    parser.add_argument('--repeat-seeds', default=','.join(map(str, REPEATED)))
    args = parser.parse_args()
    seeds = [int(seed) for seed in args.seeds.split(',')]
    outcomes = []
    kinds = [kind for kind in args.kinds.split(',') if kind]
    again = [int(seed) for seed in args.repeat_seeds.split(',')]
    every = (singles(seeds, kinds), pairs(seeds, args.pairs), repeats(again, args.repeats))
    for part in every:
        for name, size, one in part:
            outcomes.append((name, size, one))
            said = 'right' if one.is_right else f'WRONG: {", ".join(one.found) or "nothing"}'
            figures = ', '.join(f'{key} {value:+.1f} sigma' for key, value in one.errors.items())
            print(f'{name} {size:g}: {said} {figures}', flush=True)
    for row in summary(outcomes):
        met = {True: '', False: 'NOT met'}.get(row.get('met', row['value'] >= TARGET), '')
        print(f'{row["name"]}: {row["value"]:.2f} {row["unit"]} {met}')


if __name__ == '__main__':
    main()
