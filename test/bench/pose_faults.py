"""What is put into simulated sessions of poses: every effect that `interfaces.md` lists, at three
sizes."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from typing import NamedTuple

import numpy as np
from pose_world import World
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

MIDDLE = np.array([0.05, 0.02, -0.3])

Truth = MutableMapping[str, tuple[str, float] | None]
"""By the name of an effect its parameter and true value, or None where only the name is judged."""
Stream = list[np.ndarray]


class Kind(NamedTuple):
    """One thing that is wrong, at three sizes."""

    change: Callable[[World, float], Truth]  # makes it so, and returns what has to be found
    sizes: tuple[float, ...]
    parts: tuple[str, ...]  # what of a world it uses; two kinds that share one make no pair
    sensors: int = 1  # fewest that it needs
    may: tuple[str, ...] = ()  # names that may be told besides, or not


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


def stated(attribute: str, unit: float, effect: str, parameter: str) -> Callable[..., Truth]:
    """What a world states in one number, and a diagnosis finds as a parameter of an effect."""

    def change(world: World, size: float) -> Truth:
        setattr(world, attribute, unit * size)
        return {effect: (parameter, unit * size)}

    return change


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
    truth: Truth = {'quantised_stamps': ('step_s', step), 'time_offset': ('offset_s', step / 2)}
    delays: Stream = []

    def change(name: str, rows: Stream) -> None:
        on_grid = np.ceil(rows[0] / step) * step
        delays.append(on_grid - rows[0])
        rows[0] = on_grid
        # Half a step, but for what is left of the last tooth of the sawtooth.
        truth['time_offset'] = 'offset_s', float(np.mean(np.concatenate(delays)))

    _each(world, change)
    return truth


def misread(world: World, size: float) -> Truth:
    """Scalar first, the other way round, or both: the orders and senses that devices write."""
    order = [0, 1, 2, 3] if size == 2 else [3, 0, 1, 2]
    sign = 1.0 if size == 1 else -1.0

    def change(name: str, rows: Stream) -> None:
        rows[2] = (rows[2] * [sign, sign, sign, 1.0])[:, order]

    _each(world, change)
    return {'frame_convention': None}


def exchanged(world: World, size: float) -> Truth:
    """Two sensors under each other's names for a share of the session."""
    before = world.after

    def after(streams: dict[str, Stream]) -> dict[str, Stream]:
        streams = before(streams)
        one, other = streams['sensor_0'], streams['sensor_1']
        first = len(one[0]) // 3
        span = slice(first, first + round(size * len(one[0])))
        for mine, yours in zip(one, other, strict=True):
            mine[span], yours[span] = yours[span].copy(), mine[span].copy()
        return streams

    world.after = after
    return {'swapped_sensors': ('fraction', size)}


def _cut(world: World, keep: Callable[[np.ndarray], np.ndarray]) -> None:
    """Leave out the times that are not to be kept, in all streams."""
    before = world.after
    world.after = lambda streams: {
        name: [one[keep(rows[0])] for one in rows] for name, rows in before(streams).items()
    }


