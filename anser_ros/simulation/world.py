"""The world around a control unit: a board, tools that move, reference coils and metal.

It gives the true flux of every sensor at any time; nothing here knows of samples, noise or bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from anser_ros.physics.dipole import GAUSS_OFFSET, flux_basis
from anser_ros.simulation.metal import MetalBody
from anser_ros.simulation.motion import Lissajous, Path, Pose
from anser_ros.wire.setup import FIELD_GENERATOR, SensorSpec, Setup

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
FieldSource = Callable[[Array], ComplexArray]
"""Field of each emitter at nominal current: points (P, 3), m, to (P, 3, K), T."""


class World:
    """Sensors of a setup in the field of a board.

    Parameters
    ----------
    setup : which sensors there are, on which bodies
    source : field of the emitters without metal
    paths : pose of each moving body over time; a body without one moves on a default path
    metal : bodies that distort the field
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
        given = dict(paths or {})
        self._paths: dict[str, Path] = {
            body: given.get(body) or Lissajous(phase_rad=0.7 * rank)
            for rank, body in enumerate(setup.bodies)
        }
        self._groups = _by_body(self.sensors)
        self._fixed = self._board_flux(FIELD_GENERATOR, (np.zeros(3), np.eye(3)))

    def pose(self, body: str, time_s: float) -> Pose:
        """True pose of a body that moves."""
        return self._paths[body](time_s)

    def flux(self, time_s: float) -> ComplexArray:
        """Flux of every sensor of the setup, in its order, shape (S, K), T at nominal current."""
        flux = np.zeros((len(self.sensors), len(self.setup.emitter.coils)), complex)
        induced = self._induced(time_s)
        for body in self._groups:
            fixed = body == FIELD_GENERATOR
            pose = (np.zeros(3), np.eye(3)) if fixed else self.pose(body, time_s)
            rows = self._groups[body]
            flux[rows] = self._fixed if fixed else self._board_flux(body, pose)
            if induced is not None:
                flux[rows] += self._metal_flux(body, pose, *induced)
        return flux

    def _induced(self, time_s: float) -> tuple[Array, ComplexArray] | None:
        """Sphere centres (M, 3), m, and their moments (M, 3, K), A m^2; None without metal."""
        if not self._metal:
            return None
        centres = [body.centres(time_s) for body in self._metal]
        moments = [
            self._source(points) * polarisability
            for points, polarisability in zip(centres, self._polarisability, strict=True)
        ]
        return np.concatenate(centres), np.concatenate(moments)

    def _board_flux(self, body: str, pose: Pose) -> ComplexArray:
        rows = self._groups.get(body)
        if rows is None:
            return np.zeros((0, len(self.setup.emitter.coils)), complex)
        centres, axes, lengths = self._placed(rows, pose)
        reach = GAUSS_OFFSET * lengths[:, None] * axes
        ends = (self._source(centres + reach) + self._source(centres - reach)) / 2
        return np.asarray(np.einsum('pi,pik->pk', axes, ends))

    def _metal_flux(
        self, body: str, pose: Pose, spheres: Array, moments: ComplexArray
    ) -> ComplexArray:
        centres, axes, lengths = self._placed(self._groups[body], pose)
        flux = np.zeros((len(centres), moments.shape[2]), complex)
        for component, unit in enumerate(np.eye(3)):
            directions = np.broadcast_to(unit, spheres.shape)
            basis = flux_basis(centres, axes, lengths, spheres, directions)
            flux += basis @ moments[:, component]
        return flux

    def _placed(self, rows: NDArray[np.intp], pose: Pose) -> tuple[Array, Array, Array]:
        """Centres, axes (S, 3) in fg and lengths (S,) of the coils of a body with a pose."""
        position, rotation = pose
        coils = [self.sensors[row] for row in rows]
        centres = position + np.array([c.position_m for c in coils]) @ rotation.T
        axes = np.array([c.axis for c in coils]) @ rotation.T
        return centres, axes, np.array([c.length_m for c in coils])


def _by_body(sensors: Sequence[SensorSpec]) -> dict[str, NDArray[np.intp]]:
    bodies = dict.fromkeys(sensor.body for sensor in sensors)
    return {
        body: np.array([row for row, s in enumerate(sensors) if s.body == body], np.intp)
        for body in bodies
    }
