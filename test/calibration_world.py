"""Small worlds for the tests of calibration: coils as dipoles, tools on a lattice, jitter."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.calibration.dipole_sites import DipoleSites
from anser_ros.calibration.layouts import Generator
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.sensor import SensorTable

NOISE_T = 40e-12
JITTER_M = 0.07e-3
JITTER_RAD = 0.4e-3
CENTRES = np.array([[-0.07, -0.07, 0.0], [0.07, -0.07, 0.0], [0.0, 0.08, 0.0]])


@dataclass(frozen=True)
class Scene:
    """Measurements with the poses as the optics gave them, and the truth."""

    measurements: Measurements
    position: np.ndarray
    rotation: np.ndarray
    dipoles: DipoleSites
    moments: np.ndarray
    generator: Generator

    def flux(self, points, axes, lengths=None):
        """True flux (P, K)."""
        basis = flux_basis(points, axes, lengths, self.dipoles.positions, self.dipoles.directions)
        return basis @ self.moments


def tool(length=0.0):
    """Two triaxial clusters 40 mm apart."""
    axes = np.tile(np.eye(3), (2, 1))
    place = np.repeat([[0.0, 0.0, -0.02], [0.0, 0.0, 0.02]], 3, axis=0)
    names = tuple(f'tool/{i // 3}/{"xyz"[i % 3]}' for i in range(6))
    return SensorTable(np.arange(6), names, ('tool',) * 6, place, axes, np.full(6, length))


def scene(rng, side=9, jitter=1.0, sensors=None, noise=NOISE_T, height=0.14):
    """Three emitters, each seven dipoles around its centre, complex moments."""
    around = rng.uniform(-0.03, 0.03, (3, 7, 3)) * [1, 1, 0.1]
    positions = (CENTRES[:, None] + around).reshape(-1, 3)
    directions = rng.normal(size=(21, 3)) * 0.2 + [0, 0, 1]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    moments = np.zeros((21, 3), dtype=complex)
    for k in range(3):
        moments[7 * k : 7 * k + 7, k] = rng.uniform(0.005, 0.01, 7) * (1.0 + 0.05j)
    dipoles = DipoleSites(positions, directions)
    table = tool() if sensors is None else sensors
    line = np.linspace(-0.1, 0.1, side)
    x, y = np.meshgrid(line, line)
    position = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    position += rng.uniform(-0.004, 0.004, position.shape)
    rotation = Rotation.from_rotvec(rng.normal(scale=0.02, size=position.shape)).as_matrix()
    points, axes = table.placed(position, rotation)
    lengths = np.tile(table.length, len(position))
    basis = flux_basis(points.reshape(-1, 3), axes.reshape(-1, 3), lengths, positions, directions)
    flux = (basis @ moments).reshape(len(position), len(table), 3)
    flux = flux + noise * (rng.normal(size=flux.shape) + 1j * rng.normal(size=flux.shape))
    seen = position + jitter * JITTER_M * rng.normal(size=position.shape)
    turn = Rotation.from_rotvec(jitter * JITTER_RAD * rng.normal(size=position.shape)).as_matrix()
    count = len(position)
    measurements = Measurements(
        body='tool',
        sensors=table,
        time=np.arange(count, dtype=float),
        flux=flux,
        valid=np.ones((count, len(table)), dtype=bool),
        flags=np.zeros((count, len(table)), dtype=np.int64),
        position=seen,
        rotation=turn @ rotation,
        has_pose=np.ones(count, dtype=bool),
    )
    generator = Generator(CENTRES, np.zeros(3), 0.07)
    return Scene(measurements, position, rotation, dipoles, moments, generator)
