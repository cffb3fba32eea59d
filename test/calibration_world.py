"""Small worlds for the tests of calibration: coils as dipoles, tools on a lattice, jitter."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from tracking_world import three_axis

from anser_ros.calibration.layouts import Generator
from anser_ros.calibration.readings import DipoleSites
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.rotations import tilted
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


@dataclass(frozen=True)
class Errors:
    """What is wrong with a scan that a hand made.

    Spreads of the gains (relative), axes (rad) and places (m), a lever arm (m), how late the
    optical tracker's stamps are (s), its jitter relative to the usual, and the share of its poses
    that are reflected.
    """

    gain: float = 0.004
    axis: float = 0.008
    place_m: float = 0.12e-3
    lever_m: tuple = (0.3e-3, -0.4e-3, 0.2e-3)
    offset_s: float = 0.018
    jitter: float = 1.0
    reflected: float = 0.003


@dataclass(frozen=True)
class Truth:
    """The errors that a scan has, by the rules for what no data tell."""

    gain: np.ndarray
    axis: np.ndarray
    place: np.ndarray
    lever: np.ndarray


def hand(time, turn_rad=0.6, flat=False):
    """A hand's path through the volume, with turns; a flat one turns about z only."""
    waves = [np.sin(w * time + p) for w, p in ((0.9, 0.0), (1.3, 1.0), (1.7, 2.0))]
    position = np.stack(waves, axis=1) * [0.09, 0.09, 0.03] + [0.0, 0.0, 0.14]
    turns = [np.sin(w * time + p) for w, p in ((0.7, 2.0), (1.1, 0.5), (0.8, 1.0))]
    turn = turn_rad * np.stack(turns, axis=1)
    if flat:
        position[:, 2], turn[:, :2] = 0.14, 0.0
    return position, Rotation.from_rotvec(turn)


def moved_scan(world, table, rng, seconds, errors, turn_rad=0.6, flat=False):
    """A scan at 25 Hz by a tool with these errors, and the truth about them."""
    count = len(table)
    gain = 1 + errors.gain * (rng.normal(size=count) + 1.25j * rng.normal(size=count))
    gain *= 1 / gain.mean()
    gain /= np.abs(gain).mean()
    axis = tilted(table.axis, errors.axis * rng.normal(size=(count, 2)))
    place = errors.place_m * rng.normal(size=(count, 3))
    lever = np.array(errors.lever_m) + (place.mean(axis=0) if count == 1 else 0.0)
    place -= place.mean(axis=0)
    time = np.arange(round(25.0 * seconds)) / 25.0
    position, turn = hand(time, turn_rad, flat)
    points, axes = replace(table, position=table.position + place + lever, axis=axis).placed(
        position, turn.as_matrix()
    )
    flux = world.flux(points.reshape(-1, 3), axes.reshape(-1, 3)).reshape(time.size, count, -1)
    flux = flux * gain[:, None]
    flux = flux + NOISE_T * (rng.normal(size=flux.shape) + 1j * rng.normal(size=flux.shape))
    seen = np.arange(-0.3, time[-1] + 0.3, 1 / 60.0)
    there, turned = hand(seen, turn_rad, flat)
    there += errors.jitter * JITTER_M * rng.normal(size=there.shape)
    jitter = Rotation.from_rotvec(errors.jitter * JITTER_RAD * rng.normal(size=there.shape))
    there[rng.uniform(size=seen.size) < errors.reflected] += [0.02, -0.01, 0.015]
    track = PoseTrack(seen - errors.offset_s, there, (jitter * turned).as_quat())
    at, rotation, has_pose = track.at(time)
    told = replace(
        world.measurements, sensors=table, time=time, flux=flux, position=at, rotation=rotation,
        has_pose=has_pose, track=track, valid=np.ones((time.size, count), dtype=bool),
        flags=np.zeros((time.size, count), dtype=np.int64),
    )  # fmt: skip
    return told, Truth(gain, axis, place, lever)


def tool_of(count):
    """A tool of so many coils: triaxial clusters 30 mm apart, the last one perhaps not whole."""
    index = np.arange(count)
    place = np.stack([0.0 * index, 0.01 * (index // 3 % 2), 0.03 * (index // 3 - 1.0)], axis=1)
    axes = np.eye(3)[index % 3]
    names = tuple(f'tool/{i // 3}/{"xyz"[i % 3]}' for i in range(count))
    return SensorTable(index, names, ('tool',) * count, place, axes, np.zeros(count))


def tool(length=0.0):
    """Two triaxial clusters 40 mm apart."""
    return three_axis('tool', [[0.0, 0.0, -0.02], [0.0, 0.0, 0.02]], length_m=length)


def scene(rng, side=9, jitter=1.0, sensors=None, noise=NOISE_T, height=0.14, centres=CENTRES):
    """Emitters, three by default, each seven dipoles around its centre, complex moments."""
    emitters = len(centres)
    around = rng.uniform(-0.03, 0.03, (emitters, 7, 3)) * [1, 1, 0.1]
    positions = (centres[:, None] + around).reshape(-1, 3)
    directions = rng.normal(size=(7 * emitters, 3)) * 0.2 + [0, 0, 1]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    moments = np.zeros((7 * emitters, emitters), dtype=complex)
    for k in range(emitters):
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
    flux = (basis @ moments).reshape(len(position), len(table), emitters)
    flux = flux + noise * (rng.normal(size=flux.shape) + 1j * rng.normal(size=flux.shape))
    seen = position + jitter * JITTER_M * rng.normal(size=position.shape)
    turn = Rotation.from_rotvec(jitter * JITTER_RAD * rng.normal(size=position.shape)).as_matrix()
    count = len(position)
    measurements = Measurements(
        body='tool', sensors=table, time=np.arange(count, dtype=float), flux=flux,
        valid=np.ones((count, len(table)), dtype=bool),
        flags=np.zeros((count, len(table)), dtype=np.int64), position=seen,
        rotation=turn @ rotation, has_pose=np.ones(count, dtype=bool),
    )  # fmt: skip
    generator = Generator(centres, np.zeros(emitters), 0.07)
    return Scene(measurements, position, rotation, dipoles, moments, generator)
