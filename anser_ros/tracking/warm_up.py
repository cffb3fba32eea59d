"""Compiles, or loads from the cache, every kernel of tracking before the first frame needs it."""

import numpy as np

from anser_ros.field.model import FieldModel
from anser_ros.physics.sensor import SensorTable
from anser_ros.physics.volume import TrackedVolume
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.tracker import Tracker


def warm_up() -> None:
    """Track a small made-up tool until its motion is carried on, with and without uncertainty."""
    side = np.linspace(-0.1, 0.1, 3)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    positions = np.stack([x, y, np.zeros(9)], axis=1)
    directions = np.tile([0.0, 0.0, 1.0], (9, 1))
    names = tuple(f'coil{k}' for k in range(9))
    moments = 0.02 * np.eye(9, dtype=np.complex128)
    modes = np.stack([1e-4 * moments, 1e-4j * moments])
    sensors = SensorTable(
        channel=np.arange(3),
        name=('a', 'b', 'c'),
        body=('tool', 'tool', 'tool'),
        position=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.01], [0.0, 0.01, 0.0]]),
        axis=np.eye(3),
        length=np.array([0.0, 0.008, 0.0]),
    )
    settings = TrackerSettings(volume=TrackedVolume((-0.1, -0.1, 0.1), (0.1, 0.1, 0.2)))
    for uncertainty in (None, modes):
        model = FieldModel(
            positions, directions, moments, names, tuple(1000.0 + k for k in range(9)), 0.0,
            uncertainty,
        )  # fmt: skip
        rng = np.random.default_rng(0)
        flux = model.flux(sensors.position + [0.01, 0.02, 0.15], sensors.axis, sensors.length)
        tracker = Tracker(model, sensors, settings)
        for stamp_ns in (1, 2, 3):
            # New noise each time, for a reading that repeats is no reading.
            noise = settings.flux_noise_t * rng.standard_normal((2, *flux.shape))
            tracker.update(stamp_ns, sensors.channel, flux + noise[0] + 1j * noise[1])
