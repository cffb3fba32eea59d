"""Sets a session of poses up for fitting: the body's path, what is predicted, and its errors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.apps.poses.effect import PoseSetting, PoseTerm, PoseView, Role, frames_of
from anser_ros.apps.poses.path import OpticalPath
from anser_ros.apps.poses.sequence import PoseSequence
from anser_ros.calibration.readings import FOLDS
from anser_ros.diagnosis.engine import BlockSums, JointState, block_sums, joined

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

Ints = NDArray[np.int64]

FILTER_STEP = 0.05
"""Share of a filter's time constant by which it is changed for differences. Smaller meets the
filter's grid; larger, its curvature."""


@dataclass(frozen=True)
class PoseNoise:
    """States how far a sensor's poses are off without any effect, one standard deviation."""

    position_m: float  # of each coordinate
    orientation_rad: float
    stamp_s: float = 0.0  # of the stamps against each other: moves a pose along its own velocity

    def whitened(self, values: Array, velocity: Array) -> Array:
        """Return values (n, 6, ...) in units of their spread; velocity (n, 6) as in `PoseView`."""
        scale = np.repeat([1 / self.position_m, 1 / self.orientation_rad], 3)
        shape = (1, 6) + (1,) * (values.ndim - 2)
        return self.without_stamps(values * scale.reshape(shape), velocity)

    def without_stamps(self, values: Array, velocity: Array) -> Array:
        """Return values (n, 6, ...) of unit spread without what errors of stamps add."""
        if self.stamp_s == 0.0:
            return values
        scale = np.repeat([1 / self.position_m, 1 / self.orientation_rad], 3)
        along = velocity * scale * self.stamp_s
        size = np.linalg.norm(along, axis=1)
        unit = along / np.maximum(size, 1e-12)[:, None]
        less = 1 - 1 / np.sqrt(1 + size**2)
        part = np.einsum('ni,ni...->n...', unit, values)
        return np.asarray(values - np.einsum('n,ni,n...->ni...', less, unit, part))


@dataclass(frozen=True)
class PoseProblem:
    """Holds everything that a fit starts from; what is one of each sensor stands in tuples."""

    sensors: tuple[PoseSequence, ...]  # poses in the order of time; repeats are left out
    path: OpticalPath  # of the reference
    setting: PoseSetting
    blocks: tuple[Ints, ...]  # (n,), number of the time block that each pose is in
    places: tuple[Ints, ...]  # (n,), number of the block of space
    weight: tuple[Array, ...]  # (n,), square root of what a pose counts; zero leaves it out
    noise: tuple[PoseNoise, ...]

    def rows(self, keep: Sequence[NDArray[np.generic]]) -> 'PoseProblem':
        """Return the poses of each sensor that are named by index or mask."""
        return replace(
            self,
            sensors=tuple(s.rows(k) for s, k in zip(self.sensors, keep, strict=True)),
            blocks=tuple(b[k] for b, k in zip(self.blocks, keep, strict=True)),
            places=tuple(p[k] for p, k in zip(self.places, keep, strict=True)),
            weight=tuple(w[k] for w, k in zip(self.weight, keep, strict=True)),
        )

    def in_blocks(self, wanted: Ints) -> 'PoseProblem':
        """Return the problem with only the poses in some blocks of time."""
        return self.rows([np.isin(blocks, wanted) for blocks in self.blocks])

    def state(self, terms: Sequence[PoseTerm]) -> 'PoseState':
        """Return all poses predicted with some active effects, and what they are missed by."""
        parts = []
        for i, sensor in enumerate(self.sensors):
            view, residual, known = _predicted(self.path, sensor, terms)
            weight = np.where(known, self.weight[i], 0.0)
            parts.append(PosePart(view, residual, weight, self.noise[i], self.blocks[i],
                                  self.places[i]))  # fmt: skip
        return PoseState(self, tuple(terms), tuple(parts))


def _predicted(
    path: OpticalPath, sensor: PoseSequence, terms: Sequence[PoseTerm]
) -> tuple[PoseView, Array, Mask]:
    """View, residual (n, 6) measured less predicted, and where the reference is known."""
    time, position, rotation = sensor.time, sensor.position, sensor.rotation
    frames = frames_of(terms, sensor.name)
    frame, lever = frames.rotation, frames.lever
    for term in terms:
        path = term.effect.filter(term, path) if term.acts_on(sensor.name) else path
        time = term.effect.clock(term, sensor.name, time)
        position = term.effect.corrected(term, sensor.name, position)
    optical, turn, velocity, known = path.at(time)
    for term in terms:
        optical = term.effect.seen(term, optical)
    body = frame @ turn
    arm = body @ lever
    predicted = optical @ frame.T + arm + frames.translation
    moving = np.empty((time.size, 6))
    moving[:, 3:] = velocity[:, 3:] @ frame.T
    moving[:, :3] = velocity[:, :3] @ frame.T + np.cross(moving[:, 3:], arm)
    predicted_turn = body @ frames.mount
    view = PoseView(
        sensor.name, sensor.time, sensor.position, sensor.rotation, optical, turn, frame, lever,
        predicted, predicted_turn, moving,
    )  # fmt: skip
    residual = np.empty((time.size, 6))
    residual[:, :3] = position - predicted
    difference = rotation @ predicted_turn.transpose(0, 2, 1)
    if time.size:
        residual[:, 3:] = Rotation.from_matrix(difference).as_rotvec()
    return view, residual, known


