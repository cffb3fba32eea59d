"""Bends a flat body smoothly, so that its sensors rise and turn with it.

A thin plate that is held at its rim or by a few screws is bent by fractions of a millimetre, and
otherwise wherever it is laid. Its lift ``w(x, y)`` is a polynomial without constant and linear
terms, which are a pose; its normal turns with the slope of w, as a thin plate's does (Timoshenko
and Woinowsky-Krieger, Theory of Plates and Shells, chapter 2).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.sensor import SensorTable

Array = NDArray[np.float64]

DEGREE = 4
"""Degree of the polynomial: that of a plate under an even load, whose bend has fourth powers."""
FLAT = 0.02
"""Thickness (rms) of a body's cloud of sensors, as a fraction of its extent (rms), up to which it
is a plate. A thicker body has no one surface whose lift would move all of its sensors."""


@dataclass(frozen=True)
class SmoothBend:
    """Holds what each term of a bend does to S sensors, in the body's frame."""

    normal: Array  # (3,): across the plate
    # (S, B): shift of each sensor along the normal, m per m of the term at the plate's rim
    lift: Array
    turn: Array  # (S, B, 3): rotation vector of each sensor, rad per m

    @staticmethod
    def of(sensors: SensorTable) -> 'SmoothBend | None':
        """Return the bends of a body with these sensors; None where they lie on no plate."""
        place = sensors.position - sensors.position.mean(axis=0)
        _, size, axes = np.linalg.svd(place, full_matrices=False)
        if len(size) < 3 or size[2] > FLAT * size[0] or size[1] < FLAT * size[0]:
            return None
        span = float(np.abs(place @ axes[:2].T).max())
        x, y = (place @ axes[:2].T / span).T
        powers = [(n - b, b) for n in range(2, DEGREE + 1) for b in range(n + 1)]
        if len(sensors) < 2 * len(powers):
            return None
        slopes = (
            np.stack([a * x ** max(a - 1, 0) * y**b for a, b in powers], axis=1) / span,
            np.stack([b * x**a * y ** max(b - 1, 0) for a, b in powers], axis=1) / span,
        )
        # The normal n becomes n - grad w: a turn about n x (-grad w).
        turn = sum(
            -slope[:, :, None] * np.cross(axes[2], axis)
            for slope, axis in zip(slopes, axes[:2], strict=True)
        )
        lift = np.stack([x**a * y**b for a, b in powers], axis=1)
        return SmoothBend(axes[2], lift, np.asarray(turn))

    @property
    def terms(self) -> int:
        """Return the number of terms, B."""
        return int(self.lift.shape[1])

    def shape(self, terms: Array) -> tuple[Array, Array]:
        """Return shifts and rotation vectors (F, S, 3) of the sensors for terms (F, B), m."""
        return (terms @ self.lift.T)[:, :, None] * self.normal, np.einsum(
            'fb,sbi->fsi', terms, self.turn
        )
