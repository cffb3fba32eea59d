"""Simulates the world around a control unit: a board, moving tools, reference coils and metal.

It gives the true flux of every sensor at any time. Metal is a rigid cloud of conducting and
permeable spheres; the board's field is that of all tracks of its coils.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array, ComplexArray
from anser_ros.metal.body import sphere_polarisability
from anser_ros.physics.dipole import GAUSS_OFFSET, flux_basis
from anser_ros.sessions.nominal_board import board_of
from anser_ros.wire.setup import FIELD_GENERATOR, SensorRows, Setup

Pose = tuple[Array, Array]
"""A position (3,), m, and a rotation matrix (3, 3) from the body's frame to fg."""

Path = Callable[[float], Pose]
"""A function from a time in seconds to a pose."""


@dataclass(frozen=True)
class Lissajous:
    """Describes a path of a sine in each coordinate and each component of the rotation vector."""

    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.15)  # frame fg
    amplitude_m: tuple[float, float, float] = (0.08, 0.08, 0.03)
    period_s: tuple[float, float, float] = (9.0, 12.5, 7.0)
    turn_rad: tuple[float, float, float] = (0.5, 0.4, 0.8)  # amplitude of the rotation vector
    turn_period_s: tuple[float, float, float] = (11.0, 8.0, 17.0)
    phase_rad: float = 0.0  # phase at the start, so that two bodies need not move alike

    def __call__(self, time_s: float) -> Pose:
        """Return the pose at a time, s."""
        angle = 2 * np.pi * time_s / np.array(self.period_s) + self.phase_rad
        position = np.array(self.centre_m) + np.array(self.amplitude_m) * np.sin(angle)
        turn = 2 * np.pi * time_s / np.array(self.turn_period_s) + self.phase_rad
        rotation = Rotation.from_rotvec(np.array(self.turn_rad) * np.sin(turn))
        return position, np.asarray(rotation.as_matrix())


BODY_PHASE_RAD = 0.7
"""Phase difference between the paths of one body and the next, so that they stay apart."""


def tool_paths(bodies: Sequence[str], phase_rad: float = 0.0) -> Mapping[str, Path]:
    """Return the default path of each body, by its name."""
    return {
        body: Lissajous(phase_rad=phase_rad + BODY_PHASE_RAD * rank)
        for rank, body in enumerate(bodies)
    }


@dataclass(frozen=True)
class Approach:
    """Describes a path that comes near, stays, and leaves again, each way along a smooth ramp."""

    far_m: tuple[float, float, float] = (0.05, -0.03, -0.6)  # frame fg
    near_m: tuple[float, float, float] = (0.05, -0.03, -0.08)
    start_s: float = 8.0
    travel_s: float = 5.0  # one way
    stay_s: float = 6.0
    period_s: float = 0.0  # time after which the visit repeats, s; 0 for a single visit

    def __call__(self, time_s: float) -> Pose:
        """Return the pose at a time, s; the orientation is constant."""
        local = time_s - self.start_s
        if self.period_s > 0 and local > 0:
            local %= self.period_s
        inward = local / self.travel_s
        outward = (2 * self.travel_s + self.stay_s - local) / self.travel_s
        share = float(np.clip(min(inward, outward), 0.0, 1.0))
        smooth = share * share * (3 - 2 * share)
        far, near = np.array(self.far_m), np.array(self.near_m)
        return far + smooth * (near - far), np.eye(3)


@dataclass(frozen=True)
class MetalBody:
    """Moves a rigid cloud of equal spheres, which do not drive each other, on a path."""

    offsets: Array  # (M, 3): centres of the spheres in the body's frame, m
    radius_m: float  # of each sphere
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


def at_rest(place: Array) -> Path:
    """Return the path of a body that rests, unturned, at a place, m."""
    return lambda time_s: (place, np.eye(3))


def steel_disc(path: Path | None = None, *, radius_m: float = 0.06, rings: int = 3) -> MetalBody:
    """Return a disc of touching steel balls, in rings about one; by default it comes and goes."""
    ball = radius_m / (2 * rings + 1)
    centres = [np.zeros(3)]
    for ring in range(1, rings + 1):
        angles = 2 * np.pi * np.arange(6 * ring) / (6 * ring)
        circle = 2 * ball * ring * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
        centres += list(circle)
    return MetalBody(np.array(centres), ball, 5e6, 200.0, path or Approach())


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
        on = [sensor.body for sensor in self.sensors]
        self._groups = {b: np.flatnonzero([b == body for body in on]) for b in dict.fromkeys(on)}
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


def board_source(setup: Setup) -> FieldSource:
    """Return the field of a setup's board, without the dipoles that models express it by.

    Raises `SetupError` when the setup's geometry does not describe a board.
    """
    board = board_of(setup)

    def field(points: Array) -> ComplexArray:
        return np.asarray(board.field(points).transpose(0, 2, 1), complex)

    return field


SHIFT_M = 0.2e-3
"""Standard deviation of a coil's position along each axis, m: an assumption on printed boards."""
TURN_DEG = 0.1
"""Standard deviation of a coil's rotation about z, degrees, an assumption as well."""
CURRENT_SHARE = 0.01
"""Fraction by which all currents are too large, half of the nominal model's tolerance of gains."""


def manufactured(setup: Setup, rng: np.random.Generator) -> Setup:
    """Return a setup with random errors of its coils' places and a slightly too large current.

    The setup document keeps the nominal geometry, so the nominal model is wrong for it.
    """
    coils = tuple(
        replace(
            coil,
            centre_m=tuple(np.array(coil.centre_m) + rng.normal(scale=SHIFT_M, size=3)),
            rotation_deg=coil.rotation_deg + float(rng.normal(scale=TURN_DEG)),
        )
        for coil in setup.emitter.coils
    )
    geometry = dict(setup.emitter.geometry)
    geometry['current_a'] = float(geometry.get('current_a', 1.0)) * (1 + CURRENT_SHARE)
    return replace(setup, emitter=replace(setup.emitter, coils=coils, geometry=geometry))
