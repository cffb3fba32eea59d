"""Sets a session of poses up for fitting: what is predicted, and the errors of that."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.diagnosis.scoring import BlockSums
from anser_ros.effects.term import Term
from anser_ros.poses.effect import PoseSetting, PoseView, Role, effect_of, frames_of, is_of
from anser_ros.poses.path import OpticalPath
from anser_ros.poses.sequence import PoseSequence

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Ints = NDArray[np.int64]

FILTER_STEP = 0.05
"""Share of a filter's time constant by which it is changed for differences. Smaller meets the
filter's grid; larger, its curvature."""


@dataclass(frozen=True)
class PoseNoise:
    """States how far a sensor's poses are off without any effect, one standard deviation.

    Attributes
    ----------
    position_m, orientation_rad : float
        Of each coordinate.
    stamp_s : float
        Of the stamps against each other: moves a pose along its own velocity.
    """

    position_m: float
    orientation_rad: float
    stamp_s: float = 0.0

    def whitened(self, values: Array, velocity: Array) -> Array:
        """Return values (n, 6, ...) in units of their spread; velocity (n, 6) as in `PoseView`."""
        scale = np.repeat([1 / self.position_m, 1 / self.orientation_rad], 3)
        shape = (1, 6) + (1,) * (values.ndim - 2)
        return self.without_stamps(values * scale.reshape(shape), velocity)

    def without_stamps(self, values: Array, velocity: Array) -> Array:
        """Return values (n, 6, ...) of unit spread apart from what errors of stamps add, without
        that.
        """
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
    """Holds everything that a fit starts from.

    Attributes
    ----------
    sensors : tuple of PoseSequence
        Poses in the order of time; repeats are left out.
    path : OpticalPath
        Of the reference.
    setting : PoseSetting
    blocks : tuple of ndarray of int, one per sensor, shape (n,)
        Number of the time block that each pose is in.
    places : tuple of ndarray of int, one per sensor, shape (n,)
        Number of the block of space.
    weight : tuple of ndarray, one per sensor, shape (n,)
        Square root of what a pose counts; zero leaves it out.
    noise : tuple of PoseNoise, one per sensor
    """

    sensors: tuple[PoseSequence, ...]
    path: OpticalPath
    setting: PoseSetting
    blocks: tuple[Ints, ...]
    places: tuple[Ints, ...]
    weight: tuple[Array, ...]
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

    def state(self, terms: Sequence[Term]) -> 'PoseState':
        """Return all poses predicted with some effects in force, and what they are missed by."""
        parts = []
        for i, sensor in enumerate(self.sensors):
            view, residual, known = _predicted(self.path, sensor, terms)
            weight = np.where(known, self.weight[i], 0.0)
            parts.append(PosePart(view, residual, weight, self.noise[i], self.blocks[i],
                                  self.places[i]))  # fmt: skip
        return PoseState(self, tuple(terms), tuple(parts))


def _predicted(
    path: OpticalPath, sensor: PoseSequence, terms: Sequence[Term]
) -> tuple[PoseView, Array, Mask]:
    """View, residual (n, 6) measured less predicted, and where the reference is known."""
    time, position, rotation = sensor.time, sensor.position, sensor.rotation
    frames = frames_of(terms, sensor.name)
    frame, lever = frames.rotation, frames.lever
    for term in terms:
        effect = effect_of(term)
        path = effect.filter(term, path) if effect.acts_on(term, sensor.name) else path
        time = effect.clock(term, sensor.name, time)
        position, rotation = effect.corrected(term, sensor.name, position, rotation)
    optical, turn, velocity, known = path.at(time)
    for term in terms:
        optical = effect_of(term).seen(term, optical)
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
    """Holds one sensor's prediction and residual.

    Attributes
    ----------
    view : PoseView
    residual : ndarray, shape (n, 6)
        Measured less predicted: m, and rad along the tracker's axes.
    weight : ndarray, shape (n,)
        Square root of what a pose counts.
    noise : PoseNoise
    blocks, places : ndarray of int, shape (n,)
    """

    view: PoseView
    residual: Array
    weight: Array
    noise: PoseNoise
    blocks: Ints
    places: Ints

    @property
    def white(self) -> Array:
        """Return residuals in units of their spread, weighted, shape (n, 6)."""
        return self.weight[:, None] * self.noise.whitened(self.residual, self.view.velocity)

    @property
    def used(self) -> Mask:
        """Return a mask (n,) of the poses that have a weight."""
        return self.weight > 0