def at_rest(world: World, size: float) -> Truth:
    """Recordings of 5 s at rest, so many, 10 s apart, with an error of their own."""
    count, rng, world.duration, world.rate = int(size), world.rng, 15.0 * size, 40.0
    places, turns = rng.normal(0, 0.08, (count + 1, 3)), rng.normal(0, 0.35, (count + 1, 3))

    def at(values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        return lambda time: values[np.clip(time // 15, 0, count).astype(int)]

    def change(name: str, rows: Stream) -> None:
        rows[1] += at(rng.normal(0, 9e-4, (count + 1, 3)))(rows[0])

    world.follow(at(places), at(turns))
    _each(world, change)
    _cut(world, lambda time: time % 15 < 5)
    return {}


def _lasting(world: World, duration: float) -> None:
    """Move as a hand does for so many seconds."""
    knots = np.arange(-2.0, duration + 3.0, 0.7)
    spread = (0.06, 0.25)
    world.follow(*(CubicSpline(knots, world.rng.normal(0, s, (knots.size, 3))) for s in spread))
    world.duration = duration


def paused(world: World, size: float) -> Truth:
    middle = world.duration / 2
    _lasting(world, world.duration + size)
    _cut(world, lambda time: (time < middle) | (time > middle + size))
    return {}


def through(world: World, size: float) -> Truth:
    """Recordings of 15 s, so many, with pauses of some minutes, of clocks that run through."""
    starts = np.cumsum(world.rng.uniform(45, 315, int(size)))
    world.rate_ppm = 250.0
    _lasting(world, float(starts[-1]) + 15)
    _cut(world, lambda time: np.abs(np.subtract.outer(time - 7.5, starts)).min(axis=1) < 7.5)
    return {'clock_rate': ('rate_ppm', world.rate_ppm)}


def turned(world: World, size: float) -> Truth:
    """From four fifths on, turns of some degrees and a millimetre, beside stamps that jitter."""
    late, world.rate, world.jitter = 68.0, 5.0, 0.017
    _lasting(world, 86.0)

    def change(name: str, rows: Stream) -> None:
        share = (1.0, 0.4, 0.3, 0.3)[int(name[-1])] * np.deg2rad(size) * (rows[0] > late)
        turn = Rotation.from_rotvec(share[:, None] * [0.6, -0.5, 0.62])
        rows[2] = (turn * Rotation.from_quat(rows[2])).as_quat()
        rows[1] += 1e-3 * (rows[0] > late)[:, None] * [0.6, 0.5, -0.6]

    _each(world, change)
    return {'moving_metal': None, 'stamp_jitter': ('rms_s', world.jitter)}


def passed(world: World, size: float) -> Truth:
    """Metal of 3 cm reach at one place, that a hand comes back to four times."""
    _lasting(world, 90.0)
    spot, hand, world.rate = world.rng.normal(0, 0.03, 3) + [0.1, 0, 0], world._place, 5.0

    def place(time: np.ndarray) -> np.ndarray:
        far = np.min(np.abs(np.subtract.outer(time, [15, 34, 55, 76])), axis=1)
        near = 1 / (1 + np.exp((far - 2) / 0.2))[:, None]
        return hand(time) * (1 - near) + near * (spot + 0.2 * hand(time))

    def change(name: str, rows: Stream) -> None:
        away = np.linalg.norm(world.body(rows[0])[0] - spot - MIDDLE, axis=1)
        near = (1.0 if name == 'sensor_0' else 0.6) * np.exp(-((away / 0.03) ** 2))[:, None]
        rows[1] += 1e-3 * size * near * [0.7, 0.5, -0.5]
        turn = Rotation.from_rotvec(np.deg2rad(size / 2) * near * [0.5, 0.5, 0.7])
        rows[2] = (turn * Rotation.from_quat(rows[2])).as_quat()

    world.follow(place, world._turn)
    _each(world, change)
    return {'moving_metal': None}


def two_small(world: World, size: float) -> Truth:
    """All sensors but the last read small, and worse beyond a depth."""
    last = len(world.levers) - 1

    def bend(sensor: int, place: np.ndarray) -> np.ndarray:
        deep = np.clip(-0.33 - place[:, [2]], 0, None) ** 2 * [0.6, 0.4, -1.0]
        return place if sensor == last else MIDDLE + (1 - size) * (place - MIDDLE) + deep

    world.bend = bend
    return {'field_distortion': None}


def scaled_bent(world: World, size: float) -> Truth:
    """A scale of the reference beside a smooth bend of the tracker, mm at 60 mm."""
    world.scale, slopes = 1.012, world.rng.normal(size=(3, 3, 3))
    world.bend = lambda sensor, place: (
        place
        + 1e-3 * size / 3 * np.einsum('ijk,nj,nk->ni', slopes, *2 * [(place - MIDDLE) / 0.06])
    )
    return {'optical_scale': ('scale', 1.012)}


def strained(world: World, size: float) -> Truth:
    """Space that is stretched at random, so many parts, and no scale."""
    strain = size * world.rng.normal(size=(3, 3))
    world.bend = lambda sensor, place: place + (place - MIDDLE) @ strain
    return {}


def stepped(world: World, size: float) -> Truth:
    """Positions on steps of so many mm, and one sensor far from the generator."""
    world.levers[-1], world.noise_m = [0, 0, -0.16], 2e-5
    world.spread = lambda sensor, place: 1 + 4 * (np.linalg.norm(place, axis=1) / 0.35) ** 4

    def change(name: str, rows: Stream) -> None:
        rows[1][:] = np.round(rows[1] / (1e-3 * size)) * 1e-3 * size

    _each(world, change)
    return {}


def own_errors(world: World, size: float) -> Truth:
    """Errors that every tracker has: smooth over places and turns, each sensor's own, mm rms."""

    def change(name: str, rows: Stream) -> None:
        waves, tilts, ways = (world.rng.normal(0, s, (6, 3)) for s in (8.0, 1.2, 1 / 3))
        turns = Rotation.from_quat(rows[2])
        phase = rows[1] @ waves.T + (turns.mean().inv() * turns).as_rotvec() @ tilts.T
        phase += world.rng.uniform(0, 7, 6)
        rows[1] += 1e-3 * size * np.cos(phase) @ ways
        rows[2] = (Rotation.from_rotvec(5e-3 * size * np.sin(phase) @ ways) * turns).as_quat()

    _each(world, change)
    return {}


def received(world: World, size: float) -> Truth:
    """Stamps of receipt in all streams, and one row in nine twice."""

    def change(name: str, rows: Stream) -> None:
        jitter = 1e-3 * size * world.rng.normal(size=len(rows[0]))
        again = 1 + (np.arange(len(jitter)) % 9 == 0)
        rows[:] = [np.repeat(one, again, axis=0) for one in (rows[0] + jitter, *rows[1:])]

    _each(world, change)
    _each(world, change, also=True)
    return {'stamp_jitter': None}


def leaning(world: World, size: float) -> Truth:
    """Positions err, mm, by an even function of the direction of each sensor's z axis."""
    shape = world.rng.normal(size=(3, 3, 3))

    def change(name: str, rows: Stream) -> None:
        axis = Rotation.from_quat(rows[2]).as_matrix()[:, :, 2]
        rows[1] += 1e-3 * size * np.einsum('ijk,nj,nk->ni', shape, axis, axis)

    turn = world._turn
    world.follow(world._place, lambda time: 1.5 * turn(time))
    _each(world, change)
    return {'orientation_error': None}


KINDS = {
    'late': Kind(stated('offset', 1e-3, 'time_offset', 'offset_s'), (8, 30, 100), ('offset',)),
    'fast': Kind(stated('rate_ppm', 1, 'clock_rate', 'rate_ppm'), (600, 1200, 2500), ('rate',)),
    'scaled': Kind(stated('scale', 1, 'optical_scale', 'scale'), (1.006, 0.987, 1.03), ('scale',)),
    'jittery': Kind(stated('jitter', 1e-3, 'stamp_jitter', 'rms_s'), (4, 8, 14), ('stamps',)),
    'filtered': Kind(
        stated('tau', 1e-3, 'tracker_lag', 'tau_s'), (40, 80, 160), ('offset', 'stamps')
    ),
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
    'misread': Kind(misread, (1, 2, 3), ('reading',)),
    'exchanged': Kind(exchanged, (0.05, 0.1, 0.3), ('place', 'tracked'), 2),
    'far_off': Kind(stated('offset', 1, 'time_offset', 'offset_s'), (2.2, 3.076, 7), ('offset',)),
    'at_rest': Kind(at_rest, (40, 60, 85), ('place', 'offset', 'noise'), 3),
    'paused': Kind(paused, (10, 24, 60), ('tracked', 'reference')),
    'turned': Kind(turned, (2, 3, 5), ('place', 'stamps', 'tracked'), 3),
    'passed': Kind(passed, (6, 10, 15), ('place', 'tracked'), 2),
    'two_small': Kind(two_small, (0.01, 0.02, 0.03), ('place', 'scale'), 3),
    'scaled_bent': Kind(scaled_bent, (0.3, 0.6, 1), ('place', 'scale'), 4, ('field_distortion',)),
    'strained': Kind(
        strained, (0.002, 0.003, 0.004), ('place', 'scale'), 2, ('field_distortion',)
    ),
    'stepped': Kind(stepped, (0.05, 0.11, 0.2), ('noise', 'tracked'), 3, ('range_noise',)),
    'through': Kind(through, (5, 9, 17), ('tracked', 'reference'), 1, ('time_offset',)),
    'own_errors': Kind(own_errors, (0.4, 0.8, 1.2), ('place',), 1, ('field_distortion',)),
    'leaning': Kind(leaning, (1, 1.5, 2), ('place', 'tracked'), 2),
    'received': Kind(received, (4, 7, 10), ('stamps', 'tracked', 'reference')),
}
