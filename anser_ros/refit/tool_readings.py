"""Predicts what the coils of a rigid tool read, by its pose, by their own errors, and nothing
else.

The readings of a tool's coils are compared at the pose that was found for it. The pose is free, so
the directions in which a translation or rotation of the tool would change them carry no
information (`ToolRows.pose`). The errors of the coils themselves (gain, place and axis) are the
same in every frame, and `CoilErrors` estimates them from the part that no metal explains: a wrong
gain must not be taken for metal.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import flux_jacobian
from anser_ros.physics.sensor import SensorTable
from anser_ros.physics.tangent import tangents
from anser_ros.settings import ToolSettings

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FREE_M, FREE_RAD = 0.02, 0.2
"""Error of the pose at which a tool's readings are compared: any that matters."""
NEAR_M = 0.01
"""How far around the coils the field's uncertainty is worked out, m."""
_AROUND = np.array([[0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
"""A coil's own place and the corners of a tetrahedron around it, in units of `NEAR_M`."""
KEPT = 0.03
"""Share of a tool's stated errors that is never learnt away."""
SHARE = 0.1
"""Weight of a frame from which a tool's errors are learnt: the model's own error hardly changes
from one frame to the next."""


def coil_spread(count: int, tools: ToolSettings) -> Array:
    """Return the standard deviations (7 S,) of the errors of tool coils, as `ToolRows.own`."""
    gain, place, axis = tools.tool_coil_gain, tools.tool_coil_position_m, tools.tool_coil_axis_rad
    return np.tile([gain, gain, place, place, place, axis, axis], count)


def surroundings(points: Array) -> Array:
    """Return coils' places (P, 3), m, and four around each, (5 P, 3): where modes are chosen."""
    return np.asarray((points[:, None] + NEAR_M * _AROUND).reshape(-1, 3))


@dataclass(frozen=True)
class ToolReading:
    """Holds what the S coils of one rigid tool read at a pose that was found for it.

    ``flux`` (S, K) is in T; position (3,), m, and rotation (3, 3) are those of the tool in fg.
    """

    table: SensorTable
    flux: ComplexArray
    position: Array
    rotation: Array


class CoilErrors:
    """Holds what is wrong with a tool's coils: gain, place and axis of each, learnt without metal.

    ``table``: the S coils. ``tools``: how well they are known before.
    """

    def __init__(self, table: SensorTable, tools: ToolSettings) -> None:
        self.names = table.name
        self._prior = np.maximum(coil_spread(len(table), tools), 1e-9)
        self._precision = np.diag(self._prior**-2.0)
        self._pull = np.zeros(len(self._prior))
        self._solved: tuple[Array, Array] | None = None

    @property
    def posterior(self) -> tuple[Array, Array]:
        """Return mean (7 S,) and covariance of gain (re, im), place (3, m) and axis (2, rad)."""
        if self._solved is None:
            covariance: Array = np.asarray(np.linalg.inv(self._precision))
            mean = covariance @ self._pull
            covariance[np.diag_indices_from(covariance)] += (KEPT * self._prior) ** 2
            self._solved = mean, covariance
        return self._solved

    def learn(self, white: Array, values: Array) -> None:
        """Take in whitened readings (n,) that errors make by the matrix ``white`` (n, 7 S)."""
        self._precision += SHARE * white.T @ white
        self._pull += SHARE * white.T @ values
        self._solved = None


@dataclass(frozen=True)
class ToolRows:
    """Holds a tool's readings linearised at a pose, in noise units turned to the emitters' phases.

    The coils have places and axes (S, 3) in fg; ``left`` (S K,) is what they read beyond the
    model, ``pose`` (S K, 6) the effect of a large step or turn of the tool, and ``own`` (S K, 7 S)
    that of the errors of the coils, in the order of `CoilErrors`.
    """

    at: Array
    axes: Array
    left: ComplexArray
    pose: ComplexArray
    own: ComplexArray


def linearised(
    reading: ToolReading, model: FieldModel, moments: ComplexArray, turn: ComplexArray
) -> ToolRows:
    """Return a tool's readings beside those of a model's dipoles with some moments (N, K).

    ``turn`` (K,) takes fluxes to noise units and to the emitters' phases.
    """
    table = reading.table
    at, axes = table.placed(reading.position, reading.rotation)
    flux, d_at, d_axis = flux_jacobian(
        at, axes, table.length, model.positions, model.directions, moments
    )
    by_place, by_axis = d_at * turn, d_axis * turn
    count, k = flux.shape
    arm = at - reading.position
    pose = np.empty((count, k, 6), dtype=complex)
    for i, unit in enumerate(np.eye(3)):
        pose[:, :, i] = FREE_M * by_place[:, i]
        turned = np.einsum('sj,sjk->sk', np.cross(unit, arm), by_place)
        turned += np.einsum('sj,sjk->sk', np.cross(unit, axes), by_axis)
        pose[:, :, 3 + i] = FREE_RAD * turned
    own = np.zeros((count, k, count, 7), dtype=complex)
    across = np.einsum('ij,saj->sai', reading.rotation, tangents(table.axis))
    for s in range(count):
        own[s, :, s, 0], own[s, :, s, 1] = flux[s] * turn, 1j * flux[s] * turn
        own[s, :, s, 2:5] = (reading.rotation.T @ by_place[s]).T
        own[s, :, s, 5:7] = (across[s] @ by_axis[s]).T
    left = ((reading.flux - flux) * turn).ravel()
    return ToolRows(at, axes, left, pose.reshape(-1, 6), own.reshape(count * k, -1))
