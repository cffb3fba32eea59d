"""Diagnosis of simulated trackers of poses: which of their errors are named, and how honestly.

    python test/bench/bench_poses.py [--seeds 301,302] [--clean 5] [--kinds late,bent] [--pairs 6]
        [--repeats 30 --repeat-seeds 303]

Sessions of `test/pose_world.py`, whose shapes the engine knows nothing of: 25 to 60 s, 1 to 4
sensors, 5 to 100 Hz, a reference of 20 to 60 Hz, every effect (`pose_faults.py`) at three sizes,
pairs of them, and none, for which there are many motions (`clean_poses.py`). A session is right
when the names are those and no others. Of parameters and lever arms the error over the told sigma
is taken; a few sessions say little of it, so kinds that have a parameter are repeated on short
sessions of one slow sensor. Seeds below 300 are for choosing, others for reports.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections import ChainMap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import harness
import numpy as np
from clean_poses import clean_worlds
from pose_faults import KINDS, Truth
from pose_world import World

from anser_ros.apps.poses.diagnosis import PoseDiagnosis, diagnose_poses
from anser_ros.errors import AnserError

REPORTED, REPEATED = (351,), (352,)
REPEATS = 24  # sessions of a kind by which sigmas are judged: their rms is then known to 14 %
CLEAN_ROUNDS = 5  # clean sessions of each motion
PAIRS = 12
TARGET, HONEST = 0.95, (0.8, 1.3)
WIDE = {
    'stale_poses.fraction': 'repeats are counted, and fall on every n-th pose',
    'quantised_stamps.step_s': 'stamps lie on the grid exactly',
    'excess_noise.factor': 'the sigma is a tenth: sensors of one kind differ',
}
"""Parameters whose sigma is meant to be wider than the error in a simulation, and why."""

PAIRABLE = list(KINDS)[: list(KINDS).index('far_off')]
"""Kinds that make pairs; the others are faults together already."""
WITH_PARAMETER = ('late', 'fast', 'scaled', 'jittery', 'filtered', 'far_noise', 'polled')
CLEAN, PAIRED, REPEATED_NAME = 'clean', 'a pair', 'one slow sensor'
REFUSED = 'refused'  # in place of names


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
    """What came of one session: names that had to be found, that were, errors over sigma, and the
    time that it took by the clock."""

    expected: tuple[str, ...]
    found: tuple[str, ...]
    errors: Mapping[str, float]
    levers: tuple[float, ...]
    took_s: float
    may: tuple[str, ...] = ()

    @property
    def is_right(self) -> bool:
        """Whether the names are those that had to be found, and no others."""
        return set(self.expected) <= set(self.found) <= {*self.expected, *self.may}


def outcome(world: World, truth: Truth, may: tuple[str, ...] = ()) -> Outcome:
    """Diagnose a world, and compare with what is wrong with it."""
    session, start = world.session(), time.perf_counter()
    try:
        found = diagnose_poses(session)
    except AnserError:
        took = time.perf_counter() - start
        return Outcome(tuple(truth), (REFUSED,), {}, (), took, may)
    took = time.perf_counter() - start
    named = {r.name: r for r in found.records if r.name != 'hand_eye'}
    errors = {}
    for name, true in truth.items():
        if true is not None and name in named:
            key, value = true
            sigma = named[name].uncertainty.get(key)
            if sigma:
                errors[f'{name}.{key}'] = (named[name].parameters[key] - value) / sigma
    return Outcome(tuple(truth), tuple(named), errors, tuple(_levers(found, world)), took, may)


def _levers(found: PoseDiagnosis, world: World) -> Iterator[float]:
    for record in found.records:
        if record.name == 'hand_eye':
            true = world.levers[int(record.parameters['sensor'].rpartition('_')[2])]
            told = record.parameters['lever_arm_m'], record.uncertainty['lever_arm_m']
            for value, sigma, exact in zip(*told, true, strict=True):
                if value is not None:
                    yield (value - exact) / sigma


Judged = tuple[str, str, Outcome]
"""The row that a session counts for, what it is more exactly, and what came of it."""


def clean(seeds: Sequence[int], rounds: int) -> Iterator[Judged]:
    """Sessions with nothing wrong, of every motion so many, for every seed."""
    for seed in seeds:
        for name, world in clean_worlds(seed, rounds):
            yield CLEAN, name, outcome(world, {})


def singles(seeds: Sequence[int], kinds: Sequence[str]) -> Iterator[Judged]:
    """Every kind at every size for every seed."""
    for number, name in enumerate(KINDS, 1):
        kind = KINDS[name]
        for place, size in enumerate(kind.sizes if name in kinds else ()):
            for seed in seeds:
                world = world_of(1000 * seed + 10 * number + place, kind.sensors)
                yield name, f'{size:g}', outcome(world, kind.change(world, size), kind.may)


def pairs(seeds: Sequence[int], count: int) -> Iterator[Judged]:
    """Pairs of kinds that do not touch the same part of a world, at their middle sizes."""
    free = [
        pair for pair in combinations(PAIRABLE, 2)
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
            yield PAIRED, ' + '.join(free[number]), outcome(world, truth)


def repeats(seeds: Sequence[int], count: int) -> Iterator[Judged]:
    """Kinds with a parameter whose sigma is judged, so many sessions each, sizes in turn."""
    for seed in seeds:
        for place, name in enumerate(WITH_PARAMETER):
            kind = KINDS[name]
            for number in range(count):
                world = small_world(1000 * seed + 600 + 50 * place + number)
                size = kind.sizes[number % len(kind.sizes)]
                said = outcome(world, kind.change(world, size))
                yield f'{REPEATED_NAME}, {name}', f'{size:g}', said


def summary(outcomes: Sequence[Judged]) -> Iterator[harness.Row]:
    """Rows for `run.py`: what was right of each kind, the errors over their sigmas, the time."""
    for name in dict.fromkeys(kind for kind, _, _ in outcomes):
        own = [one for kind, _, one in outcomes if kind == name]
        yield harness.row(
            f'poses: {name} named, nothing else', sum(one.is_right for one in own),
            f'of {len(own)}', target=len(own) if name == CLEAN else math.ceil(TARGET * len(own)),
            target_is='least',
        )  # fmt: skip
    took = [one.took_s for _, _, one in outcomes]
    for name, value in (('median', np.median(took)), ('longest', max(took))):
        yield harness.row(f'poses: a session, wall time, {name}', float(value), 's')
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
                yield harness.row(
                    f'poses: {key}, rms of error over sigma ({WIDE[key]})', size,
                    f'of {len(values)}', target='at most 1.3', met=bool(size <= HONEST[1]),
                )  # fmt: skip
                continue
            yield harness.row(
                f'poses: {key}, rms of error over sigma', size, f'of {len(values)}',
                target='0.8 to 1.3', met=bool(HONEST[0] <= size <= HONEST[1]),
            )  # fmt: skip


def rows() -> Iterator[harness.Row]:
    """Clean sessions, every kind, some pairs and the repeats, on the seeds for reports."""
    found = [
        *clean(REPORTED, CLEAN_ROUNDS), *singles(REPORTED, list(KINDS)), *pairs(REPORTED, PAIRS),
        *repeats(REPEATED, REPEATS),
    ]  # fmt: skip
    for _, what, one in found:
        if not one.is_right:
            print(f'  wrong: {what}: {", ".join(one.found) or "nothing"}', file=sys.stderr)
    yield from summary(found)


def main() -> None:
    """Print each session as it comes, and the table."""
    parser = argparse.ArgumentParser(description='diagnosis of simulated trackers of poses')
    parser.add_argument('--seeds', type=harness.integers, default=REPORTED)
    parser.add_argument('--clean', type=int, default=CLEAN_ROUNDS, help='of each motion')
    parser.add_argument('--kinds', default=','.join(KINDS), help='of them')
    parser.add_argument('--pairs', type=int, default=PAIRS, help='pairs for every seed')
    parser.add_argument('--repeats', type=int, default=0, help='short sessions of one sensor')
    parser.add_argument('--repeat-seeds', type=harness.integers, default=REPEATED)
    args = parser.parse_args()
    outcomes = []
    kinds = [kind for kind in args.kinds.split(',') if kind]
    every = (
        clean(args.seeds, args.clean), singles(args.seeds, kinds), pairs(args.seeds, args.pairs),
        repeats(args.repeat_seeds, args.repeats),
    )  # fmt: skip
    for part in every:
        for name, what, one in part:
            outcomes.append((name, what, one))
            said = 'right' if one.is_right else f'WRONG: {", ".join(one.found) or "nothing"}'
            figures = ', '.join(f'{key} {value:+.1f} sigma' for key, value in one.errors.items())
            print(f'{name}, {what}: {said} {figures}', flush=True)
    harness.print_rows(summary(outcomes))


if __name__ == '__main__':
    main()
