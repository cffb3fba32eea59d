"""Simulates the experiments' recordings by the package's own simulator, where no others are at
hand.

The board differs slightly from its drawing. Plates and the X-ray head are lattices of metal balls
that the board magnetises and that do not magnetise each other. They are rougher than real plates
and heads, and distort the field by about as much.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.apps.lab.experiments.recordings import HEAD_DISTANCES_CM, MATERIALS, Recordings
from anser_ros.physics.dipole import field_basis
from anser_ros.settings import Accuracy
from anser_ros.simulation.recording import STATIC_NOISE_T, record
from anser_ros.simulation.world import (
    FieldSource,
    MetalBody,
    Pose,
    World,
    board_source,
    manufactured,
    steel_disc,
)
from anser_ros.wire.setup import SensorSpec, Setup, parse_setup
from anser_ros.wire.text_files import config_path

Array = NDArray[np.float64]

STATIC = Accuracy(flux_noise_t=STATIC_NOISE_T)
"""Errors of a tool at rest; the noise is half of a single window's."""
PLATE_EDGE_M = 0.25
"""Edge of the square plate, m, about as large as the board."""
PLATE_BALLS = 12
"""Balls along an edge of the plate; more make it smoother and the simulation slower."""
PLATE_DEPTH_M = 0.02
"""Depth of the balls' centres below the board, m."""
COLLIMATOR_DEPTH_M = 0.03
"""Depth of the X-ray head below the board in the last experiment, m."""
METALS = {'aluminium': (35e6, 1.0), 'mu-metal': (1.8e6, 1e4)}
"""Conductivity, S/m, and relative permeability (article, Table I)."""


@dataclass(frozen=True)
class Raster:
    """Moves a body so that it rests at the points of a lattice, one a second, held by hand."""

    side: int  # points along x and along y
    span_m: float  # edge of the square, m
    # height of the lattice, m; each point is off by up to 4 mm and turned by up to 20 mrad
    height_m: float

    def __call__(self, time_s: float) -> Pose:
        """Return the pose at a time, s."""
        index = int(np.clip(round(time_s), 0, self.side**2 - 1))
        row, column = divmod(index, self.side)
        line = np.linspace(-self.span_m / 2, self.span_m / 2, self.side)
        # Multiples of irrational numbers are evenly spread and the same in every run.
        unsteady = np.mod(np.outer([0.6180340, 0.7548777, 0.5698403], [1, 2]) * (index + 1), 1.0)
        offset = 0.004 * (2.0 * unsteady[:, 0] - 1.0)
        turn = 0.02 * (2.0 * unsteady[:, 1] - 1.0)
        place = np.array([line[column], line[row], self.height_m]) + offset
        return place, np.asarray(Rotation.from_rotvec(turn).as_matrix())


def _tool_a() -> tuple[SensorSpec, ...]:
    sensors: list[SensorSpec] = []
    for cluster in range(3):
        for axis, letter in enumerate('xyz'):
            unit = [0.0, 0.0, 0.0]
            unit[axis] = 1.0
            place = (0.0, 0.0, 0.03 * (cluster - 1))
            name = f'tool_a/{cluster}/{letter}'
            x, y, z = unit
            sensors.append(SensorSpec(len(sensors), name, 'tool_a', place, (x, y, z), 0.0))
    return tuple(sensors)


def _tool_b() -> tuple[SensorSpec, ...]:
    return (
        SensorSpec(0, 'tool_b/y', 'tool_b', (-0.006, 0.0, 0.0), (0.0, 1.0, 0.0), 0.0082),
        SensorSpec(1, 'tool_b/z', 'tool_b', (0.006, 0.0, 0.0), (0.0, 0.0, 1.0), 0.0082),
    )


def _at_rest(place: Array) -> Pose:
    return place, np.eye(3)


