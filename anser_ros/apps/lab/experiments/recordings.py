"""Finds or simulates the recordings of the article's experiments, and holds what it reports. In
simulated ones the board differs slightly from the nominal one. Plates and the X-ray head are
lattices of metal balls that the board magnetises and that do not magnetise each other: rougher
than real ones, which distort the field by about as much.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array
from anser_ros.errors import BagError
from anser_ros.physics.dipole import dipole_field
from anser_ros.physics.sensor import along_each_axis
from anser_ros.sessions.session import Session, load_session
from anser_ros.settings import Accuracy
from anser_ros.simulation.recording import STATIC_NOISE_T, record
from anser_ros.simulation.world import (
    FieldSource,
    MetalBody,
    Pose,
    World,
    at_rest,
    board_source,
    manufactured,
    steel_disc,
)
from anser_ros.wire.setup import SensorSpec, Setup, parse_setup
from anser_ros.wire.text_files import read_config

STATISTICS = ('RMSE', 'ME', 'PRC50', 'PRC95')
SENSORS = ('Y', 'Z')

Column = Mapping[str, Mapping[str, float]]
"""Figures by sensor and then by statistic."""


def _column(y: tuple[float, ...], z: tuple[float, ...]) -> Column:
    return {s: dict(zip(STATISTICS, v, strict=True)) for s, v in zip(SENSORS, (y, z), strict=True)}


# Position errors of the article's new model without metal, mm.
TABLE_2_MM = {
    'Biot-Savart': _column((0.93, 0.76, 0.55, 2.04), (1.03, 0.93, 0.91, 1.69)),
    'data-driven': _column((0.28, 0.20, 0.13, 0.62), (0.23, 0.20, 0.18, 0.39)),
}
# Orientation errors of the same, degrees.
TABLE_2_DEG = {
    'Biot-Savart': _column((0.61, 0.45, 0.31, 1.43), (0.80, 0.71, 0.67, 1.32)),
    'data-driven': _column((0.23, 0.20, 0.17, 0.45), (0.21, 0.17, 0.15, 0.42)),
}
TABLE_3_FIELD = {
    'aluminium': {
        'training': {'MAE': 0.1377, 'N-MAE': 0.0085, 'RMSE': 0.1885, 'N-RMSE': 0.0116},
        'test': {'MAE': 0.2082, 'N-MAE': 0.0131, 'RMSE': 0.2854, 'N-RMSE': 0.0179},
    },
    'mu-metal': {
        'training': {'MAE': 0.7827, 'N-MAE': 0.0088, 'RMSE': 1.0817, 'N-RMSE': 0.0122},
        'test': {'MAE': 1.4106, 'N-MAE': 0.0160, 'RMSE': 1.8508, 'N-RMSE': 0.0210},
    },
}
"""Errors of the field over shields: mA/m, and percent of the range."""
# Position errors over the same shields, mm.
TABLE_3_MM = {
    'aluminium': _column((0.16, 0.11, 0.07, 0.32), (0.13, 0.11, 0.09, 0.27)),
    'mu-metal': _column((0.17, 0.12, 0.09, 0.36), (0.16, 0.14, 0.12, 0.29)),
}
# Position errors with the X-ray head below, without shield and with two of them, mm.
TABLE_4_MM = {
    'unshielded': _column((5.72, 5.28, 4.56, 9.39), (4.74, 4.37, 4.02, 7.82)),
    'aluminium': _column((0.31, 0.23, 0.16, 0.63), (0.46, 0.40, 0.36, 0.89)),
    'mu-metal': _column((0.23, 0.19, 0.16, 0.38), (0.51, 0.43, 0.33, 0.97)),
}
# Position errors between two measured planes over the X-ray head, mm.
TABLE_5_MM = {
    'uncompensated': _column((12.01, 11.71, 11.15, 17.22), (25.03, 22.87, 19.71, 46.21)),
    'compensated': _column((0.92, 0.89, 0.81, 1.33), (0.67, 0.65, 0.63, 0.94)),
    'compensated and corrected': _column((0.35, 0.34, 0.33, 0.51), (0.49, 0.47, 0.43, 0.73)),
}


HEAD_DISTANCES_CM = (30, 20, 10, 8, 6, 4, 2)
"""Distances of the X-ray head below the board, cm (article, Figs. 7 and 8)."""
MATERIALS = ('aluminium', 'mu-metal')


@dataclass(frozen=True)
class Recordings:
    """Opens a folder with one bag for each of `NAMES`."""

    folder: Path
    origin: str  # who simulated the recordings, for the report

    def load(self, name: str) -> Session:
        """Return the recording of a name; raises `BagError` when it cannot be read."""
        return load_session(self.folder / f'{name}.mcap')

    def shield(self, material: str, head: bool = False) -> Session:
        """Return the recording of tool B over a plate, with or without the X-ray head below."""
        middle = '_c_arm' if head else ''
        return self.load(f'shield_{material.replace("-", "_")}{middle}_tool_b')


def missing(folder: Path) -> list[str]:
    """Return the names of the recordings that a folder lacks."""
    return [name for name in NAMES if not (folder / f'{name}.mcap').is_file()]


def given_recordings(folder: Path) -> Recordings:
    """Return the recordings of a folder; raises `BagError` when one is missing."""
    lacking = missing(folder)
    if lacking:
        raise BagError(
            f'{folder}: {len(lacking)} of {len(NAMES)} recordings are missing, '
            f'the first is {lacking[0]}.mcap'
        )
    return Recordings(folder, 'simulated by an independent field world')


def lattice_cells(position: Array) -> Array:
    """Return numbers along x and y (F, 2) of the points (F, 3) of a square lattice."""
    where, side = position[:, :2], max(round(np.sqrt(len(position))) - 1, 1)
    low, high = np.nanmin(where, axis=0), np.nanmax(where, axis=0)
    return np.asarray(np.rint((where - low) / np.maximum(high - low, 1e-9) * side))


def checkerboard(session: Session) -> tuple[Session, Session]:
    """Return training and test points of a lattice, as on a checkerboard (article, Fig. 2)."""
    tool = session.tools[0]
    black = np.nansum(lattice_cells(tool.position), axis=1).astype(np.int64) % 2 == 0
    training, test = (
        replace(session, tools=(tool.frames(rows),), reference=None) for rows in (black, ~black)
    )
    return training, test


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
    axes = {'x': (1.0, 0.0, 0.0), 'y': (0.0, 1.0, 0.0), 'z': (0.0, 0.0, 1.0)}
    places = [(0.0, 0.0, 0.03 * (cluster - 1)) for cluster in range(3)]
    return tuple(
        SensorSpec(3 * cluster + row, f'tool_a/{cluster}/{letter}', 'tool_a', place, axis, 0.0)
        for cluster, place in enumerate(places)
        for row, (letter, axis) in enumerate(axes.items())
    )


def _tool_b() -> tuple[SensorSpec, ...]:
    return (
        SensorSpec(0, 'tool_b/y', 'tool_b', (-0.006, 0.0, 0.0), (0.0, 1.0, 0.0), 0.0082),
        SensorSpec(1, 'tool_b/z', 'tool_b', (0.006, 0.0, 0.0), (0.0, 0.0, 1.0), 0.0082),
    )


def plate(material: str) -> MetalBody:
    """Return a square plate of a material below the board."""
    ball = PLATE_EDGE_M / (2 * PLATE_BALLS)
    line = np.linspace(-PLATE_EDGE_M / 2 + ball, PLATE_EDGE_M / 2 - ball, PLATE_BALLS)
    x, y = np.meshgrid(line, line)
    offsets = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    conductivity, permeability = METALS[material]
    place = np.array([0.0, 0.0, -PLATE_DEPTH_M])
    return MetalBody(offsets, ball, conductivity, permeability, at_rest(place))


def head(depth_m: float) -> MetalBody:
    """Return the X-ray head at a depth below the board, m."""
    place = np.array([0.01, -0.01, -depth_m])
    return steel_disc(at_rest(place), radius_m=0.1, rings=4)


def with_metal(source: FieldSource, metal: Sequence[MetalBody], setup: Setup) -> FieldSource:
    """Return the field of a board together with that of the metal at rest that it magnetises."""
    tones = np.array(setup.frequencies_hz)
    if not metal:
        return source
    where = np.concatenate([body.centres(0.0) for body in metal])
    induced = np.concatenate(
        [source(body.centres(0.0)) * body.polarisability(tones) for body in metal]
    )

    dipoles = (*along_each_axis(where), induced.reshape(-1, len(tones)))
    return lambda points: source(points) + dipole_field(points, *dipoles)


def _experiments() -> list[tuple[str, Raster, list[MetalBody]]]:
    """Each experiment's name, its points, and the metal."""
    small, collimator = Raster(8, 0.2, 0.15), [head(COLLIMATOR_DEPTH_M)]
    found: list[tuple[str, Raster, list[MetalBody]]] = [
        ('factory_tool_a', Raster(31, 0.30, 0.15), []),
        ('midplane_tool_b', Raster(26, 0.25, 0.15), []),
    ]
    for material in MATERIALS:
        stem = f'shield_{material.replace("-", "_")}'
        found.append((f'{stem}_tool_b', Raster(25, 0.25, 0.15), [plate(material)]))
        found.append((f'{stem}_c_arm_tool_b', small, [plate(material), head(0.05)]))
    for distance in HEAD_DISTANCES_CM:
        found.append((f'c_arm_{distance:02d}cm_tool_b', small, [head(0.03 + distance / 100)]))
    return [
        *found,
        ('collimator_tool_a', Raster(13, 0.24, 0.15), collimator),
        ('collimator_bottom_tool_b', Raster(8, 0.2, 0.12), collimator),
        ('collimator_midplane_tool_b', small, collimator),
    ]


