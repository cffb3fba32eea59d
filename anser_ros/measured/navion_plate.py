"""Describes a plate of three-axis sensors at several heights: geometry, data and prediction.

The plate is a thin board. Held up at its rim it is shifted, tilted and bent a little, differently
at every height; each sensor has its own gains, its own small rotation and its own crosstalk, the
same at every height. The field comes from dipoles: a cloud in each magnet and, where metal stands
near, one dipole a piece. The fit is in `navion_fit`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.physics.dipole import field_basis, flux_jacobian

Array = NDArray[np.float64]

BEND_DEGREE = 4
"""Degree of the polynomial of a plate's bend."""
BEND_SPAN = 0.12
"""Distance (m) from the plate's centre at which a bend of 1 mm lifts it by 1 mm."""


@dataclass(frozen=True)
class PlateData:
    """Holds the coil fields that a plate's sensors read at several heights.

    Attributes
    ----------
    height_m : ndarray, shape (P,)
        Nominal height of the plate, frame of the data set.
    grid_m : ndarray, shape (S, 3)
        Nominal sensor positions on the plate, z = 0.
    field_t : ndarray, shape (P, K, S, 3)
        Reading of each sensor for each coil at its full current, in the sensor's own axes, T.
    """

    height_m: Array
    grid_m: Array
    field_t: Array

    def select(self, planes: list[int]) -> PlateData:
        """Return the same plate at some of its heights."""
        return PlateData(self.height_m[planes], self.grid_m, self.field_t[planes])


@dataclass(frozen=True)
class HallSensorErrors:
    """Says what each sensor adds: a reading is ``matrix @ (R^T B(position + shift))``.

    Attributes
    ----------
    matrix : ndarray, shape (S, 3, 3)
        Gains, rotation and crosstalk; the identity for a perfect sensor.
    shift_m : ndarray, shape (S, 3)
        Displacement on the plate.
    """

    matrix: Array
    shift_m: Array


@dataclass(frozen=True)
class Sources:
    """Holds dipoles and their moments for each coil's full current.

    Attributes
    ----------
    position_m : ndarray, shape (N, 3)
        The last `n_metal` are metal objects, the others lie in the magnets.
    moment_am2 : ndarray, shape (N, 3, K)
        Vector moments, A m^2.
    n_metal : int
        Number of metal objects.
    """

    position_m: Array
    moment_am2: Array
    n_metal: int = 0

    def field(self, points: Array) -> Array:
        """Return the field of each coil's full current at `points` (P, 3): shape (P, 3, K), T."""
        basis = vector_basis(points, self.position_m)
        flat = self.moment_am2.reshape(-1, self.moment_am2.shape[2])
        return np.asarray(np.einsum('pim,mk->pik', basis, flat))

    @property
    def magnets(self) -> Sources:
        """Return the sources of the magnets without those of the metal."""
        count = len(self.position_m) - self.n_metal
        return Sources(self.position_m[:count], self.moment_am2[:count])

    def gradient(self, points: Array, only: slice = slice(None)) -> Array:
        """Return the gradient ``dB_i / dx_j`` of each coil: shape (P, 3, 3, K), T/m; `only` picks
        dipoles.
        """
        place, direction = vector_dipoles(self.position_m[only])
        moment = self.moment_am2[only].reshape(-1, self.moment_am2.shape[2]).astype(complex)
        parts = [
            flux_jacobian(points, np.tile(axis, (len(points), 1)), None, place, direction, moment)
            for axis in np.eye(3)
        ]
        return np.stack([part[1].real for part in parts], axis=1)


def vector_dipoles(positions: Array) -> tuple[Array, Array]:
    """Return three unit dipoles along x, y and z at every position: places and directions
    (3N, 3).
    """
    return np.repeat(positions, 3, axis=0), np.tile(np.eye(3), (len(positions), 1))


