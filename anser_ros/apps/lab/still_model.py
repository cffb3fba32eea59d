"""Models the fluxes of a body of many sensors that rests at few poses, and linearises them.

A reading has the gain and the tilt of its channel, which are the same in every frame; a frame has
an error of its stated pose and a bend of the body, which all channels share; and the field is that
of dipoles at given places. With a constant field (no imaginary part in any reading) only the real
parts are there. A thin plate that is held at its rim or by a few screws is bent by fractions of a
millimetre, and otherwise wherever it is laid (`SmoothBend`; Timoshenko and Woinowsky-Krieger,
Theory of Plates and Shells, chapter 2).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import Array, ComplexArray, as_complex, as_real
from anser_ros.calibration.moments import pose_slopes
from anser_ros.calibration.readings import DipoleSites
from anser_ros.field.measurements import Measurements
from anser_ros.physics.dipole import flux_basis, flux_jacobian
from anser_ros.physics.rotations import tangents, tilted
from anser_ros.physics.sensor import SensorTable

DEGREE = 4
"""Degree of the polynomial: that of a plate under an even load, whose bend has fourth powers."""
FLAT = 0.02
"""Thickness (rms) of a body's cloud of sensors, over its extent (rms), of a plate at most."""


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


POSE = 6
"""Numbers of a pose: a shift, m, and a rotation vector, rad, frame fg."""


@dataclass(frozen=True)
class StillUnknowns:
    """Holds what is to be found."""

    moments: Array  # (N, C): of each dipole for each part of the fluxes, A m^2
    # (F, 6 + B): error of each frame's pose (m and rad, frame fg), then the terms of its bend (m)
    frames: Array
    # (S, G + 2): gain of each channel less one (its real part, and where fluxes are complex its
    # imaginary part), and its tilt along the two tangents of its axis, rad
    sensors: Array


@dataclass(frozen=True)
class Columns:
    """Holds the readings about an estimate, sensor by sensor; R = C F rows each."""

    target: Array  # (S, R): readings that the columns times the unknowns should give, T
    basis: Array  # (S, F, N): flux of each dipole, the same for every part, T/(A m^2)
    frames: Array  # (S, C, F, 6 + B): derivatives by the frame's own pose and bend, T/m and T/rad
    own: Array  # (S, R, G + 2): derivatives by the sensor's own gain and tilt, T and T/rad
    # (S, R, 3 J): derivatives by the places of the last J dipoles of free direction, T/m
    places: Array