EXPERIMENTS = _experiments()
NAMES = tuple(name for name, *_ in EXPERIMENTS)


def simulate_recordings(folder: Path, seed: int, share: float = 1.0) -> Recordings:
    """Write a bag for every experiment into a folder.

    ``seed``: of the board's errors and of the noise. ``share``: points along a lattice's side as a
    fraction of the article's; at least six are left.
    """
    rng = np.random.default_rng(seed)
    drawn = replace(parse_setup(read_config('demo_setup.yaml')), flux_rate_hz=1.0)
    board = board_source(manufactured(drawn, rng))
    setups = {
        'tool_a': replace(drawn, sensors=_tool_a()),
        'tool_b': replace(drawn, sensors=_tool_b()),
    }
    for name, full, metal in EXPERIMENTS:
        raster = replace(full, side=max(round(full.side * share), 6))
        body = 'tool_a' if name.endswith('tool_a') else 'tool_b'
        setup = setups[body]
        world = World(setup, with_metal(board, metal, setup), paths={body: raster})
        record(
            str(folder / f'{name}.mcap'), world, frames=raster.side**2, rate_hz=1.0,
            optical_rate_hz=None, errors=STATIC, rng=rng,
        )  # fmt: skip
    return Recordings(folder, "simulated by this package's own world")
