"""Describes a rigid piece of metal as a lattice of points that drive each other, and keeps what
was learnt in files.

Each point answers to the field that it feels, that of the emitters and of all other points, with a
moment in proportion, ``m = (1 - A G)^-1 A b`` (Foldy, Phys. Rev. 67, 1945: multiple scattering by
point scatterers). An answer is complex, and changes with the logarithm of the frequency. So a
lattice carries its shape and the screening within it from one place in the emitters' field to
another, which independent sources do not.
"""

import os
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array, ComplexArray
from anser_ros.errors import ModelFileError
from anser_ros.field.model import FieldModel
from anser_ros.physics.constants import DIPOLE_CONSTANT, MU_0
from anser_ros.physics.sensor import along_each_axis
from anser_ros.physics.volume import TrackedVolume
from anser_ros.refit.clouds import Excitation
from anser_ros.refit.prior import vector_basis
from anser_ros.wire.text_files import read_document, write_document

STEPS = np.array([1e-3] * 3 + [5e-3] * 3)
"""Steps of the central differences by place (m) and turn (rad); their relative error is the square
of the step over the distance of a coil: 1e-3 at 3 cm."""


def lattice_points(counts: tuple[int, int, int], spacing_m: float) -> Array:
    """Return the places (n, 3), m, of a regular lattice about its middle."""
    sides = [spacing_m * (np.arange(n) - (n - 1) / 2.0) for n in counts]
    return np.stack(np.meshgrid(*sides, indexing='ij'), -1).reshape(-1, 3)


def ball_answer(spacing_m: float) -> float:
    """Return the size of the answer of a conducting ball that fills a point's place, A m^2/T."""
    return float(2.0 * np.pi * (spacing_m / 2.0) ** 3 / MU_0)


def moved(pose: Array, step: Array) -> Array:
    """Return a pose, place (m) and rotation vector (6,), after a step about fg's axes."""
    turn = Rotation.from_rotvec(step[3:]) * Rotation.from_rotvec(pose[3:])
    return np.concatenate([pose[:3] + step[:3], turn.as_rotvec()])


def step_between(before: Array, after: Array) -> Array:
    """Return the step (6,) that `moved` takes one pose to another by."""
    turn = Rotation.from_rotvec(after[3:]) * Rotation.from_rotvec(before[3:]).inv()
    return np.concatenate([after[:3] - before[:3], turn.as_rotvec()])


@dataclass(frozen=True)
class Coils:
    """Holds the places (S, 3), axes (S, 3) and lengths (S,) of coils, m, frame fg."""

    at: Array
    axes: Array
    lengths: Array | None