class StillModel:
    """Predicts the fluxes of a body's frames.

    ``measurements``: F frames with a pose; a reading that is not usable counts as zero and needs
    no weight. ``is_complex``: whether the imaginary parts count: in every part of a measurement
    alike.
    """

    def __init__(self, measurements: Measurements, is_complex: bool) -> None:
        self.measured, self.is_complex = measurements, is_complex
        self.bend = SmoothBend.of(measurements.sensors)
        self.bends = 0 if self.bend is None else self.bend.terms
        self.gains = 2 if is_complex else 1
        self.reading = self._parts(measurements.flux)
        self.parts = int(self.reading.shape[2])
        self.usable = measurements.usable
        self.tangents = tangents(measurements.sensors.axis)

    def phasors(self, parts: Array) -> ComplexArray:
        """Return the phasors (..., K) of their parts (..., C)."""
        return as_complex(parts) if self.is_complex else parts.astype(complex)

    def _parts(self, flux: ComplexArray) -> Array:
        """Real parts (..., K) of phasors, or real and imaginary ones by turns (..., 2K)."""
        return as_real(flux) if self.is_complex else np.ascontiguousarray(flux.real)

    def nothing(self, dipoles: int) -> StillUnknowns:
        """Return the unknowns of an ideal body at its stated poses without a field."""
        frames, sensors = self.reading.shape[:2]
        return StillUnknowns(
            np.zeros((dipoles, self.parts)),
            np.zeros((frames, POSE + self.bends)),
            np.zeros((sensors, self.gains + 2)),
        )

    def placed(self, now: StillUnknowns) -> tuple[Array, Array, Array, Array]:
        """Return the sensors' centres and axes (F, S, 3), and the body's rotations and places."""
        m = self.measured
        rotation = Rotation.from_rotvec(now.frames[:, 3:POSE]).as_matrix() @ m.rotation
        position = m.position + now.frames[:, :3]
        local = m.sensors.position[None]
        axis = tilted(m.sensors.axis, now.sensors[:, self.gains :])[None]
        if self.bend is not None:
            shift, turn = self.bend.shape(now.frames[:, POSE:])
            local, axis = local + shift, axis + np.cross(turn, axis)
            axis = axis / np.linalg.norm(axis, axis=2, keepdims=True)
        turned = rotation.transpose(0, 2, 1)
        return local @ turned + position[:, None], axis @ turned, rotation, position

    def rows(self, now: StillUnknowns, sites: DipoleSites) -> Array:
        """Return the flux of each dipole in a channel without its gain, (F, S, N), T/(A m^2)."""
        points, axes = self.placed(now)[:2]
        return flux_basis(*self._flat(points, axes), sites.positions, sites.directions).reshape(
            *points.shape[:2], -1
        )

    def flux(self, now: StillUnknowns, sites: DipoleSites) -> Array:
        """Return the parts of the modelled fluxes, (F, S, C), T."""
        return self._amplified(self.rows(now, sites) @ now.moments, now)

    def _flat(self, points: Array, axes: Array) -> tuple[Array, Array, Array]:
        lengths = np.tile(self.measured.sensors.length, len(points))
        return points.reshape(-1, 3), axes.reshape(-1, 3), lengths

    def _amplified(self, values: Array, now: StillUnknowns) -> Array:
        """Parts (F, S, ..., C) of phasors times the gain of each channel."""
        real = (1.0 + now.sensors[:, 0]).reshape(-1, *[1] * (values.ndim - 2))
        if not self.is_complex:
            return np.asarray(values * real)
        turned = now.sensors[:, 1].reshape(real.shape)
        return np.asarray(values * real + self._quarter(values) * turned)

    @staticmethod
    def _quarter(values: Array) -> Array:
        """Phasors a quarter turn on: (re, im) become (-im, re)."""
        out = np.empty_like(values)
        out[..., 0::2], out[..., 1::2] = -values[..., 1::2], values[..., 0::2]
        return out

    def columns(self, now: StillUnknowns, sites: DipoleSites, movable: int) -> Columns:
        """Linearise about an estimate; so many of the last dipoles of free direction may move.

        A gain's imaginary part mixes the parts of the fluxes; it is small, and left out of the
        dipoles' columns, so that these serve every part. The next step's residual has it whole.
        """
        points, axes, rotation, position = self.placed(now)
        moments = self.phasors(now.moments)
        flat = (*self._flat(points, axes), sites.positions, sites.directions)
        flux, by_place, by_axis = flux_jacobian(*flat, moments)
        frames, sensors = points.shape[:2]
        shape = (frames, sensors, 3, moments.shape[1])
        by_place, by_axis = by_place.reshape(shape), by_axis.reshape(shape)
        slope = pose_slopes(points, axes, position, by_place, by_axis)
        slope = slope if self.is_complex else slope[:, :, 0::2]
        place, axis = self._parts(by_place), self._parts(by_axis)
        slope = self._amplified(np.moveaxis(slope, 2, 3), now)
        if self.bend is not None:
            risen = np.einsum('fi,fsik->fsk', rotation @ self.bend.normal, place)
            turn = np.einsum('fij,sbj->fsbi', rotation, self.bend.turn)
            bent = risen[:, :, None] * self.bend.lift[:, :, None]
            bent = bent + np.cross(turn, axes[:, :, None]) @ axis
            slope = np.concatenate([slope, self._amplified(bent, now)], axis=2)
        modelled = self._parts(flux).reshape(frames, sensors, -1)
        across = np.einsum('fij,stj->fsti', rotation, self.tangents)
        tilt = self._amplified(across @ axis, now)
        gain = [modelled, self._quarter(modelled)] if self.is_complex else [modelled]
        own = np.concatenate([np.stack(gain, axis=2), tilt], axis=2)
        own = own.transpose(1, 3, 0, 2).reshape(sensors, -1, own.shape[2])
        basis = flux_basis(*flat).reshape(frames, sensors, -1) * (1.0 + now.sensors[:, :1])
        by_frame = slope.transpose(1, 3, 0, 2)
        residual = np.where(
            self.usable[:, :, None], self.reading - self._amplified(modelled, now), 0.0
        )
        linear = (basis @ now.moments).transpose(1, 2, 0)
        linear = linear + np.einsum('scfq,fq->scf', by_frame, now.frames)
        target = (residual.transpose(1, 2, 0) + linear).reshape(sensors, -1)
        target = target + np.einsum('sra,sa->sr', own, now.sensors)
        places = self._by_dipole_place(now, flat, moments, movable)
        basis = np.ascontiguousarray(basis.transpose(1, 0, 2))
        return Columns(target, basis, by_frame, own, places)

    def _by_dipole_place(
        self, now: StillUnknowns, flat: tuple[Array, ...], moments: ComplexArray,
        movable: int,
    ) -> Array:  # fmt: skip
        """A dipole that moves does what all sensors that move the other way would feel of it."""
        frames, sensors = self.reading.shape[:2]
        out = np.empty((sensors, self.parts, frames, 3 * movable))
        first = len(moments) - 3 * movable
        for j in range(movable):
            own = slice(first + 3 * j, first + 3 * j + 3)
            points, axes, lengths, positions, directions = flat
            by_place = flux_jacobian(
                points, axes, lengths, positions[own], directions[own], moments[own]
            )[1]
            slope = self._parts(by_place.reshape(frames, sensors, 3, -1))
            out[..., 3 * j : 3 * j + 3] = -self._amplified(slope, now).transpose(1, 3, 0, 2)
        return out.reshape(sensors, self.parts * frames, 3 * movable)

    def unbent(self, now: StillUnknowns, sites: DipoleSites) -> Measurements:
        """Return the measurements that the body would have given without its bend."""
        if self.bend is None or not now.frames[:, POSE:].any():
            return self.measured
        flat = now.frames.copy()
        flat[:, POSE:] = 0.0
        bent = self.flux(now, sites) - self.flux(replace(now, frames=flat), sites)
        return replace(self.measured, flux=self.measured.flux - self.phasors(bent))
