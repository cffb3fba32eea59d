"""Finds the equivalent layer: few dipoles that make the field of any cloud in the tracked volume.

A *layer* is a regular grid of dipoles on or below the board, or on a box around the volume; it
takes the place of a cloud's many sources, whose field it reproduces where tools are. A field whose
sources are all below a plane is also the field of dipoles on that plane (the equivalent layer of
potential theory; Blakely, Potential Theory in Gravity and Magnetic Applications, chapter 3). So
the refitted model keeps its size however fine the clouds are. Metal beside or over the volume
needs dipoles beside and over it.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import cholesky

from anser_ros.arrays import Array, Integers
from anser_ros.physics.dipole import field_basis
from anser_ros.physics.sensor import along_each_axis
from anser_ros.refit.clouds import Cloud, Excitation, Region

BELOW, AROUND = 'below', 'around'
RIDGE = 1e-5
"""Damping of the layer's fit relative to its largest singular value."""
SHALLOW = (12, 1.3, 0.15)
"""Lattice near the board, as `DEEP` describes it; together 193 dipoles, few enough to track by."""
DEEP = (7, 2.5, 1.0)
"""Dipoles along a side, half size and depth of a lattice, the last two in halves of the board."""
SAMPLES = (12, 7)
"""Samples across and up that a layer is fitted at; half as many leave 40 % between them."""
AT_ONCE = 64
"""Sources whose field at the samples is worked out at once: 5 MB, which the cache still holds."""
MOST_MIDDLE = 60
"""Samples in the middle that show what the uncertainty's modes leave."""
LEAST_SAMPLE_DISTANCE = 0.35
"""Samples nearer to a body's sources than this part of its radius don't count."""
INNER = 0.83
"""Part of the volume that the box is fitted in: near the faces it cannot make all detail."""