def vector_basis(points: Array, positions: Array) -> Array:
    """Return the field at `points` (P, 3) per component of each dipole's moment: (P, 3, 3N), T/(A
    m^2).
    """
    return field_basis(points, *vector_dipoles(positions)).transpose(0, 2, 1)


def rotation_matrices(vectors: Array) -> Array:
    """Return the rotation matrices (n, 3, 3) of rotation vectors (n, 3), rad."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


class Plate:
    """Says where a plate's sensors stand, and how they are turned, for a pose and a bend.

    A plate's state at one height is the vector of its shift (m, 3), its rotation (rad, 3) and the
    coefficients of its bend (m): ``w(x, y) = sum_k c_k x^a y^b`` with 2 <= a + b <= `BEND_DEGREE`
    in units of `BEND_SPAN`. The board turns with its slope, as a thin plate does (Kirchhoff).
    """

    def __init__(self, grid_m: Array) -> None:
        self.grid_m = grid_m
        self.centre = grid_m.mean(axis=0)
        x, y = ((grid_m - self.centre) / BEND_SPAN)[:, :2].T
        powers = [(total - b, b) for total in range(2, BEND_DEGREE + 1) for b in range(total + 1)]
        self.lift = np.stack([x**a * y**b for a, b in powers], axis=1)
        slope_x = [a * x ** max(a - 1, 0) * y**b / BEND_SPAN for a, b in powers]
        slope_y = [b * x**a * y ** max(b - 1, 0) / BEND_SPAN for a, b in powers]
        zero = np.zeros_like(self.lift)
        self.turn = np.stack([np.stack(slope_y, 1), -np.stack(slope_x, 1), zero], axis=2)

    @property
    def n_state(self) -> int:
        """Return how many numbers describe the plate at one height."""
        return 6 + int(self.lift.shape[1])

    def place(self, height_m: float, state: Array, shift_m: Array) -> tuple[Array, Array]:
        """Return positions (S, 3) and rotations (S, 3, 3) of the sensors at one height."""
        whole = rotation_matrices(state[None, 3:6])[0]
        local = self.grid_m + shift_m - self.centre
        local[:, 2] += self.lift @ state[6:]
        turned = rotation_matrices(state[3:6] + np.einsum('sbi,b->si', self.turn, state[6:]))
        origin = self.centre + np.array([0.0, 0.0, height_m]) + state[:3]
        return origin + local @ whole.T, turned

    def motion(self, height_m: float, state: Array, position: Array) -> tuple[Array, Array]:
        """Return displacement and turn of each sensor per unit of the state, (S, n_state, 3)."""
        n_sensors = len(position)
        whole = rotation_matrices(state[None, 3:6])[0]
        arm = position - (self.centre + np.array([0.0, 0.0, height_m]) + state[:3])
        shift = np.zeros((n_sensors, self.n_state, 3))
        turn = np.zeros_like(shift)
        shift[:, :3] = np.eye(3)
        turn[:, 3:6] = np.eye(3)
        shift[:, 3:6] = np.cross(np.eye(3)[None], arm[:, None])
        shift[:, 6:] = self.lift[:, :, None] * whole[:, 2]
        turn[:, 6:] = self.turn @ whole.T
        return shift, turn


def predict_plane(
    grid_m: Array, height_m: float, sources: Sources, errors: HallSensorErrors, state: Array | None
) -> Array:
    """Predict the readings (K, S, 3), T, of a plate at one height.

    Parameters
    ----------
    grid_m : ndarray, shape (S, 3)
        Nominal sensor positions on the plate.
    height_m : float
        Nominal height.
    sources, errors
        From a fit to other heights.
    state : ndarray or None
        The plate's state at that height; None for the nominal one, where nobody knows it.
    """
    plate = Plate(grid_m)
    known = np.zeros(plate.n_state) if state is None else state
    position, rotation = plate.place(height_m, known, errors.shift_m)
    field = sources.field(position)
    return np.asarray(np.einsum('sij,slj,slk->ksi', errors.matrix, rotation, field))
