"""Says where unknown metal may be, and what field drives it there.

A *cloud* fills a part of space with point sources of independent polarisability, each of a
variance proportional to the volume it stands for: the prior is then white in space and does not
depend on how finely that part is sampled. All that a cloud asserts is that no metal is nearer than
its *standoff*: the distance from the board for clouds below it, from the tracked volume for clouds
around it. A *compact body* is a small cloud, a ball of sources at one place: the hypothesis of one
piece of metal beside or over the volume. The evidence decides, frame by frame, which is right (see
`refit.posterior`).

The emitters' field drives the metal. A calibrated model is fitted where tools are, over the board;
extrapolated below it, it is wrong by tens of percent near the coils, while the coils' drawing
gives that field to a percent. So the drawing is used if there is one, with strength and phase
taken from the calibrated model.

The frame ``fg`` has its board at z = 0 with z up towards the patient, so "below" is z < 0.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from anser_ros.arrays import AnyArray, Array, ComplexArray
from anser_ros.errors import FitError
from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import dipole_field
from anser_ros.physics.volume import TrackedVolume

LAYER_RATIO = 1.45
"""Ratio of the depths of neighbouring layers of sources: detail to tell apart grows with depth."""
SPACING_PER_DEPTH = 0.7
"""Lateral spacing of a layer's sources over its depth: coils can hardly tell them from a sheet."""

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
    counts = [int((reach + outer) / spacing) for reach in side.tolist()]
    flat = [spacing * np.arange(-count, count + 1) for count in counts]
    height = np.arange(-deep + spacing / 2.0, volume.ceiling + outer, spacing)
    x, y, z = (axis.ravel() for axis in np.meshgrid(*flat, height, indexing='ij'))
    beside = np.maximum(np.abs(x) - side[0], np.abs(y) - side[1])
    away = np.maximum(beside, z - volume.ceiling)
    points: Array = np.stack([x, y, z], axis=1)[(away >= inner) & (away < outer)]
    points[:, :2] += volume.middle
    return points


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


FieldFunction = Callable[[Array], Array]
"""Field of each emitter at its nominal current: points (P, 3), m, to (P, K, 3), T."""

AGREEMENT = 0.9
"""Correlation with the calibrated model below which a drawing is not of this board."""
SEARCH_M = 1.0
"""Half size of the square in which the board is searched, m."""
SEARCH_POINTS = 61
"""Points along a side of that search, about 3 cm apart: less than a coil of a board is wide."""
SEARCH_HEIGHT_M = 0.02
"""Height over the board at which its field is compared, m."""


@dataclass(frozen=True)
class Excitation:
    """Gives the driving field, in phase with the current of each emitter."""

    source: str  # where it comes from
    # (K,), complex, unit phasor of each emitter's field; readings are turned back by it
    phase: ComplexArray
    field: FieldFunction  # from points (P, 3), m, to the field there, (P, K, 3), T


def region_of(field: Callable[[Array], AnyArray]) -> Region:
    """Return the board's extent: the square with 98 % of its field's power over the surface.

    Raises `FitError` when the field is zero or not finite.
    """
    side = np.linspace(-SEARCH_M, SEARCH_M, SEARCH_POINTS)
    x, y = np.meshgrid(side, side, indexing='ij')
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, SEARCH_HEIGHT_M)], axis=1)
    values = np.abs(field(points)) ** 2
    power = (values / np.maximum(values.sum(axis=(0, 2)), 1e-300)[None, :, None]).sum(axis=(1, 2))
    power = power.reshape(x.shape)
    if not np.isfinite(power).all() or power.sum() <= 0.0:
        raise FitError('refit: the emitters make no field over the board')
    edges = []
    for axis in range(2):
        line = power.sum(axis=1 - axis)
        share = (np.cumsum(line) - 0.5 * line) / line.sum()
        edges.append([np.interp(level, share, side) for level in (0.01, 0.99)])
    low, high = np.array(edges).T
    return Region((low + high) / 2.0, float((high - low).max() / 2.0))


def excitation_for(
    model: FieldModel, drawing: FieldFunction | None, volume: TrackedVolume | None = None
) -> tuple[Excitation, Region]:
    """Return the drawing's field scaled to the model, or the model's if the drawing is another's.

    ``volume`` is the tracked volume as stated; None for the default over the board. Raises
    `FitError` when the drawing has another number of emitters than the model.
    """

    def own(points: Array) -> ComplexArray:
        field = dipole_field(points, model.positions, model.directions, model.moments)
        return np.asarray(field.swapaxes(1, 2))

    region = replace(region_of(own if drawing is None else drawing), stated=volume)
    points = region.volume.samples()
    high = points[:, 2] > 0.6 * region.half
    points = points[high] if high.any() else points
    measured = own(points)
    if drawing is not None:
        drawn = drawing(points)
        if drawn.shape != measured.shape:
            raise FitError(
                f'refit: the drawing makes fields {drawn.shape}, the model {measured.shape}'
            )
        power = (drawn**2).sum(axis=(0, 2))
        gain = (drawn * measured).sum(axis=(0, 2)) / np.maximum(power, 1e-300)
        size = np.sqrt(power * (np.abs(measured) ** 2).sum(axis=(0, 2)))
        if (np.abs(gain) * power >= AGREEMENT * size).all():
            strength = np.abs(gain)

            def scaled(points: Array) -> Array:
                return np.asarray(drawing(points) * strength[None, :, None])

            return Excitation('board', gain / strength, scaled), region
        region = replace(region_of(own), stated=volume)
    square = (measured**2).sum(axis=(0, 2))
    phase = np.exp(0.5j * np.angle(square))

    def turned(points: Array) -> Array:
        return np.asarray((own(points) * phase.conj()[None, :, None]).real)

    return Excitation('model', phase, turned), region