@dataclass(frozen=True)
class Layer:
    """Holds the dipoles that represent the field of a cloud."""

    name: str  # the same for the same dipoles
    # (N, 3)
    positions: Array
    directions: Array
    # (N, 3P), or None, from field samples (T, point by point) to moments (A m^2); None where the
    # dipoles are the sources themselves, three a source
    inverse: Array | None
    points: Array  # (P, 3), where the field is sampled, m
    # (N, N), upper triangle C: ``|C m|`` is what the field of moments m does to poses, an rms over
    # the samples of the field relative to the emitters' own, times the height (an error of the
    # field moves a pose by its size over the field's gradient). Its unit does not matter
    metric: Array
    # (Q, N), field components per unit moment at the samples in the middle of the volume
    middle: Array
    _projected: dict[bytes, Array] = field(default_factory=dict, repr=False, compare=False)

    def project(self, sources: Array) -> Array:
        """Return the layer's moments per unit moment of each source's component, (N, 3M)."""
        if self.inverse is None:
            return np.eye(3 * len(sources))
        key = sources.tobytes()
        if key not in self._projected:
            # Clouds are asked for in turn, each for all of its responses.
            self._projected.clear()
            parts = np.array_split(sources, -(-len(sources) // AT_ONCE) or 1)
            self._projected[key] = np.hstack(
                [
                    self.inverse @ component_rows(self.points, *along_each_axis(part))
                    for part in parts
                ]
            )
        return self._projected[key]


def component_rows(points: Array, positions: Array, directions: Array) -> Array:
    """Return the field samples per unit moment of dipoles (N, 3), shape (3P, N)."""
    field = field_basis(points, positions, directions)
    return field.swapaxes(1, 2).reshape(-1, len(positions))


def _build(
    name: str,
    positions: Array,
    directions: Array,
    points: Array,
    excitation: Excitation,
    half: float,
) -> Layer:
    basis = component_rows(points, positions, directions)
    scale = np.linalg.norm(basis, axis=0)
    u, s, vt = np.linalg.svd(basis / scale, full_matrices=False)
    inverse = (vt.T * (s / (s**2 + (RIDGE * s[0]) ** 2))) @ u.T / scale[:, None]
    metric = _metric(basis, pose_weight(points, excitation))
    middle = basis[_middle(points, half)]
    return Layer(name, positions, directions, inverse, points, metric, middle)


def pose_weight(points: Array, excitation: Excitation) -> Array:
    """Return how far an error of the field moves a pose at each point (P,), up to a factor."""
    weight = points[:, 2] / np.linalg.norm(excitation.field(points), axis=(1, 2))
    return np.asarray(weight / weight.mean())


def _metric(basis: Array, weight: Array) -> Array:
    weighted = basis * np.repeat(weight, 3)[:, None]
    gram = weighted.T @ weighted
    gram[np.diag_indices_from(gram)] += 1e-12 * np.diag(gram)
    return np.asarray(cholesky(gram))


def _middle(points: Array, half: float) -> Integers:
    """Return the rows of some samples in the middle of the volume, three a sample."""
    there = np.flatnonzero((points[:, 2] > 0.5 * half) & (points[:, 2] < half))
    if not there.size:  # a stated volume may be all above or all below
        there = np.arange(len(points))
    some = there[:: -(-len(there) // MOST_MIDDLE) or 1]
    return np.asarray((3 * some[:, None] + np.arange(3)).ravel())


def body_layer(region: Region, weight: Array, cloud: Cloud) -> Layer:
    """Return the sources of a compact body as dipoles, which are exact wherever the body is.

    ``weight`` (P,) is `pose_weight` at ``region.volume.samples()``.
    """
    points = region.volume.samples()
    away = np.linalg.norm(points[:, None] - cloud.positions, axis=2).min(axis=1)
    clear = away > LEAST_SAMPLE_DISTANCE * cloud.standoff_m
    points = points[clear]
    positions, directions = along_each_axis(cloud.positions)
    basis = component_rows(points, positions, directions)
    metric = _metric(basis, weight[clear])
    middle = basis[_middle(points, region.half)]
    return Layer(cloud.name, positions, directions, None, points, metric, middle)


def _lattice(region: Region, across: int, extent: float, depth: float) -> Array:
    side = np.linspace(-extent, extent, across) * region.half
    x, y = np.meshgrid(side + region.centre[0], side + region.centre[1], indexing='ij')
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, -depth * region.half)], axis=1)


def _upright(positions: Array) -> Array:
    return np.tile([0.0, 0.0, 1.0], (len(positions), 1))


def bottom_layer(region: Region, excitation: Excitation) -> Layer:
    """Return the layer for clouds below the board."""
    points = region.volume.samples(*SAMPLES)
    positions = np.concatenate([_lattice(region, *SHALLOW), _lattice(region, *DEEP)])
    return _build(BELOW, positions, _upright(positions), points, excitation, region.half)


def box_layer(region: Region, excitation: Excitation) -> Layer:
    """Return dipoles on the faces of a box around the tracked volume, pointing inwards."""
    gap = 0.8 * region.half
    volume = region.volume
    sides = volume.reach + gap
    across = [np.linspace(-side, side, 6) for side in sides.tolist()]
    faces = [(axis, sign) for axis in range(2) for sign in (-1.0, 1.0)]
    positions, directions = [], []
    for axis, sign in faces:
        up = np.linspace(-gap, volume.ceiling + gap, 4)
        u, v = (a.ravel() for a in np.meshgrid(across[1 - axis], up, indexing='ij'))
        face = np.empty((u.size, 3))
        face[:, axis], face[:, 1 - axis], face[:, 2] = sign * sides[axis], u, v
        positions.append(face)
        directions.append(np.tile(-sign * np.eye(3)[axis], (u.size, 1)))
    u, v = (a.ravel() for a in np.meshgrid(*across, indexing='ij'))
    for height, inwards in ((volume.ceiling + gap, -1.0), (-gap, 1.0)):
        positions.append(np.stack([u, v, np.full(u.size, height)], axis=1))
        directions.append(inwards * _upright(positions[-1]))
    stacked = np.concatenate(positions)
    stacked[:, :2] += volume.middle
    points = region.volume.samples(*SAMPLES, part=INNER)
    axes = np.concatenate(directions)
    return _build(AROUND, stacked, axes, points, excitation, region.half)
