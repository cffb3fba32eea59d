"""Tracks where an axisymmetric source is, seen from a body with many sensors.

A field that is the same all around its axis leaves one of a body's six degrees of freedom open:
the turn about that axis. Jointly, the sensors determine the place of the source in the body's
frame and the direction of its axis. These are five numbers, like a coil's pose; by reciprocity, a
magnet in front of an array of magnetometers is tracked in this way.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from anser_ros import pose_states as states
from anser_ros.field.symmetry import SymmetryAxis
from anser_ros.physics.dipole import field_basis
from anser_ros.stamps import NANO
from anser_ros.tracking.coil_track import UNKNOWNS
from anser_ros.tracking.estimate import NoiseScale, PoseEstimate, TrackerSettings, no_pose
from anser_ros.tracking.rigid import BodyCoils, BodySolution, common_factor, solve_body
from anser_ros.tracking.rotations import nearest_rotation, rotation_of_vector
from anser_ros.tracking.seed import SAME_PLACE_M
from anser_ros.tracking.solve import RealField
from anser_ros.tracking.solve_context import SolveContext
from anser_ros.tracking.solve_verdict import RARE, variance_scale, verdict
from anser_ros.tracking.uncertainty import ROLL_VARIANCE, bounded_inverse

Array = NDArray[np.float64]
Start = tuple[Array, Array]

DIRECTIONS, RATIO = 400, 1.15
"""Directions of the scan's places, and the ratio of neighbouring distances: both leave about a
seventh of the distance between neighbours, within which the descent finds its way."""
NEAREST = 0.2
"""Places nearer to a sensor than this part of the least distance are no place of a source."""
STARTS = 4
"""Places of the scan from which the pose is descended to."""
FEWEST_SENSORS = UNKNOWNS + 1
"""Sensors that find a source and leave a residual to judge it by."""


class SourceScan:
    """Holds places around a body where a source may be, with what turns fluxes into a moment.

    Parameters
    ----------
    coils : BodyCoils
    near, far : float
        Least and largest distance of the source from the body's middle, m.
    """

    def __init__(self, coils: BodyCoils, near: float, far: float) -> None:
        middle = coils.offsets.mean(axis=0)
        shells = near * RATIO ** np.arange(math.ceil(math.log(far / near) / math.log(RATIO)) + 1)
        places = middle + (shells[:, None, None] * _directions()).reshape(-1, 3)
        gap = np.linalg.norm(places[:, None] - coils.offsets[None], axis=2).min(axis=1)
        self.places = places[gap > NEAREST * near]
        basis = np.stack([_vector_basis(coils, self.places, axis) for axis in np.eye(3)], axis=2)
        self._span = np.linalg.qr(basis / np.linalg.norm(basis, axis=(1, 2))[:, None, None])[0]
        self._coils = coils

    def best(self, flux: Array) -> list[tuple[Array, Array]]:
        """Return places (3,) and moments' directions (3,), body's frame, that explain fluxes."""
        share = np.linalg.norm(np.einsum('gsi,s->gi', self._span, flux), axis=1)
        chosen: list[int] = []
        for index in np.argsort(-share, kind='stable')[: 40 * STARTS].tolist():
            apart = [np.linalg.norm(self.places[index] - self.places[c]) for c in chosen]
            reach = np.linalg.norm(self.places[index] - self._coils.offsets.mean(axis=0))
            if len(chosen) < STARTS and all(d > 0.3 * reach for d in apart):
                chosen.append(index)
        out = []
        for index in chosen:
            place = self.places[index]
            basis = np.stack(
                [_vector_basis(self._coils, place[None], axis)[0] for axis in np.eye(3)], axis=1
            )
            moment = np.linalg.lstsq(basis, flux, rcond=1e-12)[0]
            out.append((place, moment / max(float(np.linalg.norm(moment)), 1e-300)))
        return out


def _directions() -> Array:
    """Points spread evenly over the unit sphere (Fibonacci's lattice), shape (DIRECTIONS, 3)."""
    steps = np.arange(DIRECTIONS) + 0.5
    z, turn = 1.0 - 2.0 * steps / DIRECTIONS, np.pi * (1.0 + math.sqrt(5.0)) * steps
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def _vector_basis(coils: BodyCoils, places: Array, axis: Array) -> Array:
    """Flux in every coil of unit dipoles along an axis at places (G, 3): (G, S)."""
    field = field_basis(coils.offsets, places, np.broadcast_to(axis, places.shape))
    return np.asarray(np.einsum('sgi,si->gs', field, coils.axes))


@dataclass
class SourceTrack:
    """Remembers one body: its scan, the last good pose, the noise scale."""

    scan: SourceScan | None = None
    coils: BodyCoils | None = None
    good: BodySolution | None = None
    good_ns: int = 0
    noise: NoiseScale | None = None

    def forget(self) -> None:
        """Drop the last pose, so that the next solve starts cold."""
        self.good = None


@dataclass(frozen=True)
class SourceFrame:
    """Holds one frame's fluxes (S, 2K) of a body in the field of an axisymmetric source."""

    name: str
    stamp_ns: int
    coils: BodyCoils
    flux: Array
    axis: SymmetryAxis
    context: SolveContext
    settings: TrackerSettings

    @cached_property
    def live(self) -> NDArray[np.bool_]:
        """Return which flux components (2K,) carry anything: constant fields
        have no quadrature.
        """
        return np.asarray((self.flux != 0.0).any(axis=0))

    @cached_property
    def field(self) -> RealField:
        """Return the field of the live components only."""
        whole = self.context.field
        return RealField(
            whole.positions, whole.directions, np.ascontiguousarray(whole.moments[:, self.live])
        )

    def solved(self, used: NDArray[np.int64], start: Start) -> BodySolution:
        """Descend to the pose near a start."""
        part, context = self.coils.subset(used), self.context
        flux = np.ascontiguousarray(self.flux[np.ix_(used, self.live)])
        weights = np.tile(1.0 / context.sigma[self.live], (len(used), 1))
        common = common_factor(part.gain_errors(flux), weights)
        low, high = context.low - part.reach, context.high + part.reach
        return solve_body(self.field, part, flux, weights, common, *start, low, high)

    def starts(self, scan: SourceScan, used: NDArray[np.int64]) -> list[Start]:
        """Return poses of the body for the scan's best places."""
        column = int(np.argmax((self.flux[used] ** 2).sum(axis=0)))
        whole = self.context.field
        moment = whole.moments[:, column] @ whole.directions
        out = []
        for place, towards in scan.best(self.flux[:, column]):
            rotation = nearest_rotation(np.outer(moment, towards))
            out.append(self.rolled(self.axis.point - rotation @ place, rotation))
        return out

    def rolled(self, position: Array, rotation: Array) -> Start:
        """Return the pose turned about the axis to where its coils are nearest to the volume's
        middle.

        This rule fixes the rotation that cannot be observed.
        """
        axis, box = self.axis.direction, self.settings.box
        wanted = (np.array(box.low) + np.array(box.high)) / 2.0 - self.axis.point
        here = position + rotation @ self.coils.offsets.mean(axis=0) - self.axis.point
        wanted, here = wanted - axis * (axis @ wanted), here - axis * (axis @ here)
        angle = math.atan2(float(axis @ np.cross(here, wanted)), float(here @ wanted))
        turn = rotation_of_vector(angle * axis)
        return self.axis.point + turn @ (position - self.axis.point), turn @ rotation


def track_source(
    track: SourceTrack, frame: SourceFrame, usable: NDArray[np.bool_]
) -> PoseEstimate:
    """Estimate where the source is in the body's frame, from all usable sensors.

    The estimate's position (m), axis and covariance are in the body's frame.
    """
    used, settings, context = np.flatnonzero(usable), frame.settings, frame.context
    if len(used) < FEWEST_SENSORS:
        reason = (
            f'{len(used)} sensors usable, {FEWEST_SENSORS} are needed to find and judge the source'
        )
        return no_pose(frame.name, frame.stamp_ns, states.STALE, context.model_id, reason)
    if track.scan is None or track.coils is not frame.coils:
        near, far = _distances(frame)
        track.scan, track.coils = SourceScan(frame.coils, near, far), frame.coils
        track.noise = NoiseScale()
    found: list[BodySolution] = []
    age = (frame.stamp_ns - track.good_ns) * NANO
    if track.good is not None and age <= settings.warm_age_s:
        found = [frame.solved(used, frame.rolled(track.good.position, track.good.rotation))]
    freedom = len(used) * int(frame.live.sum()) - UNKNOWNS
    if not found or not found[0].chi2 <= settings.gate**2 * freedom:
        found = [frame.solved(used, start) for start in frame.starts(track.scan, used)]
        found.sort(key=lambda solution: solution.chi2)
    estimate = _judged(track, frame, found, freedom)
    if estimate.state == states.OK:
        track.good, track.good_ns = found[0], frame.stamp_ns
    return estimate


def _distances(frame: SourceFrame) -> tuple[float, float]:
    """Least and largest distance of the source from the middle of a body in the volume, m."""
    low, high = np.array(frame.settings.box.low), np.array(frame.settings.box.high)
    point = frame.axis.point
    nearest = float(np.linalg.norm(np.clip(point, low, high) - point))
    farthest = float(np.linalg.norm(np.maximum(np.abs(low - point), np.abs(high - point))))
    return max(nearest, farthest / 20.0), farthest


def seen_from(axis: SymmetryAxis, position: Array, rotation: Array) -> tuple[Array, Array]:
    """Return place (..., 3) and axis of a source in the frame of a body at poses (..., 3)."""
    place = np.einsum('...ji,...j->...i', rotation, axis.point - position)
    return place, np.einsum('...ji,j->...i', rotation, axis.direction)


def _covariance(frame: SourceFrame, solution: BodySolution) -> Array:
    """Covariance (6, 6) of place and turn of the source, body's frame; its roll is unknown."""
    away, axis = frame.axis.point - solution.position, frame.axis.direction
    # A turn w of the body moves the place seen by (away x w), and turns the axis seen by -w.
    cross = np.array(
        [[0.0, -away[2], away[1]], [away[2], 0.0, -away[0]], [-away[1], away[0], 0.0]]
    )
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3], jacobian[:3, 3:] = -np.eye(3), cross
    jacobian[3:, 3:] = -(np.eye(3) - np.outer(axis, axis))
    # The open turn is taken out before the inverse: nothing of it reaches what is seen.
    free = np.concatenate([np.cross(axis, -away), axis])
    scale = np.sqrt(np.maximum(np.diag(solution.information), 1e-30))
    free = free * scale / np.linalg.norm(free * scale)
    held = solution.information + np.outer(scale * free, scale * free)
    covariance = jacobian @ bounded_inverse(held) @ jacobian.T
    turn = np.kron(np.eye(2), solution.rotation.T)
    out = turn @ covariance @ turn.T
    seen = solution.rotation.T @ axis
    out[3:, 3:] += ROLL_VARIANCE * np.outer(seen, seen)
    return np.asarray(out)


