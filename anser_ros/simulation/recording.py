"""Simulates recordings: a world's fluxes with noise, and optical poses with jitter, in a bag.

These bags are used where no recordings of a real device are at hand; figures from them are always
called simulated.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array
from anser_ros.settings import Accuracy
from anser_ros.simulation.world import Pose, World
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.bag_writer import SessionWriter
from anser_ros.wire.recorded import optical_topic
from anser_ros.wire.setup import dump_setup

START_NS = 1_700_000_000 * SECOND_NS
"""First stamp of every recording, ns since 1970: fixed, so that a seed makes one bag."""
OPTICAL_MARGIN_S = 0.2
"""Time by which the optical poses begin before the fluxes and end after them, s."""
STATIC_NOISE_T = 30e-12
"""Flux noise of a tool at rest, T rms a component: half of a single window's by averaging."""


@dataclass(frozen=True)
class GridScan:
    """Moves a body so that it rests at one grid point after another, layer by layer."""

    count: int = 13  # points along x and along y
    span_m: float = 0.30  # edge of the square that they cover, m
    heights_m: tuple[float, ...] = (0.15,)  # height z of the body's origin in each layer, m
    dwell_s: float = 1.0  # time at each point, s
    # size of small rotations that differ from point to point, so that no two poses are parallel
    tilt_rad: float = 0.02

    @property
    def frames(self) -> int:
        """Return the number of grid points of all layers."""
        return self.count**2 * len(self.heights_m)

    def __call__(self, time_s: float) -> Pose:
        """Return the pose at a time, s."""
        index = int(np.clip(round(time_s / self.dwell_s), 0, self.frames - 1))
        layer, place = divmod(index, self.count**2)
        row, column = divmod(place, self.count)
        line = np.linspace(-self.span_m / 2, self.span_m / 2, self.count)
        tilt = self.tilt_rad * np.sin(np.array([1.0, 1.7, 2.3]) * (index + 1))
        rotation = Rotation.from_rotvec(tilt).as_matrix()
        position = np.array([line[column], line[row], self.heights_m[layer]])
        return position, np.asarray(rotation)


def _jittered(pose: Pose, errors: Accuracy, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return a pose as an optical tracker reports it: position (m) and quaternion x y z w."""
    position = pose[0] + rng.normal(scale=errors.optical_position_m, size=3)
    turn = Rotation.from_rotvec(rng.normal(scale=errors.optical_rotation_rad, size=3))
    return position, np.asarray((turn * Rotation.from_matrix(pose[1])).as_quat())


def record(
    path: str,
    world: World,
    *,
    frames: int,
    rate_hz: float,
    optical_rate_hz: float | None,
    errors: Accuracy,
    rng: np.random.Generator,
) -> None:
    """Write a session of a world into a bag, of so many flux ``frames``; raises `BagError`.

    The optical poses begin and end `OPTICAL_MARGIN_S` outside of them; without a rate of their
    own (a static recording) there is one at every flux stamp.
    """
    stamps = {(START_NS + round(i / rate_hz * SECOND_NS), i / rate_hz) for i in range(frames)}
    with SessionWriter(path) as writer:
        writer.write_setup(dump_setup(world.setup), START_NS)
        optical = _optical_times(stamps, optical_rate_hz)
        for stamp, time in sorted(stamps | optical):
            if (stamp, time) in optical:
                for body in world.setup.bodies:
                    place, turn = _jittered(world.pose(body, time), errors, rng)
                    writer.write_pose(optical_topic(body), stamp, place.tolist(), turn.tolist())
            if (stamp, time) not in stamps:
                continue
            flux = world.flux(time)
            noise = rng.normal(scale=errors.flux_noise_t, size=(*flux.shape, 2))
            flux = flux + noise[..., 0] + 1j * noise[..., 1]
            writer.write_readings(world.setup.sensors, stamp, flux)


def _optical_times(
    stamps: set[tuple[int, float]], rate_hz: float | None
) -> set[tuple[int, float]]:
    if rate_hz is None:
        return stamps
    first, last = -OPTICAL_MARGIN_S, max(stamps)[1] + OPTICAL_MARGIN_S
    times = np.arange(first, last, 1 / rate_hz)
    return {(START_NS + round(time * SECOND_NS), float(time)) for time in times}
