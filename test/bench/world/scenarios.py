"""Metal that stands or moves in the room, placed so that it runs into nobody's coils."""

from dataclasses import replace

import numpy as np
from bodies import block, head, rail, retractor
from laboratory import Scattered
from motions import Travel, resting

ROOM_M = 0.012
"""Least distance between a sphere's surface and a reference coil or the tool's volume."""
LUMP_T, HEAD_T, HINDRANCE_T = 0.5e-9, 2e-9, 0.3e-9
"""Least field that the kinds of metal make in the volume: what is weaker is no test."""
MOST_DRAWN = 300


def _clear(lab, body, travel):
    """Whether a body keeps clear of reference coils, board and tool on all of its way."""
    half = 0.16
    low, high = lab.board.heights_m
    for at, turn in zip(*travel.at(np.linspace(0, 40, 41)), strict=True):
        place = at + body.place @ turn.T
        away = np.linalg.norm(place[:, None] - lab.board.reference.place, axis=-1)
        if (away.min(axis=1) < body.radius + ROOM_M).any():
            return False
        reach = np.maximum(np.abs(place[:, :2]) - half, 0)
        up = np.maximum(np.abs(place[:, 2] - 0.5 * (low + high)) - 0.5 * (high - low) - 0.035, 0)
        if (np.hypot(np.hypot(*reach.T), up) < body.radius + ROOM_M).any():
            return False
        design = lab.board.design
        copper = np.abs(place[:, :2]) - [design.half_x_m, design.half_y_m]
        over = np.hypot(np.hypot(*np.maximum(copper, 0).T), place[:, 2] + 0.001)
        if (over < body.radius + 0.003).any():
            return False
    return True


def strength(lab, body, travel):
    """Root mean square (T) of what a body adds to the field in the tool's volume at its worst."""
    low, high = lab.board.heights_m
    line = np.array([-0.1, 0.0, 0.1])
    points = np.array([(x, y, z) for x in line for y in line for z in (low, high)])
    alone = replace(lab, metals=[(body, travel)])
    times = np.linspace(travel.t_start, travel.t_end, 4) if travel.moves else np.zeros(1)
    field = Scattered(alone, times).field(np.tile(points, (len(times), 1, 1)))
    return np.sqrt(np.mean(np.abs(field) ** 2, axis=(1, 2, 3))).max()


def _turn(rng, size=np.pi):
    v = rng.normal(size=3)
    return rng.uniform(0, size) * v / np.linalg.norm(v)


def _spot(lab, radius, rng):
    """Somewhere below, beside or over the volume."""
    where = rng.choice(['below', 'below', 'beside', 'over'])
    if where == 'below':
        x, y = rng.uniform(-0.12, 0.12, 2)
        return np.array([x, y, -radius - rng.uniform(0.01, 0.07)])
    if where == 'over':
        x, y = rng.uniform(-0.1, 0.1, 2)
        return np.array([x, y, lab.board.heights_m[1] + 0.05 + radius + rng.uniform(0.02, 0.07)])
    aside = max(lab.board.design.half_x_m, 0.17) + radius + rng.uniform(0.02, 0.06)
    place = [rng.choice([-1.0, 1.0]) * aside, rng.uniform(-0.12, 0.12)]
    return np.array([*rng.permutation(place), rng.uniform(0.0, 0.2)])


def _placed(lab, draw, least_t):
    """Draw body and way until they are clear of everything, and felt in the volume.

    Where nothing is felt enough (the references leave no room), the strongest drawn is taken.
    """
    best, most = None, 0.0
    for _ in range(MOST_DRAWN):
        body, travel = draw()
        if not _clear(lab, body, travel):
            continue
        felt = strength(lab, body, travel)
        if felt > most:
            best, most = (body, travel), felt
        if felt > least_t:
            break
    if best is None:
        raise RuntimeError('no clear place for the metal was found')
    lab.metals.append(best)


def static_metal(lab, rng, ferrous=None):
    """A lump that stands."""
    ferrous = bool(rng.integers(2)) if ferrous is None else ferrous
    names = ['steel', 'ferrite_steel'] if ferrous else ['aluminium', 'copper', 'brass']
    material, radius = str(rng.choice(names)), rng.uniform(0.035, 0.06)
    shape = block(rng, radius, material)
    _placed(lab, lambda: (shape, resting(_spot(lab, radius, rng), _turn(rng))), LUMP_T)