def plate(material: str) -> MetalBody:
    """Return a square plate of a material below the board."""
    ball = PLATE_EDGE_M / (2 * PLATE_BALLS)
    line = np.linspace(-PLATE_EDGE_M / 2 + ball, PLATE_EDGE_M / 2 - ball, PLATE_BALLS)
    x, y = np.meshgrid(line, line)
    offsets = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    conductivity, permeability = METALS[material]
    place = np.array([0.0, 0.0, -PLATE_DEPTH_M])
    return MetalBody(offsets, ball, conductivity, permeability, lambda _: _at_rest(place))


def head(depth_m: float) -> MetalBody:
    """Return the X-ray head at a depth below the board, m."""
    place = np.array([0.01, -0.01, -depth_m])
    return steel_disc(lambda _: _at_rest(place), radius_m=0.1, rings=4)


def with_metal(source: FieldSource, metal: Sequence[MetalBody], setup: Setup) -> FieldSource:
    """Return the field of a board together with that of the metal at rest that it magnetises."""
    tones = np.array(setup.frequencies_hz)
    places, moments = [], []
    for body in metal:
        centres = body.centres(0.0)
        places.append(centres)
        moments.append(source(centres) * body.polarisability(tones))
    if not places:
        return source
    where, induced = np.concatenate(places), np.concatenate(moments)

    def field(points: Array) -> NDArray[np.complex128]:
        out = np.array(source(points), dtype=complex)
        for component, unit in enumerate(np.eye(3)):
            basis = field_basis(points, where, np.broadcast_to(unit, where.shape))
            out += np.einsum('pni,nk->pik', basis, induced[:, component])
        return out

    return field


def simulate_recordings(folder: Path, seed: int, share: float = 1.0) -> Recordings:
    """Write a bag for every experiment into a folder.

    Parameters
    ----------
    folder : Path
        Folder for the bags.
    seed : int
        Seed of the board's errors and of the noise.
    share : float
        Points along a lattice's side as a fraction of the article's; at least six are left.
    """
    rng = np.random.default_rng(seed)
    text = config_path('demo_setup.yaml').read_text(encoding='utf-8')
    drawn = replace(parse_setup(text), flux_rate_hz=1.0)
    board = board_source(manufactured(drawn, rng))
    setups = {
        'tool_a': replace(drawn, sensors=_tool_a()),
        'tool_b': replace(drawn, sensors=_tool_b()),
    }
    small = Raster(8, 0.2, 0.15)
    jobs: list[tuple[str, Raster, list[MetalBody]]] = [
        ('factory_tool_a', Raster(31, 0.30, 0.15), []),
        ('midplane_tool_b', Raster(26, 0.25, 0.15), []),
    ]
    for material in MATERIALS:
        stem = f'shield_{material.replace("-", "_")}'
        jobs.append((f'{stem}_tool_b', Raster(25, 0.25, 0.15), [plate(material)]))
        jobs.append((f'{stem}_c_arm_tool_b', small, [plate(material), head(0.05)]))
    for distance in HEAD_DISTANCES_CM:
        jobs.append((f'c_arm_{distance:02d}cm_tool_b', small, [head(0.03 + distance / 100)]))
    collimator = [head(COLLIMATOR_DEPTH_M)]
    jobs += [
        ('collimator_tool_a', Raster(13, 0.24, 0.15), collimator),
        ('collimator_bottom_tool_b', Raster(8, 0.2, 0.12), collimator),
        ('collimator_midplane_tool_b', small, collimator),
    ]
    for name, full, metal in jobs:
        raster = replace(full, side=max(round(full.side * share), 6))
        body = 'tool_a' if name.endswith('tool_a') else 'tool_b'
        setup = setups[body]
        world = World(setup, with_metal(board, metal, setup), paths={body: raster})
        record(
            str(folder / f'{name}.mcap'), world, frames=raster.side**2, rate_hz=1.0,
            optical_rate_hz=None, errors=STATIC, rng=rng,
        )  # fmt: skip
    return Recordings(folder, "simulated by this package's own world")