@dataclass(frozen=True)
class PoseState:
    """Holds a problem with a list of terms in force."""

    problem: PoseProblem
    terms: tuple[Term, ...]
    parts: tuple[PosePart, ...]

    @property
    def sum_of_squares(self) -> float:
        """Return the sum of squares of the whitened residuals."""
        return float(sum(np.sum(part.white**2) for part in self.parts))

    @property
    def count(self) -> int:
        """Return the number of values that have a weight, six a pose."""
        return int(6 * sum(np.count_nonzero(part.used) for part in self.parts))

    def rms(self, sensor: str | None = None) -> tuple[float, float]:
        """Return distance (m) and angle (rad), root mean square over the poses that count."""
        chosen = [p.residual[p.used] for p in self.parts if sensor in (None, p.view.sensor)]
        every = np.concatenate(chosen) if chosen else np.zeros((0, 6))
        if not len(every):
            return float('nan'), float('nan')
        squares = np.mean(every**2, axis=0)
        return float(np.sqrt(squares[:3].sum())), float(np.sqrt(squares[3:].sum()))

    def sums(
        self,
        terms: Sequence[Term] | None = None,
        in_space: bool = False,
        filter_slopes: bool = False,
        stamps_exact: bool = False,
    ) -> BlockSums:
        """Return normal equations of the terms' parameters, block by block.

        With ``filter_slopes`` time constants of filters, which have no slopes of their own, count
        by differences; otherwise they are held. Positions alone tell times then: how a tracker
        takes means of orientations (of vectors, quaternions or matrices) is not known, and moves
        a time constant by two standard deviations. With ``stamps_exact`` the normal equations are
        the scores' variance if the stamps have no errors after all, with the weights as they are.
        """
        wanted = self.terms if terms is None else tuple(terms)
        sizes = [term.theta.size for term in wanted]
        edges = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
        labels = [part.places if in_space else part.blocks for part in self.parts]
        numbers = np.unique(np.concatenate(labels)) if labels else np.zeros(0, dtype=np.int64)
        total = int(edges[-1])
        normal = np.zeros((numbers.size, total, total))
        right, squares = np.zeros((numbers.size, total)), np.zeros(numbers.size)
        filters = [t for t in wanted if is_of(t, Role.FILTER)] if filter_slopes else []
        turned = {t.name_and_site: self._differences(t) for t in filters}
        for i, (part, label) in enumerate(zip(self.parts, labels, strict=True)):
            columns = np.zeros((part.residual.shape[0], 6, total))
            for term, a, b in zip(wanted, edges[:-1], edges[1:], strict=True):
                slope = effect_of(term).slopes(term, part.view)
                if term.name_and_site in turned:
                    slope = turned[term.name_and_site][i]
                if slope is not None and turned and effect_of(term).role.moves_times:
                    slope[:, 3:] = 0.0
                if slope is not None:
                    columns[:, :, a:b] = slope
            white = part.white
            columns = part.noise.whitened(columns, part.view.velocity)
            if stamps_exact:
                columns = part.noise.without_stamps(columns, part.view.velocity)
            columns *= part.weight[:, None, None]
            for row, number in enumerate(numbers):
                chosen = label == number
                flat, rest = columns[chosen].reshape(-1, total), white[chosen].ravel()
                normal[row] += flat.T @ flat
                right[row] += flat.T @ rest
                squares[row] += rest @ rest
        return BlockSums(normal, right, squares)

    def _differences(self, term: Term) -> list[Array]:
        """Slopes (n, 6, 1) of predicted less measured poses by a filter's time constant."""
        step = FILTER_STEP * term.theta
        ends = [
            self.problem.state([t.with_theta(t.theta + way * step) if t is term else t
                                for t in self.terms]).parts
            for way in (1, -1)
        ]  # fmt: skip
        return [
            (less.residual - more.residual)[:, :, None] / (2 * step[0])
            for more, less in zip(*ends, strict=True)
        ]
