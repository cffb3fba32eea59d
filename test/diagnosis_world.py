"""A small session in memory: a sheet of dipoles, one tool of two clusters, references, jitter."""

from dataclasses import dataclass

import numpy as np
from injection_subject import JITTER_M, JITTER_RAD, NOISE_T, Subject
from scipy.spatial.transform import Rotation
from tracking_world import three_axis

from anser_ros.field.measurements import Measurements
from anser_ros.field.model import FieldModel
from anser_ros.physics.pose_track import PoseTrack
from anser_ros.physics.sensor import SensorTable


def board(emitters: int = 4) -> FieldModel:
    """Vertical dipoles under square coils, smooth over their area."""
    line = np.linspace(-0.12, 0.12, 7)
    places = np.array([(x, y, 0.0) for x in line for y in line])
    centres = 0.07 * np.array([(-1, -1), (1, -1), (-1, 1), (1, 1)])[:emitters]
    distance = np.linalg.norm(places[:, None, :2] - centres[None], axis=2)
    moments = 0.02 * np.exp(-((distance / 0.045) ** 2))
    return FieldModel(
        positions=places,
        directions=np.tile([0.0, 0.0, 1.0], (len(places), 1)),
        moments=moments.astype(complex),
        emitters=tuple(f'coil{k}' for k in range(emitters)),
        frequencies_hz=tuple(6000.0 + 170.0 * k for k in range(emitters)),
    )


def tool_sensors() -> SensorTable:
    """Two triaxial clusters, 30 mm apart."""
    return three_axis('tool', [[0.0, 0.0, -0.015], [0.0, 0.0, 0.015]])


def reference_sensors(count: int = 12) -> SensorTable:
    """Coils around the board, in seeded directions."""
    rng = np.random.default_rng(5)
    angle = 2 * np.pi * np.arange(count) / count
    place = np.stack([0.16 * np.cos(angle), 0.16 * np.sin(angle), np.full(count, 0.03)], axis=1)
    axes = rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    names = tuple(f'ref{i}' for i in range(count))
    lengths = np.full(count, 0.008)
    return SensorTable(100 + np.arange(count), names, ('fg',) * count, place, axes, lengths)


@dataclass
class World(Subject):
    """What a test changes before it builds the problem."""

    true_track: PoseTrack

    def true_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Position and rotation without jitter at the flux stamps."""
        position, rotation, _ = self.true_track.at(self.tool.time, 1.0)
        return position, rotation


def _path(time: np.ndarray) -> tuple[np.ndarray, Rotation]:
    swing = np.array([0.09, 0.09, 0.03]) * _waves(time, [0.9, 1.27, 0.61], [0.0, 0.5, 0.0])
    turn = np.array([0.5, 0.5, 0.8]) * _waves(time, [0.7, 0.83, 0.47], [0.0, 1.0, 0.0])
    return swing + [0.0, 0.0, 0.15], Rotation.from_rotvec(turn)


def _waves(time: np.ndarray, rates: list[float], phases: list[float]) -> np.ndarray:
    return np.sin(np.outer(time, rates) + phases)


def world(seed: int = 0, frames: int = 500, emitters: int = 4) -> World:
    """A clean session at 25 Hz with an optical tracker at 60 Hz."""
    rng = np.random.default_rng(seed)
    model, sensors, fixed = board(emitters), tool_sensors(), reference_sensors()
    dipoles = model.dipoles
    time = np.arange(frames) / 25.0
    position, turn = _path(time)
    centres, axes = sensors.placed(position, turn.as_matrix())
    flux = dipoles.flux(centres.reshape(-1, 3), axes.reshape(-1, 3), None)
    flux = flux.reshape(frames, len(sensors), -1)
    clean = dipoles.flux(fixed.position, fixed.axis, fixed.length)
    readings = np.broadcast_to(clean, (frames, *clean.shape))
    optical = np.arange(-0.2, time[-1] + 0.2, 1 / 60)
    seen, seen_turn = _path(optical)
    true_track = PoseTrack(optical, seen, seen_turn.as_quat())
    jitter = Rotation.from_rotvec(rng.normal(scale=JITTER_RAD, size=(optical.size, 3)))
    shaken = seen + rng.normal(scale=JITTER_M, size=seen.shape)
    track = PoseTrack(optical, shaken, (jitter * seen_turn).as_quat())
    at, rotation, valid = track.at(time, 0.25)
    tool = Measurements(
        'tool', sensors, time, flux + _noise(rng, flux.shape), np.ones(flux.shape[:2], bool),
        np.zeros(flux.shape[:2], np.int64), at, rotation, valid, track,
    )  # fmt: skip
    reference = Measurements(
        'fg', fixed, time, readings + _noise(rng, readings.shape),
        np.ones(readings.shape[:2], bool), np.zeros(readings.shape[:2], np.int64),
        np.zeros((frames, 3)), np.broadcast_to(np.eye(3), (frames, 3, 3)), np.ones(frames, bool),
    )  # fmt: skip
    return World(tool, reference, clean, model, model, dipoles, true_track)


def _noise(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return NOISE_T * (rng.normal(size=shape) + 1j * rng.normal(size=shape))
