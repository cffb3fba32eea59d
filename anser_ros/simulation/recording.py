"""Recorded sessions of our own world: fluxes with noise, optical poses with jitter, in a bag.

These bags stand in where nobody else's are at hand. They are simulated, and nothing measured on
them is called anything else.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.simulation.motion import Pose
from anser_ros.simulation.world import World
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.points import FluxPoints, encode_flux
from anser_ros.wire.setup import FIELD_GENERATOR, SensorSpec, dump_setup

Array = NDArray[np.float64]
SECOND_NS = 1_000_000_000
START_NS = 1_700_000_000 * SECOND_NS


@dataclass(frozen=True)
class Errors:
    """What the instruments of a recording get wrong.

    Attributes
    ----------
    flux_noise_t : standard deviation of each phasor component, T
    optical_jitter_m, optical_jitter_rad : of each axis of the optical pose
    """

    flux_noise_t: float = 60e-12
    optical_jitter_m: float = 0.07e-3
    optical_jitter_rad: float = 0.4e-3


@dataclass(frozen=True)
class GridScan:
    """A body that rests at one point after another, row by row and layer by layer.

    Attributes
    ----------
    count : points along x and along y
    span_m : edge of the square that they cover
    heights_m : z of the body's origin in each layer
    dwell_s : time at each point
    tilt_rad : small seeded turns at each point, so that no two poses are parallel
    """

    count: int = 13
    span_m: float = 0.30
    heights_m: tuple[float, ...] = (0.15,)
    dwell_s: float = 1.0
    tilt_rad: float = 0.02

    @property
    def frames(self) -> int:
        """Number of points."""
        return self.count**2 * len(self.heights_m)

    def __call__(self, time_s: float) -> Pose:
        """Pose at a time."""
        index = int(np.clip(round(time_s / self.dwell_s), 0, self.frames - 1))
        layer, place = divmod(index, self.count**2)
        row, column = divmod(place, self.count)
        line = np.linspace(-self.span_m / 2, self.span_m / 2, self.count)
        tilt = self.tilt_rad * np.sin(np.array([1.0, 1.7, 2.3]) * (index + 1))
        rotation = Rotation.from_rotvec(tilt).as_matrix()
        position = np.array([line[column], line[row], self.heights_m[layer]])
        return position, np.asarray(rotation)


def _cloud(sensors: tuple[SensorSpec, ...], flux: NDArray[np.complex128]) -> FluxPoints:
    moves = np.array([sensor.body != FIELD_GENERATOR for sensor in sensors])[:, None]
    position = np.array([sensor.position_m for sensor in sensors])
    axis = np.array([sensor.axis for sensor in sensors])
    return FluxPoints(
        channel=np.array([sensor.channel for sensor in sensors]),
        flags=np.zeros(len(sensors), dtype=np.int64),
        flux=flux,
        position=np.where(moves, np.nan, position),
        axis=np.where(moves, np.nan, axis),
    )


def _jittered(pose: Pose, errors: Errors, rng: np.random.Generator) -> tuple[Array, Array]:
    """Position and quaternion of a pose as an optical tracker reports it."""
    position = pose[0] + rng.normal(scale=errors.optical_jitter_m, size=3)
    turn = Rotation.from_rotvec(rng.normal(scale=errors.optical_jitter_rad, size=3))
    return position, np.asarray((turn * Rotation.from_matrix(pose[1])).as_quat())


def record(
    path: str,
    world: World,
    *,
    frames: int,
    rate_hz: float,
    optical_rate_hz: float | None,
    errors: Errors,
    rng: np.random.Generator,
) -> None:
    """Write a session of a world into a bag.

    Parameters
    ----------
    path : str
        The ``.mcap`` file; it must not exist yet.
    frames, rate_hz : number of flux windows and their rate
    optical_rate_hz : float or None
        Rate of the optical tracker on its own clock, which starts 0.2 s earlier and ends 0.2 s
        later; None for one pose at every flux stamp (a static recording).
    errors : Errors
    rng : numpy Generator

    Raises
    ------
    BagError
        When the file exists or can't be written.
    """
    sensors = world.setup.sensors
    tool_rows = np.array([s.body != FIELD_GENERATOR for s in sensors])
    groups = (('tool', tool_rows), ('reference', ~tool_rows))
    stamps = {(START_NS + round(i / rate_hz * SECOND_NS), i / rate_hz) for i in range(frames)}
    with SessionWriter(path) as writer:
        writer.write_setup(dump_setup(world.setup), START_NS)
        optical = _optical_times(stamps, optical_rate_hz)
        for stamp, time in sorted(stamps | optical):
            if (stamp, time) in optical:
                for body in world.setup.bodies:
                    pose = _jittered(world.pose(body, time), errors, rng)
                    writer.write_pose(f'/optical/{body}/pose', stamp, *pose)
            if (stamp, time) not in stamps:
                continue
            flux = world.flux(time)
            noise = rng.normal(scale=errors.flux_noise_t, size=(*flux.shape, 2))
            flux = flux + noise[..., 0] + 1j * noise[..., 1]
            for name, rows in groups:
                if rows.any():
                    listed = tuple(s for s, keep in zip(sensors, rows, strict=True) if keep)
                    fields, step, data = encode_flux(_cloud(listed, flux[rows]))
                    topic = f'/anser/{name}/flux'
                    writer.write_flux(topic, stamp, fields, step, len(listed), data)


def _optical_times(
    stamps: set[tuple[int, float]], rate_hz: float | None
) -> set[tuple[int, float]]:
    if rate_hz is None:
        return stamps
    first, last = -0.2, max(stamps)[1] + 0.2
    times = np.arange(first, last, 1 / rate_hz)
    return {(START_NS + round(time * SECOND_NS), float(time)) for time in times}
