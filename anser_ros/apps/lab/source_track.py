"""Tracks where an axisymmetric source is, seen from a body with many sensors.

A field that is the same all around its axis leaves one of a body's six degrees of freedom open:
the turn about that axis. Jointly, the sensors determine the place of the source in the body's
frame and the direction of its axis. These are five numbers, like a coil's pose; by reciprocity, a
magnet in front of an array of magnetometers is tracked in this way.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from anser_ros import pose_states as states
from anser_ros.arrays import Array, Booleans
from anser_ros.field.model import SymmetryAxis, symmetry_axis
from anser_ros.physics.rotations import nearest_rotation, rotation_of_vector
from anser_ros.refit.prior import vector_basis
from anser_ros.sessions.prepared import PreparedSession, with_truth
from anser_ros.sessions.tracked_session import PoseSeries, pose_series
from anser_ros.stamps import NANO
from anser_ros.tracking.body_track import BodyFrame, Start
from anser_ros.tracking.coil_step import UNKNOWNS
from anser_ros.tracking.estimate import FRESH_NOISE, PoseEstimate, add_frame
from anser_ros.tracking.rigid import BodyCoils, BodySolution, solve_body
from anser_ros.tracking.seed import SAME_PLACE_M
from anser_ros.tracking.solve import ROLL_VARIANCE, bounded_inverse
from anser_ros.tracking.solve_context import ModelArrays
from anser_ros.tracking.solve_verdict import RARE, Freedom, SolveFrame

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

    ``near``, ``far``: least and largest distance of the source from the body's middle, m.
    """

    def __init__(self, coils: BodyCoils, near: float, far: float) -> None:
        self._coils, middle = coils, coils.offsets.mean(axis=0)
        shells = near * RATIO ** np.arange(math.ceil(math.log(far / near) / math.log(RATIO)) + 1)
        places = middle + (shells[:, None, None] * _directions()).reshape(-1, 3)
        gap = np.linalg.norm(places[:, None] - coils.offsets[None], axis=2).min(axis=1)
        self.places = places[gap > NEAREST * near]
        basis = self._basis(self.places)
        self._span = np.linalg.qr(basis / np.linalg.norm(basis, axis=(1, 2))[:, None, None])[0]

    def _basis(self, places: Array) -> Array:
        """Flux in every coil of unit dipoles along x, y and z at places (G, 3): (G, S, 3)."""
        basis = vector_basis(self._coils.offsets, self._coils.axes, None, places)
        return basis.swapaxes(0, 1)

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
        for place in self.places[chosen]:
            moment = np.linalg.lstsq(self._basis(place[None])[0], flux, rcond=1e-12)[0]
            out.append((place, moment / max(float(np.linalg.norm(moment)), 1e-300)))
        return out


def _directions() -> Array:
    """Points spread evenly over the unit sphere (Fibonacci's lattice), shape (DIRECTIONS, 3)."""
    steps = np.arange(DIRECTIONS) + 0.5
    z, turn = 1.0 - 2.0 * steps / DIRECTIONS, np.pi * (1.0 + math.sqrt(5.0)) * steps
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


@dataclass
class SourceTrack:
    """Remembers one body: its scan, the last good pose and when it was, the noise scale."""

    good: BodySolution | None = None
    good_ns: int = 0
    noise: Array = field(default_factory=lambda: np.array(FRESH_NOISE))
    scan: SourceScan | None = None
    coils: BodyCoils | None = None


class Sources:
    """Follows the source that each body sees, as an observer of the tracker.

    ``found``: of each body in the last frame, where the field is the same all around an axis:
    place (m) and axis of the source in the body's frame.
    """

    KIND = 'sources'

    def __init__(self) -> None:
        self._tracks: dict[str, SourceTrack] = {}
        self.found: dict[str, PoseEstimate] = {}

    def forget(self) -> None:
        """Drop the last poses, so that the next solves start cold."""
        for track in self._tracks.values():
            track.good = None

    def observe(self, bodies: Sequence[BodyFrame]) -> None:
        """Find the source in the frame of each body, if the field is that of one."""
        self.found = {
            body.name: track_source(
                self._tracks.setdefault(body.name, SourceTrack()), _SourceFrame(body, axis)
            )
            for body in bodies
            if (axis := body.context.symmetry) is not None
        }

    @staticmethod
    def compare(
        prepared: PreparedSession, estimates: Mapping[str, Sequence[PoseEstimate]]
    ) -> dict[str, PoseSeries]:
        """Compare where bodies saw the source with where the optical poses say it was."""
        model, out = prepared.model, {}
        axis = symmetry_axis(model.positions, model.directions, model.moments)
        for tool in prepared.session.tools:
            if axis is None or tool.body not in estimates:
                continue
            true = with_truth(tool, prepared.correction)
            position = np.where(true.has_pose[:, None], true.position, np.nan)
            place, direction = seen_from(axis, position, true.rotation)
            name = f'{tool.body}/source'
            out[tool.body] = pose_series(name, estimates[tool.body], place, direction)
        return out


