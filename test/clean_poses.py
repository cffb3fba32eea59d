"""Sessions of poses with nothing wrong, of many kinds: whatever is named on them is false.

Motions are those that people make for a recording, each with other sensors, rates, references and
noise in every session. What `interfaces.md` calls an effect is not among them: jitter that grows
with the distance is `range_noise`, and poses of the reference that come again are `stale_poses`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from pose_world import World
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

Course = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Knots, s, and at them places (n, 3), m, about the middle, and turns (n, 3), rad."""
LONGER = 3.0  # seconds that a course goes on before and after a session

NOISES_M, NOISES_RAD = (1e-4, 1e-3), (1e-3, 1e-2)  # least and most of trackers' data sheets
STREAMS = ('as measured', 'irregular', 'some lost', 'sensors differ', 'alike for a while')
"""How the reference's poses come, or what the tracker's noise is like: on its own rate and white;
polled at irregular moments, each pose once and with its true time; one pose in ten missing here
and there; up to a half more noise at one sensor than at another; and errors of a tenth of a
millimetre that last for half a second."""


def _knots(duration: float, step: float) -> np.ndarray:
    return np.arange(-LONGER, duration + LONGER, step)


def _smooth(rng: np.random.Generator, knots: np.ndarray, size: float) -> np.ndarray:
    return rng.normal(0, size, (knots.size, 3))


def wandering(step_s: float, place_m: float, turn_rad: float) -> Callable[..., Course]:
    """Up and down and about as a hand does it, with a knot every so many seconds."""

    def course(rng: np.random.Generator, duration: float) -> Course:
        knots = _knots(duration, step_s)
        return knots, _smooth(rng, knots, place_m), _smooth(rng, knots, turn_rad)

    return course


def in_rows(rng: np.random.Generator, duration: float) -> Course:
    """Row beside row over a plane, with the tool turned now and then."""
    knots = _knots(duration, 0.25)
    row = rng.uniform(2.0, 4.0)
    number = knots / row
    along = 0.08 * np.sin(np.pi * number)
    across = 0.1 * (np.arange(knots.size) / knots.size - 0.5) * 2
    place = np.stack([along, across, 0.01 * np.sin(0.7 * knots)], axis=1)
    turns = CubicSpline(_knots(duration, 1.7), _smooth(rng, _knots(duration, 1.7), 0.25))(knots)
    return knots, place, turns


def in_circles(rng: np.random.Generator, duration: float) -> Course:
    """A robot's circles, tilted more and more, whose turns go with the place."""
    knots = _knots(duration, 0.1)
    angle = 2 * np.pi * knots / rng.uniform(3.0, 6.0)
    tilt = 0.4 * np.sin(2 * np.pi * knots / duration)
    flat = 0.08 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    place = np.column_stack([flat * np.cos(tilt)[:, None], 0.08 * np.sin(tilt) * np.cos(angle)])
    turn = np.stack([0.3 * np.sin(angle), 0.3 * np.cos(angle / 2), tilt], axis=1)
    return knots, place, turn


def with_stops(rng: np.random.Generator, duration: float) -> Course:
    """Held at a dozen places for one to three seconds, and carried from one to the next."""
    step, starts = 0.1, [-LONGER]
    while starts[-1] < duration + LONGER:
        starts.append(starts[-1] + rng.uniform(1.5, 4.0))
    knots = _knots(duration, step)
    number = np.searchsorted(starts, knots)
    places = rng.normal(0, 0.06, (len(starts) + 1, 3))[number]
    turns = rng.normal(0, 0.3, (len(starts) + 1, 3))[number]
    width = 0.25 / step
    return knots, gaussian_filter1d(places, width, axis=0), gaussian_filter1d(turns, width, axis=0)


