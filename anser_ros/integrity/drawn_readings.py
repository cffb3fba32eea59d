"""Predicts what sensors read over a drawn board, with its slopes by place, direction and coils."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.nominal import Tolerances

Array = NDArray[np.float64]
FieldAt = Callable[[Array], Array]
"""Drawn field at points (P, 3) in m, frame fg: (P, K, 3) in T."""

STEP_M = 1e-5
"""Step (m) of the differences by which the field changes with place."""
FREE_GAIN = 0.1
"""Deviation of an emitter's strength from its drawing, which is not judged here: a meter of the
current that is 10 % off is another fault."""


@dataclass(frozen=True)
class DrawnReadings:
    """Holds in-phase fluxes (S, K), T, of S sensors over a drawn board of K coils, with
    derivatives.

    The sensors are at points (S, 3), m, with unit axes (S, 3), frame fg; the derivatives (3, S, K)
    are by the place, T/m, and by the axis' vector, T.
    """

    points: Array
    axes: Array
    flux: Array
    by_place: Array
    by_axis: Array

    @staticmethod
    def of(field: FieldAt, points: Array, axes: Array, lengths: Array) -> 'DrawnReadings':
        """Return readings of sensors of some lengths (S,), m, by Gauss' two points."""
        ends = lengths[:, None] / np.sqrt(12.0) * axes

        def mean(places: Array) -> Array:
            return np.asarray(0.5 * (field(places + ends) + field(places - ends)))

        here = mean(points)
        slopes = [(mean(points + STEP_M * e) - here) / STEP_M for e in np.eye(3)]
        along = [np.einsum('ski,si->sk', values, axes) for values in (here, *slopes)]
        by_axis = np.moveaxis(here, 2, 0)
        return DrawnReadings(points, axes, along[0], np.array(along[1:]), by_axis)

    def turned(self, about: Array) -> Array:
        """Return the derivative by turns of all sensors at a point about x, y, z, (3, S, K)."""
        eye = np.eye(3)
        moved = np.cross(eye[:, None, :], self.points - about)
        twisted = np.cross(eye[:, None, :], self.axes)
        return np.asarray(
            np.einsum('rsi,isk->rsk', moved, self.by_place)
            + np.einsum('rsi,isk->rsk', twisted, self.by_axis)
        )

    def by_manufacture(self, centres: Array) -> Array:
        """Return what each coil's deviation from its drawing does, (6 K, S, K), T a standard
        deviation.

        Six a coil: its strength, its place along x, y and z, its tilt about x and y.
        """
        made, (sensors, count) = Tolerances(), self.flux.shape
        out = np.zeros((6 * count, sensors, count))
        for k in range(count):
            own = out[6 * k : 6 * (k + 1), :, k]
            own[0] = FREE_GAIN * self.flux[:, k]
            own[1:4] = made.shift_m * self.by_place[:, :, k]
            own[4:6] = made.tilt_rad * self.turned(centres[k])[:2, :, k]
        return out
