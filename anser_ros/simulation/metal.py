"""Simulates metal bodies as rigid clouds of conducting and permeable spheres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.metal.sphere import sphere_polarisability
from anser_ros.simulation.motion import Approach, Path

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class MetalBody:
    """Moves a rigid cloud of equal spheres, which do not drive each other, on a path."""

    offsets: Array  # (M, 3): centres of the spheres in the body's frame, m
    # radius_m, conductivity_s_per_m, relative_permeability: radius (m), conductivity (S/m) and
    # relative permeability of each sphere
    radius_m: float
    conductivity_s_per_m: float
    relative_permeability: float
    path: Path  # pose of the body over time

    def centres(self, time_s: float) -> Array:
        """Return the centres of the spheres at a time, shape (M, 3), m, frame fg."""
        position, rotation = self.path(time_s)
        return np.asarray(position + self.offsets @ rotation.T)

    def polarisability(self, frequencies_hz: Array) -> ComplexArray:
        """Return the polarisability of one sphere at each drive tone, shape (K,), A m^2 / T."""
        return sphere_polarisability(
            self.radius_m,
            self.conductivity_s_per_m,
            self.relative_permeability,
            2 * np.pi * frequencies_hz,
        )


def steel_disc(path: Path | None = None, *, radius_m: float = 0.06, rings: int = 3) -> MetalBody:
    """Return a disc of touching steel balls, like the foot of a stand or the head of a C-arm.

    ``path``: pose over time; by default it approaches and leaves again. ``radius_m``: radius of
    the disc, m. ``rings``: rings of balls around the one in the middle.
    """
    ball = radius_m / (2 * rings + 1)
    centres = [np.zeros(3)]
    for ring in range(1, rings + 1):
        angles = 2 * np.pi * np.arange(6 * ring) / (6 * ring)
        circle = 2 * ball * ring * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
        centres += list(circle)
    return MetalBody(np.array(centres), ball, 5e6, 200.0, path or Approach())
