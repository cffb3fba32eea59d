"""A small exact world for the tracking tests: the drawn Anser board, and tools in its field."""

from functools import cache

import numpy as np

from anser_ros.field.model import FieldModel
from anser_ros.field.nominal import nominal_model
from anser_ros.physics.board import Board, build_board
from anser_ros.physics.sensor import SensorTable
from anser_ros.wire.points import FluxPoints
from anser_ros.wire.setup import Coil, Emitter, SensorSpec, Setup

NOISE_T = 60e-12
GEOMETRY = {
    'turns': 25, 'side_m': 0.07, 'pitch_m': 0.00075, 'layers': 2, 'thickness_m': 0.0016,
    'current_a': 0.25,
}  # fmt: skip
CENTRES_MM = (
    (-93.543, 93.543), (0.0, 68.55), (93.543, 93.543), (-68.55, 0.0),
    (68.55, 0.0), (-93.543, -93.543), (0.0, -68.55), (93.543, -93.543),
)  # fmt: skip
TURNED = (0.0, 45.0, 0.0, 45.0, 45.0, 0.0, 45.0, 0.0)
CLUSTER = tuple((0.0, 0.0, z) for z in (-0.03, 0.0, 0.03))


@cache
def anser_board() -> Board:
    """The Anser board as public sources describe it."""
    centres = np.array([(x * 1e-3, y * 1e-3, 0.0) for x, y in CENTRES_MM])
    names = [f'coil{k}' for k in range(8)]
    frequencies = [6000.0 + 170.0 * k for k in range(8)]
    return build_board(
        'square_spiral_pcb', GEOMETRY, names, centres, np.array(TURNED), frequencies
    )


@cache
def certain_model() -> FieldModel:
    """The board's dipoles, taken for exact: 144 of them, with some quadrature."""
    model = nominal_model(anser_board())
    turn = np.exp(1j * np.linspace(-0.02, 0.02, 8))
    return FieldModel(
        model.positions, model.directions, model.moments * turn, model.emitters,
        model.frequencies_hz,
    )  # fmt: skip


def three_axis(body: str, places, first: int = 0, length_m: float = 0.0) -> SensorTable:
    """Sensors at places (n, 3) in a body, each of three coils along its x, y and z."""
    names = tuple(f'{body}/{i}/{axis}' for i in range(len(places)) for axis in 'xyz')
    count = len(names)
    return SensorTable(
        channel=np.arange(first, first + count), name=names, body=(body,) * count,
        position=np.repeat(np.asarray(places), 3, axis=0),
        axis=np.tile(np.eye(3), (len(places), 1)), length=np.full(count, length_m),
    )  # fmt: skip


def triaxial_tool(body: str = 'tool_a', first: int = 0, length_m: float = 0.0) -> SensorTable:
    """Three clusters of three coils each, 30 mm apart."""
    return three_axis(body, CLUSTER, first, length_m)


def random_pose(rng: np.random.Generator, low: float = 0.1, high: float = 0.22):
    """A place over the board and any rotation."""
    position = rng.uniform([-0.11, -0.11, low], [0.11, 0.11, high])
    q = rng.normal(size=(3, 3))
    u, _, vt = np.linalg.svd(q)
    rotation = u @ vt
    return position, rotation * np.sign(np.linalg.det(rotation))


def fluxes(
    model: FieldModel,
    sensors: SensorTable,
    position: np.ndarray,
    rotation: np.ndarray,
    rng: np.random.Generator | None = None,
    noise_t: float = NOISE_T,
) -> np.ndarray:
    """What a tool's sensors read, shape (S, K), with noise when there is a generator."""
    points, axes = sensors.placed(position, rotation)
    flux = model.flux(points, axes, sensors.length)
    if rng is not None:
        flux = flux + noise_t * (rng.normal(size=flux.shape) + 1j * rng.normal(size=flux.shape))
    return flux


def flux_points(flux, flags=None, channels=None) -> FluxPoints:
    """A frame of fluxes (S, K) as acquisition sends it, of channels 0, 1, ... unless told."""
    nothing = np.full((len(flux), 3), np.nan)
    flags = np.zeros(len(flux), dtype=int) if flags is None else flags
    channels = np.arange(len(flux)) if channels is None else np.asarray(channels)
    return FluxPoints(channels, flags, flux, nothing, nothing)


def setup_of(sensors: SensorTable, references: tuple[SensorSpec, ...] = ()) -> Setup:
    """The setup document of the board with these tool sensors."""
    board = anser_board()
    coils = tuple(
        Coil(name, (float(c[0]), float(c[1]), float(c[2])), turned, frequency)
        for name, c, turned, frequency in zip(
            board.names, board.centres, TURNED, board.frequencies_hz, strict=True
        )
    )
    specs = tuple(
        SensorSpec(
            int(sensors.channel[i]), sensors.name[i], sensors.body[i],
            tuple(map(float, sensors.position[i])), tuple(map(float, sensors.axis[i])),
            float(sensors.length[i]),
        )
        for i in range(len(sensors))
    )  # fmt: skip
    return Setup('fg', 50.0, Emitter('square_spiral_pcb', GEOMETRY, coils), specs + references)