@dataclass(frozen=True)
class PosePart:
    """Holds one sensor's prediction and residual."""

    view: PoseView
    residual: Array  # (n, 6), measured less predicted: m, and rad along the tracker's axes
    weight: Array  # (n,), square root of what a pose counts
    noise: PoseNoise
    blocks: Ints  # (n,)
    places: Ints  # (n,)

    @cached_property
    def white(self) -> Array:
        """Return residuals in units of their spread, weighted, shape (n, 6)."""
        return self.weight[:, None] * self.noise.whitened(self.residual, self.view.velocity)

    @property
    def used(self) -> Mask:
        """Return a mask (n,) of the poses that have a weight."""
        return self.weight > 0

    @property
    def count(self) -> int:
        """Return the number of values that have a weight, six a pose."""
        return 6 * int(np.count_nonzero(self.used))


@dataclass(frozen=True)
class PoseState(JointState[PoseTerm, PosePart]):
    """Holds a problem of poses with a list of active terms."""

    problem: PoseProblem
    folds: ClassVar[int] = FOLDS

    @property
    def numbers(self) -> Ints:
        """Return the numbers of the blocks."""
        return np.unique(np.concatenate([part.blocks for part in self.parts]))

    @property
    def in_space(self) -> 'PoseState':
        """Return the state with blocks of space in place of those of time."""
        return replace(self, parts=tuple(replace(p, blocks=p.places) for p in self.parts))

    def moved(self, terms: Sequence[PoseTerm]) -> 'PoseState':
        """Return the state of the same problem with other terms."""
        return self.problem.state(terms)

    def rms(self, sensor: str | None = None) -> tuple[float, float]:
        """Return distance (m) and angle (rad), root mean square over the poses that count."""
        chosen = [p.residual[p.used] for p in self.parts if sensor in (None, p.view.sensor)]
        every = np.concatenate(chosen) if chosen else np.zeros((0, 6))
        if not len(every):
            return float('nan'), float('nan')
        squares = np.mean(every**2, axis=0)
        return float(np.sqrt(squares[:3].sum())), float(np.sqrt(squares[3:].sum()))

    def design(self, term: PoseTerm, probe: bool = False) -> list[Array | None]:
        """Return whitened columns of a term, one array (n, 6, q) a sensor."""
        return self._whitened(self._slopes(term))

    def sums_with(self, filter_slopes: bool = False, stamps_exact: bool = False) -> BlockSums:
        """Return normal equations by the slopes of filters, or as if the stamps were exact.

        Time constants of filters, which have no slopes of their own, count by differences.
        Positions alone tell times then: how a tracker takes means of orientations (of vectors,
        quaternions or matrices) is not known, and moves a time constant by two standard
        deviations. With ``stamps_exact`` the normal equations are the scores' variance if the
        stamps have no errors after all, with the weights as they are.
        """
        is_filtered = filter_slopes and any(term.role is Role.FILTER for term in self.terms)
        groups = []
        for term in self.terms:
            is_filter = is_filtered and term.role is Role.FILTER
            slopes = self._differences(term) if is_filter else self._slopes(term)
            if is_filtered and (is_filter or term.role.is_clock):
                for slope in slopes:
                    slope[:, 3:] = 0.0
            groups.append(self._whitened(slopes, stamps_exact))
        return block_sums(self.parts, joined(groups), self.numbers)

    def _slopes(self, term: PoseTerm) -> list[Array]:
        """Slopes (n, 6, q) of predicted less measured poses by a term's parameters."""
        found = [term.effect.slopes(term, part.view) for part in self.parts]
        return [
            np.zeros((*part.residual.shape, term.theta.size)) if slope is None else slope
            for part, slope in zip(self.parts, found, strict=True)
        ]

    def _differences(self, term: PoseTerm) -> list[Array]:
        """The same by a filter's time constant, (n, 6, 1)."""
        step = FILTER_STEP * term.theta
        more, less = (
            self.moved([t.with_theta(t.theta + way * step) if t is term else t
                        for t in self.terms]).parts
            for way in (1, -1)
        )  # fmt: skip
        return [
            (b.residual - a.residual)[:, :, None] / (2 * step[0])
            for a, b in zip(more, less, strict=True)
        ]

    def _whitened(self, slopes: Sequence[Array], stamps_exact: bool = False) -> list[Array | None]:
        out: list[Array | None] = []
        for part, slope in zip(self.parts, slopes, strict=True):
            columns = part.noise.whitened(slope, part.view.velocity)
            if stamps_exact:
                columns = part.noise.without_stamps(columns, part.view.velocity)
            out.append(columns * part.weight[:, None, None])
        return out