@dataclass(frozen=True)
class Lattice:
    """Holds the points of a body and their answers."""

    points: Array  # (n, 3), m, in the body's own frame
    unit: float  # unit of the answers, A m^2/T
    # (n,), complex, answer of each point, and its change with the logarithm of the frequency over
    # ``frequency_hz``, both over ``unit``
    answers: ComplexArray
    slopes: ComplexArray
    frequency_hz: float
    # (n,), complex, or None, small change of the answers, taken in to first order
    offset: ComplexArray | None = None

    def __len__(self) -> int:
        return len(self.points)

    def tilt(self, frequencies_hz: tuple[float, ...]) -> Array:
        """Return the logarithm of frequencies (K,) over the lattice's own."""
        return np.asarray(np.log(np.asarray(frequencies_hz) / self.frequency_hz))

    @property
    def parameters(self) -> Array:
        """Return answers and slopes as real numbers (4n,): re, im, re, im."""
        parts = (self.answers.real, self.answers.imag, self.slopes.real, self.slopes.imag)
        return np.concatenate(parts)

    def with_parameters(self, values: Array) -> 'Lattice':
        """Return the lattice with other `parameters`."""
        a, b, c, d = values.reshape(4, -1)
        return replace(self, answers=a + 1j * b, slopes=c + 1j * d, offset=None)

    def near(self, change: Array) -> 'Lattice':
        """Return the lattice with its `parameters` changed a little, to first order."""
        a, b, c, d = change.reshape(4, -1)
        out = replace(self, slopes=self.slopes + c + 1j * d, offset=a + 1j * b)
        out.__dict__['scattering'] = self.scattering
        return out

    @cached_property
    def scattering(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return ``(1 - A G)^-1``, the response ``(1 - A G)^-1 A`` and ``1 + G`` times it.

        All of shape (3n, 3n), at the mean frequency and without the offset.
        """
        n = len(self.points)
        gap = self.points[:, None] - self.points + np.eye(n)[:, :, None]
        far2 = (gap**2).sum(axis=2)[..., None, None]
        along = gap[..., :, None] * gap[..., None, :]
        mutual = DIPOLE_CONSTANT * (3.0 * along / far2 - np.eye(3)) / far2**1.5
        mutual[np.arange(n), np.arange(n)] = 0.0
        mutual = mutual.swapaxes(1, 2).reshape(3 * n, 3 * n)
        alone = np.repeat(self.unit * self.answers, 3)
        out = np.linalg.inv(np.eye(3 * n) - alone[:, None] * mutual)
        response = out * alone
        return out, response, np.eye(3 * n) + mutual @ response

    @cached_property
    def responses(self) -> tuple[ComplexArray, ComplexArray]:
        """Return the response and its change with the logarithm of the frequency, (3n, 3n)."""
        out, response, into = self.scattering
        return response, (out * np.repeat(self.unit * self.slopes, 3)) @ into

    def moments(self, driving: Array, tilt: Array) -> ComplexArray:
        """Return the moments (..., K, 3n), A m^2, that driving fields (..., K, 3n), T, raise."""
        if self.offset is None:
            # Faster for many places, which share the two responses.
            base, sloped = self.responses
            return np.asarray(driving @ base.T + tilt[:, None] * (driving @ sloped.T))
        out, response, into = self.scattering
        more = tilt[:, None] * np.repeat(self.slopes, 3)
        more = more + np.repeat(self.offset, 3)
        felt = (driving @ into.T) * (self.unit * more)
        return np.asarray(driving @ response.T + felt @ out.T)


@dataclass(frozen=True)
class PlacedLattice:
    """Holds a lattice at a pose in the emitters' field.

    Its points (n, 3) are in m, frame fg; ``turn`` (3, 3) is from the body's axes to fg;
    ``driving`` (K, 3n), T, are the emitters' fields at the points, in the body's axes.
    """

    points: Array
    turn: Array
    driving: Array

    def received(self, coils: Coils) -> Array:
        """Return the fluxes (S, 3n) of unit moments along the body's axes, T."""
        basis = vector_basis(coils.at, coils.axes, coils.lengths, self.points) @ self.turn
        return np.asarray(basis.reshape(len(coils.at), -1))

    def strongest_t(self) -> float:
        """Return the largest driving field at any point, rms over the emitters, T."""
        k = len(self.driving)
        power = (self.driving.reshape(k, -1, 3) ** 2).sum(axis=2).mean(axis=0)
        return float(np.sqrt(power.max()))

    def nearest_m(self, coils: Coils) -> float:
        """Return the distance of the nearest coil from a point, m."""
        gap = coils.at[:, None] - self.points
        return float(np.sqrt((gap**2).sum(axis=2).min()))


class Setting:
    """Places lattices in the field of some emitters.

    ``tilt`` (K,): of the lattices, see `Lattice.tilt`.
    """

    def __init__(self, excitation: Excitation, tilt: Array) -> None:
        self.excitation, self.tilt = excitation, tilt

    def placed(self, lattice: Lattice, pose: Array) -> PlacedLattice:
        """Return a lattice at a pose (6,)."""
        return self.all_placed(lattice, pose[None])[0]

    def all_placed(self, lattice: Lattice, poses: Array) -> list[PlacedLattice]:
        """Return a lattice at each of some poses (P, 6)."""
        turns = Rotation.from_rotvec(poses[:, 3:]).as_matrix()
        points = poses[:, None, :3] + lattice.points @ turns.swapaxes(1, 2)
        field = self.excitation.field(points.reshape(-1, 3))
        field = field.reshape(*points.shape[:2], -1, 3) @ turns[:, None]
        driving = field.transpose(0, 2, 1, 3).reshape(len(poses), field.shape[2], -1)
        return [PlacedLattice(*one) for one in zip(points, turns, driving, strict=True)]

    def flux(self, lattice: Lattice, placed: PlacedLattice, coils: Coils) -> ComplexArray:
        """Return what coils read of a lattice, (S, K), in the emitters' phases, T."""
        return np.asarray(placed.received(coils) @ lattice.moments(placed.driving, self.tilt).T)

    def fluxes(self, lattice: Lattice, poses: Array, coils: Coils) -> ComplexArray:
        """Return what coils read of a lattice at each of some poses (P, 6), (P, S, K), T."""
        placed = self.all_placed(lattice, poses)
        moments = lattice.moments(np.array([one.driving for one in placed]), self.tilt)
        pairs = zip(placed, moments, strict=True)
        return np.array([one.received(coils) @ raised.T for one, raised in pairs])

    def pose_columns(self, lattice: Lattice, pose: Array, coils: Coils) -> ComplexArray:
        """Return the derivative (S, K, 6) of the flux by a step of the lattice, see `moved`."""
        steps = np.concatenate([np.diag(STEPS), -np.diag(STEPS)])
        fluxes = self.fluxes(lattice, np.array([moved(pose, step) for step in steps]), coils)
        ends = fluxes.reshape(2, 6, len(coils.at), -1)
        return np.asarray(np.moveaxis(ends[0] - ends[1], 0, -1) / (2.0 * STEPS))

    def answer_columns(
        self, lattice: Lattice, placed: PlacedLattice, coils: Coils
    ) -> ComplexArray:
        """Return the derivative (S, K, 4n) of the flux by the `Lattice.parameters`."""
        out, _, into = lattice.scattering
        n = len(lattice)
        received = (placed.received(coils) @ out).reshape(len(coils.at), n, 3)
        felt = (placed.driving @ into.T).reshape(len(placed.driving), n, 3)
        by = lattice.unit * np.einsum('snj,knj->skn', received, felt, optimize=True)
        tilted = self.tilt[None, :, None] * by
        return np.concatenate([by, 1j * by, tilted, 1j * tilted], axis=2)

    def in_field(self, lattice: Lattice, placed: PlacedLattice, model: FieldModel) -> FieldModel:
        """Return a model with the lattice's moments in its field, and without modes."""
        moments = lattice.moments(placed.driving, self.tilt)
        turned = moments.reshape(len(moments), -1, 3) @ placed.turn.T
        turned = (turned * self.excitation.phase[:, None, None]).transpose(1, 2, 0)
        directions = np.tile(np.eye(3), (len(placed.points), 1))
        flat = np.ascontiguousarray(turned.reshape(len(directions), -1))
        bare = replace(model, modes=None)
        return bare.with_dipoles(np.repeat(placed.points, 3, axis=0), directions, flat)


SCHEMA = 'anser_known_metal/1'
DIRECTIONS = 60
"""Directions in which answers may be wrong: the 60th has a thousandth of the first one's power."""
ANSWER_ERROR = 0.05
"""Error of each point's answer beyond what the fit says of it, in units of a conducting ball: a
lattice is not the metal's true shape."""
SAMPLES = 3, 3
"""Samples across and up the volume where the effect of answers on the field is compared."""
LARGEST_M, FARTHEST_M = 2.0, 3.0
"""Largest body, and farthest place, m, that a file may state: more is a file in millimetres."""
EVERY = 8
"""Of the poses of the fit, for the same."""


@dataclass(frozen=True)
class KnownMetal:
    """Holds a rigid piece of metal as a recording has shown it."""

    name: str
    lattice: Lattice
    # (4n, D), errors of the lattice's parameters: sums of these with independent normal factors
    directions: Array
    # part of what references read of it, in frames that took no part, that it does not explain
    misfit: float
    strongest_t: float  # largest field that drove one of its points while it was learnt, T
    nearest_m: float  # least distance of a coil from one of its points then
    # (3,), corners of the box of its places then, m
    low: Array
    high: Array
    turn: Array  # (3,), its rotation vector in the middle of the recording


def directions_of(
    lattice: Lattice, covariance: Array, setting: Setting, poses: Array, volume: TrackedVolume
) -> Array:
    """Return the `DIRECTIONS` in which answers may be wrong that the field in a volume feels most.

    ``covariance`` (4n, 4n): of its parameters. ``poses`` (F, 6): where its field is looked at.
    """
    coils = Coils(*along_each_axis(volume.samples(*SAMPLES)), None)
    rows = []
    for pose in poses[::EVERY]:
        by = setting.answer_columns(lattice, setting.placed(lattice, pose), coils)
        rows.append(by.reshape(-1, by.shape[-1]))
    effect = np.concatenate(rows)
    factor = np.linalg.cholesky(covariance + ANSWER_ERROR**2 * np.eye(len(covariance)))
    effect = np.concatenate([effect.real, effect.imag]) @ factor
    _, vectors = np.linalg.eigh(effect.T @ effect)
    return np.asarray(factor @ vectors[:, ::-1][:, :DIRECTIONS])


def to_document(known: KnownMetal) -> dict[str, Any]:
    """Return metal that was learnt as plain data."""
    lattice = known.lattice
    return {
        'schema': SCHEMA,
        'name': known.name,
        'units': {'point': 'm', 'unit': 'A m^2/T', 'driving': 'T'},
        'unit': lattice.unit,
        'frequency_hz': lattice.frequency_hz,
        'misfit': known.misfit,
        'strongest_t': known.strongest_t,
        'nearest_m': known.nearest_m,
        'low_m': known.low.tolist(),
        'high_m': known.high.tolist(),
        'turn_rad': known.turn.tolist(),
        'points': lattice.points.tolist(),
        'parameters': lattice.parameters.tolist(),
        'directions': known.directions.T.tolist(),
    }


def from_document(document: Any) -> KnownMetal:
    """Return metal that was learnt from plain data.

    Raises `ModelFileError` when it is none, with what is wrong.
    """
    if not isinstance(document, dict) or document.get('schema') != SCHEMA:
        raise ModelFileError(f'no known metal: its schema must be {SCHEMA!r}')
    name = document.get('name')
    if not isinstance(name, str) or not name.strip():
        raise ModelFileError(f'known metal: name must be a text, got {name!r}')
    points = _table(document, 'points', (-1, 3))
    n = len(points)
    bare = Lattice(
        points, _positive(document, 'unit'), np.zeros(n, complex), np.zeros(n, complex),
        _positive(document, 'frequency_hz'),
    )  # fmt: skip
    size = float(np.ptp(points, axis=0).max())
    low, high = _table(document, 'low_m', (3,)), _table(document, 'high_m', (3,))
    if not 0.0 < size < LARGEST_M:
        raise ModelFileError(f'known metal: its points extend over {size:g} m')
    if not (low <= high).all() or np.abs([low, high]).max() > FARTHEST_M:
        raise ModelFileError(
            f'known metal: low_m {low.tolist()} and high_m {high.tolist()} must be the corners of '
            f'a box within {FARTHEST_M:g} m'
        )
    misfit = _positive(document, 'misfit')
    if misfit >= 1.0:
        raise ModelFileError(f'known metal: misfit must be a share below 1, got {misfit:g}')
    return KnownMetal(
        name,
        bare.with_parameters(_table(document, 'parameters', (4 * n,))),
        np.ascontiguousarray(_table(document, 'directions', (-1, 4 * n)).T),
        misfit,
        _positive(document, 'strongest_t'),
        _positive(document, 'nearest_m'),
        low,
        high,
        _table(document, 'turn_rad', (3,)),
    )


def _positive(document: dict[str, Any], key: str) -> float:
    value = _table(document, key, ())
    if value <= 0.0:
        raise ModelFileError(f'known metal: {key} must be positive, got {value:g}')
    return float(value)


def _table(document: dict[str, Any], key: str, shape: tuple[int, ...]) -> Array:
    if key not in document:
        raise ModelFileError(f'known metal: {key} is missing')
    try:
        table = np.array(document[key], dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        what = 'a table of numbers' if shape else 'a number'
        raise ModelFileError(f'known metal: {key} is not {what}') from error
    if table.ndim != len(shape) or any(
        want not in (-1, got) for want, got in zip(shape, table.shape, strict=True)
    ):
        wanted = ' x '.join('any' if side < 0 else str(side) for side in shape) or 'one number'
        raise ModelFileError(f'known metal: {key} must be {wanted}, got the shape {table.shape}')
    if not np.isfinite(table).all():
        raise ModelFileError(f'known metal: {key} holds values that are not finite')
    return table


def load_known_metal(path: str | os.PathLike[str]) -> KnownMetal:
    """Read a file of metal that was learnt.

    Raises `ModelFileError` with the file's name and what is wrong.
    """
    document = read_document(path)
    try:
        return from_document(document)
    except ModelFileError as error:
        raise ModelFileError(f'{os.fspath(path)}: {error}') from error


def save_known_metal(path: str | os.PathLike[str], known: KnownMetal) -> None:
    """Write a file of metal that was learnt whole or not at all; raises `ModelFileError`."""
    write_document(path, to_document(known))