def about_a_tip(rng: np.random.Generator, duration: float) -> Course:
    """Turned about a point a hand's breadth away, as for a pivot calibration."""
    knots = _knots(duration, 0.9)
    turn = _smooth(rng, knots, 0.35)
    arm = rng.normal(0, 0.06, 3)
    return knots, np.cross(turn, arm) + 0.5 * np.cross(turn, np.cross(turn, arm)), turn


def far_and_near(rng: np.random.Generator, duration: float) -> Course:
    """Through a volume of 40 cm, to twice the distance from the field generator."""
    knots = _knots(duration, 1.2)
    place = rng.uniform(-1, 1, (knots.size, 3)) * [0.15, 0.15, 0.12]
    return knots, place, _smooth(rng, knots, 0.3)


MOTIONS: dict[str, Callable[[np.random.Generator, float], Course]] = {
    'by hand': wandering(0.7, 0.06, 0.25), 'slowly': wandering(2.5, 0.06, 0.3),
    'in rows': in_rows, 'in circles': in_circles, 'with stops': with_stops,
    'about a tip': about_a_tip, 'far and near': far_and_near,
    'in a corner': wandering(0.8, 0.015, 0.3), 'carried': wandering(0.8, 0.06, 0.02),
}  # fmt: skip
"""A hand that takes a second or some for each way, holds a tool within two centimetres with as
many turns as elsewhere, or hardly turns it, so that lever arms stay unknown; and other ways."""


def _between(rng: np.random.Generator, least: float, most: float) -> float:
    """A number whose logarithm is even between two."""
    return float(np.exp(rng.uniform(np.log(least), np.log(most))))


def clean_world(seed: int, motion: str, stream: str) -> World:
    """A world of a seed that moves in one of the ways, with poses that come in one of the ways."""
    rng = np.random.default_rng(seed)
    world = World(
        seed, duration=float(rng.uniform(20, 60)), sensors=int(rng.integers(1, 5)),
        rate=_between(rng, 5, 100), optical_rate=float(rng.uniform(15, 60)),
    )  # fmt: skip
    knots, place, turn = MOTIONS[motion](rng, world.duration)
    world.follow(CubicSpline(knots, place), CubicSpline(knots, turn))
    world.noise_m, world.noise_rad = _between(rng, *NOISES_M), _between(rng, *NOISES_RAD)
    if stream == 'sensors differ':
        size = rng.uniform(1.0, 1.5, 4)
        world.spread = lambda sensor, place: np.full(len(place), size[sensor])
    if stream == 'alike for a while':
        world.after = lambda streams: _alike(rng, streams, 1e-4, 0.5)
    if stream in ('irregular', 'some lost'):
        world.when = lambda time: _polled(rng, time, stream)
    return world


def _polled(rng: np.random.Generator, time: np.ndarray, stream: str) -> np.ndarray:
    """Times of the reference's poses, irregular or with some of them lost."""
    if stream == 'irregular':
        return time + rng.uniform(-0.4, 0.4, time.size) * np.median(np.diff(time))
    return time[rng.random(time.size) > 0.1]


def _alike(
    rng: np.random.Generator, streams: dict[str, list[np.ndarray]], size: float, lasts: float
) -> dict[str, list[np.ndarray]]:
    """Streams with errors of the tracked positions that last for a while, size m rms."""
    for name, rows in streams.items():
        if name != 'optical':
            knots = np.arange(rows[0][0] - lasts, rows[0][-1] + 2 * lasts, lasts)
            rows[1] = rows[1] + CubicSpline(knots, rng.normal(0, size, (knots.size, 3)))(rows[0])
    return streams


def clean_worlds(seed: int, rounds: int) -> Iterator[tuple[str, World]]:
    """Every motion so many times, with the ways in which poses come in turn."""
    for number, motion in enumerate(MOTIONS):
        for place in range(rounds):
            stream = STREAMS[(number + place) % len(STREAMS)]
            name = f'{motion}, {stream}'
            yield name, clean_world(1000 * seed + 800 + 10 * number + place, motion, stream)