def _judged(
    track: SourceTrack, frame: SourceFrame, found: list[BodySolution], freedom: int
) -> PoseEstimate:
    solution, settings, context = found[0], frame.settings, frame.context
    assert track.noise is not None
    ratio = solution.chi2 / freedom
    scale = variance_scale(track.noise, solution.chi2, freedom, UNKNOWNS, RARE, context, settings)
    covariance = scale * _covariance(frame, solution)
    sigma = float(np.sqrt(np.trace(covariance[:3, :3])))
    residual = float(np.sqrt(np.mean(solution.residual**2)))
    place, axis = seen_from(frame.axis, solution.position, solution.rotation)
    others = (
        (rival.chi2, 'another place')
        for rival in found[1:]
        if rival.converged
        and math.dist(seen_from(frame.axis, rival.position, rival.rotation)[0], place)
        > SAME_PLACE_M
    )
    state, reason = verdict(
        settings, solution.chi2, freedom, residual,
        solution.position + solution.rotation @ frame.coils.offsets.mean(axis=0),
        solution.converged, sigma, scale, 'place', rivals=others,
    )  # fmt: skip
    if state == states.OK:
        track.noise.add(ratio)
    blank = no_pose(frame.name, frame.stamp_ns, state, context.model_id, reason)
    return replace(
        blank, position=place, axis=axis, covariance=covariance, sigma_position_m=sigma,
        residual_t=residual, chi2=ratio,
    )  # fmt: skip
