"""Makes hypotheses about the place of unknown metal, each a cloud of candidate sources.

A *cloud* fills a part of space with point sources of independent polarisability, each of a
variance proportional to the volume it stands for: the prior is then white in space and does not
depend on how finely that part is sampled. The only thing that a cloud asserts is that no metal is
nearer than its *standoff*: the distance from the board for clouds below it, from the tracked
volume for clouds around it. The evidence decides, frame by frame, which standoff is right (see
`refit.posterior`).

A *compact body* is a small cloud, a ball of sources at one place: the hypothesis of one piece of
metal beside or over the tracked volume. All clouds take the place of the board and its tracked
volume from the `Region`.

The frame ``fg`` has its board at z = 0 with z up towards the patient, so "below" is z < 0.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.volume import TrackedVolume

Array = NDArray[np.float64]

LAYER_RATIO = 1.45
"""Ratio of the depths of neighbouring layers of sources: detail that sensors can tell grows with
depth, so depths are even on a logarithmic scale."""
SPACING_PER_DEPTH = 0.7
"""Lateral spacing of a layer's sources over its depth: sensors as far away as the layer is deep
can hardly tell its sources from a sheet."""

BODY_SPACING = 0.6
"""Distance of neighbouring compact bodies of the lattice, in halves of the board."""
BODY_RADIUS = 0.45
"""Lattice of compact bodies and their radius, in halves of the board: neighbours overlap."""


@dataclass(frozen=True)
class Region:
    """Describes the board's extent, and the volume over it in which the field must be right.

    The board's middle is at ``centre`` (x, y), m, and ``half`` is half of its larger side, m, the
    unit of sizes and spacings of clouds and layers. The volume is as the setup states it, or else
    the default.
    """

    centre: Array
    half: float
    stated: TrackedVolume | None = None

    @cached_property
    def volume(self) -> TrackedVolume:
        """Return the volume in which tools are tracked."""
        return self.stated or TrackedVolume.over_board(self.centre, self.half)


@dataclass(frozen=True)
class Cloud:
    """Holds candidate sources of one hypothesis at positions (M, 3), m, frame fg.

    The nearest source is ``standoff_m`` from the board, or from the tracked volume where the cloud
    is ``overhead``, around and over it. Each source stands for a volume, (M,), m^3.
    """

    name: str
    standoff_m: float
    overhead: bool
    positions: Array
    volumes: Array


def below(region: Region, standoff: float) -> Cloud:
    """Return layers of sources from ``standoff`` under the board to beyond the board's size."""
    deepest = max(2.7 * region.half, 3.0 * standoff)
    count = max(3, 1 + int(math.log(deepest / standoff) / math.log(LAYER_RATIO)))
    depths = standoff * LAYER_RATIO ** np.arange(count)
    edges = np.concatenate([depths[:1], (depths[1:] + depths[:-1]) / 2.0, depths[-1:]])
    positions, volumes = [], []
    for depth, thickness in zip(depths, np.diff(edges), strict=True):
        reach = 1.3 * region.half + 0.5 * depth
        spacing = max(region.half / 6.0, SPACING_PER_DEPTH * depth)
        across = math.ceil(2.0 * reach / spacing) + 1
        side = np.linspace(-reach, reach, across)
        x, y = np.meshgrid(side + region.centre[0], side + region.centre[1], indexing='ij')
        positions.append(np.stack([x.ravel(), y.ravel(), np.full(x.size, -depth)], axis=1))
        volumes.append(np.full(x.size, thickness * (side[1] - side[0]) ** 2))
    name = f'below {1e3 * standoff:.0f} mm'
    return Cloud(name, standoff, False, np.concatenate(positions), np.concatenate(volumes))


def overhead(region: Region, standoff: float) -> Cloud:
    """Return sources beside and over the tracked volume, at least ``standoff`` away from it.

    Shells of growing thickness, each on a lattice whose spacing depends on the distance to the
    volume.
    """
    positions, volumes = [], []
    inner, reach = standoff, standoff + 1.2 * region.half
    while inner < reach:
        outer = min(1.9 * inner, reach)
        spacing = max(0.5 * inner, region.half / 9.0)
        shell = _shell(region, inner, outer, spacing)
        positions.append(shell)
        volumes.append(np.full(len(shell), spacing**3))
        inner = outer
    name = f'around {1e3 * standoff:.0f} mm'
    return Cloud(name, standoff, True, np.concatenate(positions), np.concatenate(volumes))


def _shell(region: Region, inner: float, outer: float, spacing: float) -> Array:
    """Return lattice points between two boxes around the volume that are open at the bottom."""
    volume, deep = region.volume, 0.3 * region.half
    side = volume.reach
    flat = [_centred(reach + outer, spacing) for reach in side.tolist()]
    height = np.arange(-deep + spacing / 2.0, volume.ceiling + outer, spacing)
    x, y, z = (axis.ravel() for axis in np.meshgrid(*flat, height, indexing='ij'))
    beside = np.maximum(np.abs(x) - side[0], np.abs(y) - side[1])
    away = np.maximum(beside, z - volume.ceiling)
    points: Array = np.stack([x, y, z], axis=1)[(away >= inner) & (away < outer)]
    points[:, :2] += volume.middle
    return points


def _centred(reach: float, spacing: float) -> Array:
    """Return a lattice over -reach..reach that is symmetric about 0."""
    count = int(reach / spacing)
    return np.asarray(spacing * np.arange(-count, count + 1))


def bodies(region: Region) -> tuple[Cloud, ...]:
    """Return compact bodies on a lattice around and in the outer part of the tracked volume.

    A cloud over a whole region expects as much metal everywhere; a ball of sources at its place
    describes one piece of metal beside or over the volume far better. Below the board the layers
    are equally good.
    """
    half = region.half
    side = BODY_SPACING * (np.arange(8) - 3.5)
    height = BODY_SPACING * (np.arange(6) - 0.5)
    unit = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing='ij'), axis=-1).reshape(-1, 3)
    unit = unit[(unit**2).sum(axis=1) <= 2]
    # The centre first, then its six neighbours, then the twelve at the edges.
    unit = unit[np.argsort((unit**2).sum(axis=1), kind='stable')]
    ball = BODY_RADIUS * half / math.sqrt(2.0) * unit
    out = []
    for x, y, z in np.stack(np.meshgrid(side, side, height, indexing='ij'), -1).reshape(-1, 3):
        across = max(abs(x), abs(y))
        if (across < 0.75 and z < 1.25) or (across < 1.2 and z < 0.0):
            continue
        centre = np.array([region.centre[0] + x * half, region.centre[1] + y * half, z * half])
        name = 'body at ' + ', '.join(f'{1e3 * c:.0f}' for c in centre) + ' mm'
        volume = (BODY_RADIUS * half) ** 3 * 4.0 / 3.0 * math.pi / len(ball)
        volumes = np.full(len(ball), volume)
        out.append(Cloud(name, BODY_RADIUS * half, True, centre + ball, volumes))
    return tuple(out)


def default_clouds(region: Region) -> tuple[Cloud, ...]:
    """Return the hypotheses for a board, with standoffs in a geometric series."""
    near = 0.08 * region.half
    standoffs = near * 1.55 ** np.arange(8)
    around = region.half * np.array([0.25, 0.5, 0.9])
    return tuple(below(region, float(s)) for s in standoffs) + tuple(
        overhead(region, float(s)) for s in around
    )
