"""Shapes of metal that stand or move near a board, each packed from a hundred or so spheres."""

import numpy as np
from spheres import Body

MATERIALS = {
    'aluminium': (2.5e7, 1.0), 'brass': (1.5e7, 1.0), 'copper': (5.8e7, 1.0),
    'stainless': (1.35e6, 1.02), 'steel': (5e6, 150.0), 'ferrite_steel': (2e6, 400.0),
}  # fmt: skip
"""Conductivity in S/m and relative permeability."""


def _lattice(spacing, reach, rng):
    """Close-packed places within a cube, randomly turned in the plane, (n, 3)."""
    n = int(np.ceil(1.5 * reach / spacing)) + 1
    i, j, k = np.meshgrid(*[np.arange(-n, n + 1)] * 3, indexing='ij')
    place = np.stack([i + 0.5 * (j + k), np.sqrt(0.75) * (j + k / 3), np.sqrt(2 / 3) * k], axis=-1)
    place = spacing * place.reshape(-1, 3)
    a = rng.uniform(0, np.pi)
    place[:, :2] = place[:, :2] @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
    return place + spacing * rng.uniform(-0.5, 0.5, 3)


def _packed(inside, reach, count, rng):
    """About ``count`` touching-free spheres where ``inside`` says so: places and radii."""
    low, high = reach / 60, 2 * reach
    for _ in range(30):
        spacing = np.sqrt(low * high)
        place = _lattice(spacing, reach, rng)
        place = place[inside(place)]
        low, high = (spacing, high) if len(place) > count else (low, spacing)
        if abs(len(place) - count) <= 0.06 * count:
            break
    radius = 0.5 * spacing * rng.uniform(0.8, 0.97, len(place))
    return place, radius


def _of(place, radius, materials):
    pairs = np.array([MATERIALS[name] for name in materials])
    return Body(place, radius, pairs[:, 0], pairs[:, 1])


def block(rng, radius_m, material, count=110):
    """An irregular lump, its middle at the origin, as far as ``radius_m`` at its longest axis."""
    axes = radius_m * np.array([1.0, rng.uniform(0.7, 1.0), rng.uniform(0.55, 0.9)])

    def inside(p):
        return np.sum((p / axes) ** 2, axis=1) < 1

    place, radius = _packed(inside, radius_m, count, rng)
    volume = radius**3
    place = place - volume @ place / volume.sum()
    return _of(place, radius, [material] * len(place))


def head(rng, count=130):
    """An X-ray head: cover, round housing of another metal, core; the cover's top at z = 0."""
    wide, deep = rng.uniform(0.085, 0.12), rng.uniform(0.09, 0.14)
    cover, housing = rng.choice([['aluminium', 'steel'], ['stainless', 'aluminium']])
    core = rng.choice(['copper', 'ferrite_steel'])

    def parts(p):
        r = np.hypot(p[:, 0], p[:, 1])
        top = (r < wide) & (np.abs(p[:, 2] + 0.012) < 0.012)
        wall = (r > 0.72 * wide) & (r < wide) & (p[:, 2] < -0.024) & (p[:, 2] > -deep)
        inner = (r < 0.4 * wide) & (p[:, 2] < -0.04) & (p[:, 2] > -0.8 * deep)
        return top, wall, inner

    place, radius = _packed(lambda p: np.any(parts(p), axis=0), max(wide, deep), count, rng)
    top, wall, _ = parts(place)
    names = np.where(top, cover, np.where(wall, housing, core))
    place = place - [0, 0, np.max(place[:, 2] + radius)]
    return _of(place, radius, names.tolist())


def rail(rng, material, length_m, count=90):
    """A profile along x such as a table's: two parallel bars."""

    def inside(p):
        bars = np.abs(np.abs(p[:, 1]) - 0.018) < 0.011
        return bars & (np.abs(p[:, 2]) < 0.011) & (np.abs(p[:, 0]) < 0.5 * length_m)

    place, radius = _packed(inside, 0.5 * length_m, count, rng)
    return _of(place - place.mean(axis=0), radius, [material] * len(place))


def retractor(rng, material, count=80):
    """A flat instrument: a blade 40 mm wide, 160 mm long, with a bent end."""

    def inside(p):
        blade = (np.abs(p[:, 0]) < 0.08) & (np.abs(p[:, 1]) < 0.02) & (np.abs(p[:, 2]) < 0.007)
        bent = (np.abs(p[:, 0] - 0.074) < 0.007) & (np.abs(p[:, 1]) < 0.02)
        return blade | (bent & (p[:, 2] < 0) & (p[:, 2] > -0.045))

    place, radius = _packed(inside, 0.08, count, rng)
    return _of(place - place.mean(axis=0), radius, [material] * len(place))
