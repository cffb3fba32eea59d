"""Simulates the world around a control unit: a board, moving tools, reference coils and metal.

It gives the true flux of every sensor at any time. Samples, noise and bytes are added elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.dipole import GAUSS_OFFSET, flux_basis
from anser_ros.simulation.metal import MetalBody
from anser_ros.simulation.motion import Path, Pose, tool_paths
from anser_ros.wire.setup import FIELD_GENERATOR, SensorRows, SensorSpec, Setup

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
FieldSource = Callable[[Array], ComplexArray]
"""A function from points (P, 3), m, to each emitter's field at nominal current (P, 3, K), T."""


class World:
    """Holds the sensors of a setup in the field of a board and of metal.

    ``setup``: the sensors and the bodies that they are on. ``source``: field of the emitters
    without metal. ``paths``: pose of each moving body over time; a body without one moves on a
    default path. ``metal``: bodies that distort the field.
    """

    def __init__(
        self,
        setup: Setup,
        source: FieldSource,
        *,
        paths: Mapping[str, Path] | None = None,
        metal: Sequence[MetalBody] = (),
    ) -> None:
        self.setup = setup
        self.sensors = setup.sensors
        self._source = source
        self._metal = tuple(metal)
        tones = np.array(setup.frequencies_hz)
        self._polarisability = [body.polarisability(tones) for body in self._metal]
        self._paths: dict[str, Path] = {**tool_paths(setup.bodies), **dict(paths or {})}
        self._groups = _by_body(self.sensors)
        _, self._local, self._local_axes = SensorRows.of(self.sensors)
        self._lengths = np.array([s.length_m for s in self.sensors])
        fixed = self._groups.pop(FIELD_GENERATOR, np.zeros(0, np.intp))
        self._moving = np.concatenate([np.zeros(0, np.intp), *self._groups.values()])
        self._still = np.zeros((len(self.sensors), len(tones)), complex)
        if fixed.size:
            ends = self._coil_ends(fixed, self._local, self._local_axes)
            self._still[fixed] = _linked(source(ends), self._local_axes[fixed])

    def pose(self, body: str, time_s: float) -> Pose:
        """Return the true pose of a moving body at a time."""
        return self._paths[body](time_s)

    def flux(self, time_s: float) -> ComplexArray:
        """Return the flux of every sensor in the setup's order, (S, K), T at nominal current."""
        flux = self._still.copy()
        if not (self._moving.size or self._metal):
            return flux
        centres, axes = self._placed(time_s)
        ends = self._coil_ends(self._moving, centres, axes)
        spheres = [body.centres(time_s) for body in self._metal]
        # One call for all points costs a third of three calls.
        field = self._source(np.concatenate([ends, *spheres]))
        flux[self._moving] = _linked(field[: len(ends)], axes[self._moving])
        begin = len(ends)
        for points, polarisability in zip(spheres, self._polarisability, strict=True):
            moments = field[begin : begin + len(points)] * polarisability
            flux += self._induced(centres, axes, points, moments)
            begin += len(points)
        return flux

    def _placed(self, time_s: float) -> tuple[Array, Array]:
        """Return the centres (m) and axes of all coils in fg, each of shape (S, 3)."""
        centres, axes = self._local.copy(), self._local_axes.copy()
        for body, rows in self._groups.items():
            position, rotation = self.pose(body, time_s)
            centres[rows] = position + self._local[rows] @ rotation.T
            axes[rows] = self._local_axes[rows] @ rotation.T
        return centres, axes

    def _coil_ends(self, rows: NDArray[np.intp], centres: Array, axes: Array) -> Array:
        """Return the quadrature points of some coils, all upper ones first; centres of points."""
        if not self._lengths[rows].any():
            return np.asarray(centres[rows])
        reach = GAUSS_OFFSET * self._lengths[rows, None] * axes[rows]
        return np.concatenate([centres[rows] + reach, centres[rows] - reach])

    def _induced(
        self, centres: Array, axes: Array, spheres: Array, moments: ComplexArray
    ) -> ComplexArray:
        """Return the flux (S, K), T, of moments (M, 3, K), A m^2, at the spheres' centres."""
        flux = np.zeros_like(self._still)
        for component, unit in enumerate(np.eye(3)):
            directions = np.broadcast_to(unit, spheres.shape)
            basis = flux_basis(centres, axes, self._lengths, spheres, directions)
            flux += basis @ moments[:, component]
        return flux


def _linked(field: ComplexArray, axes: Array) -> ComplexArray:
    """Return the flux along axes (S, 3) of the field (S or 2 S, 3, K) at quadrature points."""
    if len(field) > len(axes):
        field = (field[: len(axes)] + field[len(axes) :]) / 2
    return np.asarray(np.einsum('pi,pik->pk', axes, field))


def _by_body(sensors: Sequence[SensorSpec]) -> dict[str, NDArray[np.intp]]:
    bodies = dict.fromkeys(sensor.body for sensor in sensors)
    return {
        body: np.array([row for row, s in enumerate(sensors) if s.body == body], np.intp)
        for body in bodies
    }