def two_metals(lab, rng):
    """Two different lumps."""
    static_metal(lab, rng, ferrous=False)
    static_metal(lab, rng, ferrous=True)


def approach(lab, rng):
    """An X-ray head comes up from 30 cm below until its cover nearly touches the board."""
    shape = head(rng)
    t0, t1 = rng.uniform(4, 8), rng.uniform(27, 33)
    depth = min(0.0, lab.board.reference.place[:, 2].min())  # below coils that are below the board

    def draw():
        start = np.array([*rng.uniform(-0.1, 0.1, 2), -0.3])
        end = np.array([*rng.uniform(-0.03, 0.03, 2), -0.003 - rng.uniform(0.004, 0.01)])
        if depth < 0:
            end[2] += depth - ROOM_M
        spin = np.array([0, 0, rng.uniform(0, 2 * np.pi)])
        lean = spin + np.array([*rng.uniform(-0.15, 0.15, 2), 0])
        bow = np.array([*rng.uniform(-0.03, 0.03, 2), 0.0])
        return shape, Travel(start, end, t0, t1, lean, spin, bow)

    _placed(lab, draw, HEAD_T)


def sweep(lab, rng):
    """The head passes sideways below the board."""
    shape = head(rng)
    t0, t1 = rng.uniform(3, 7), rng.uniform(32, 37)
    depth = min(0.0, lab.board.reference.place[:, 2].min())

    def draw():
        z = rng.uniform(-0.065, -0.035) + depth
        a = rng.uniform(0, 2 * np.pi)
        way = np.array([np.cos(a), np.sin(a), 0.0])
        off = np.array([-np.sin(a), np.cos(a), 0.0]) * rng.uniform(-0.04, 0.04)
        start, end = off - 0.29 * way + [0, 0, z], off + 0.29 * way + [0, 0, z]
        spin = np.array([0, 0, rng.uniform(0, 2 * np.pi)])
        bow = np.array([0.0, 0.0, rng.uniform(-0.01, 0.0)])
        return shape, Travel(start, end, t0, t1, spin, spin + [0, 0, 0.5], bow)

    _placed(lab, draw, HEAD_T)


def beside(lab, rng):
    """A table's rail, or a lump, rises beside the volume."""
    long = bool(rng.integers(2))
    shape = rail(rng, 'aluminium', 0.3) if long else block(rng, 0.045, 'steel')
    t0, t1 = rng.uniform(4, 8), rng.uniform(27, 34)

    def draw():
        a = rng.integers(4) * np.pi / 2 + rng.uniform(-0.1, 0.1)
        design = lab.board.design
        reach = max(design.half_x_m, design.half_y_m, 0.17) + rng.uniform(0.06, 0.1)
        side = np.array([np.cos(a), np.sin(a), 0.0]) * reach
        start, end = side * 1.25 + [0, 0, -0.22], side + [0, 0, rng.uniform(0.08, 0.2)]
        spin = np.array([0, 0, a + np.pi / 2])
        return shape, Travel(start, end, t0, t1, spin, spin, 0.05 * side)

    _placed(lab, draw, HINDRANCE_T)


def over(lab, rng):
    """An image detector, or an instrument, comes down over the volume."""
    large = bool(rng.integers(2))
    shape = head(rng) if large else retractor(rng, 'steel')
    t0, t1 = rng.uniform(4, 8), rng.uniform(27, 34)

    def draw():
        top = lab.board.heights_m[1] + 0.035
        start = np.array([*rng.uniform(-0.2, 0.2, 2), top + 0.3])
        end = np.array([*rng.uniform(-0.07, 0.07, 2), top + rng.uniform(0.03, 0.09)])
        turn = _turn(rng, 0.3) + [np.pi * large, 0.0, 0.0]
        return shape, Travel(start, end, t0, t1, turn, turn + _turn(rng, 0.4), np.zeros(3))

    _placed(lab, draw, HINDRANCE_T)