class _SourceFrame(SolveFrame):
    """One frame's fluxes (S, 2K) of a body in the field of an axisymmetric source."""

    def __init__(self, body: BodyFrame, axis: SymmetryAxis) -> None:
        super().__init__(body.name, body.stamp_ns, body.flux, body.context, body.settings)
        self.coils, self.used, self.axis = body.coils, body.usable, axis

    @cached_property
    def live(self) -> Booleans:
        """Return which flux components (2K,) carry anything: a constant one has no quadrature."""
        return np.asarray((self.flux != 0.0).any(axis=0))

    @cached_property
    def model(self) -> ModelArrays:
        """Return the model of the live components only, without its uncertainty."""
        whole, none = self.context.arrays, np.empty((0, 0))
        return whole._replace(
            moments=np.ascontiguousarray(whole.moments[:, self.live]),
            sigma=whole.sigma[self.live], uncertain=np.empty((6, 0)), modes=none, strengths=none,
        )  # fmt: skip

    def solved(self, start: Start) -> BodySolution:
        """Descend to the pose near a start."""
        flux = np.ascontiguousarray(self.flux[np.ix_(self.used, self.live)])
        return solve_body(self.coils.subset(self.used), flux, self.model, *start)

    def starts(self, scan: SourceScan) -> list[Start]:
        """Return poses of the body for the scan's best places."""
        column = int(np.argmax((self.flux[self.used] ** 2).sum(axis=0)))
        whole = self.context.field
        moment = whole.moments[:, column] @ whole.directions
        out = []
        for place, towards in scan.best(self.flux[:, column]):
            rotation = nearest_rotation(np.outer(moment, towards))
            out.append(self.rolled(self.axis.point - rotation @ place, rotation))
        return out

    def rolled(self, position: Array, rotation: Array) -> Start:
        """Return the pose turned about the axis to where it is nearest to the volume's middle.

        This rule fixes the rotation that cannot be observed.
        """
        axis, box = self.axis.direction, self.settings.box
        wanted = (np.array(box.low) + np.array(box.high)) / 2.0 - self.axis.point
        here = position + rotation @ self.coils.offsets.mean(axis=0) - self.axis.point
        wanted, here = wanted - axis * (axis @ wanted), here - axis * (axis @ here)
        angle = math.atan2(float(axis @ np.cross(here, wanted)), float(here @ wanted))
        turn = rotation_of_vector(angle * axis)
        return self.axis.point + turn @ (position - self.axis.point), turn @ rotation


def track_source(track: SourceTrack, frame: _SourceFrame) -> PoseEstimate:
    """Estimate where the source is in the body's frame, from all usable sensors.

    The estimate's position (m), axis and covariance are in the body's frame.
    """
    used, settings = frame.used, frame.settings
    if len(used) < FEWEST_SENSORS:
        reason = (
            f'{len(used)} sensors usable, {FEWEST_SENSORS} are needed to find and judge the source'
        )
        return frame.no_pose(states.STALE, reason)
    if track.scan is None or track.coils is not frame.coils:
        near, far = _distances(frame)
        track.scan, track.coils = SourceScan(frame.coils, near, far), frame.coils
        track.noise = np.array(FRESH_NOISE)
    good, found = track.good, []
    if good is not None and (frame.stamp_ns - track.good_ns) * NANO <= settings.warm_age_s:
        found = [frame.solved(frame.rolled(good.position, good.rotation))]
    freedom = len(used) * int(frame.live.sum()) - UNKNOWNS
    if not found or not found[0].chi2 <= settings.gate**2 * freedom:
        found = [frame.solved(start) for start in frame.starts(track.scan)]
        found.sort(key=lambda solution: solution.chi2)
    estimate = _judged(track, frame, found, freedom)
    if estimate.state == states.OK:
        track.good, track.good_ns = found[0], frame.stamp_ns
    return estimate


def _distances(frame: _SourceFrame) -> tuple[float, float]:
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


def _covariance(frame: _SourceFrame, solution: BodySolution) -> Array:
    """Covariance (6, 6) of place and turn of the source, body's frame; its roll is unknown."""
    away, axis = frame.axis.point - solution.position, frame.axis.direction
    # A turn w of the body moves the place seen by (away x w), and turns the axis seen by -w.
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3], jacobian[:3, 3:] = -np.eye(3), np.cross(away, np.eye(3)).T
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
    track: SourceTrack, frame: _SourceFrame, found: list[BodySolution], freedom: int
) -> PoseEstimate:
    solution = found[0]
    place, axis = seen_from(frame.axis, solution.position, solution.rotation)
    others = (
        (rival.chi2, 'another place')
        for rival in found[1:]
        if rival.converged
        and math.dist(seen_from(frame.axis, rival.position, rival.rotation)[0], place)
        > SAME_PLACE_M
    )
    estimate = frame.estimate(
        track.noise, solution, Freedom(freedom, UNKNOWNS, RARE, freedom),
        (place, axis, None),
        lambda _: _covariance(frame, solution), others,
        solution.position + solution.rotation @ frame.coils.offsets.mean(axis=0), 'place',
    )  # fmt: skip
    if estimate.state == states.OK:
        add_frame.py_func(track.noise, estimate.chi2, 0.0)
    return estimate
