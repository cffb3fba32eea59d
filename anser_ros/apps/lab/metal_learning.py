"""Learns a rigid piece of metal from a recording with reference sensors.

Answers of a lattice's points and its pose in each frame are fitted together to what references and
tools read; the refit's own estimate of the metal's place is the start, so nobody has to measure
where the metal is. How large the lattice is decides what it predicts in frames that took no part.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from anser_ros.apps.lab.metal_lattice import (
    Coils,
    KnownMetal,
    Lattice,
    Setting,
    ball_answer,
    directions_of,
    lattice_points,
    moved,
)
from anser_ros.arrays import Array, ComplexArray
from anser_ros.errors import BagError, FitError
from anser_ros.field.measurements import Measurements
from anser_ros.physics.volume import TrackedVolume
from anser_ros.refit.clouds import Excitation
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.tables import build_tables
from anser_ros.refit.witness import FREE_M, FREE_RAD, ToolReading, coil_spread, linearised
from anser_ros.sessions.nominal_board import stated_volume
from anser_ros.sessions.prepared import PreparedSession, correct
from anser_ros.stamps import NANO


class CoilReadings(NamedTuple):
    """Holds what coils read beyond the calibrated model, (S, K), T, in the emitters' phases.

    ``shared`` (2 S K, m) is the effect of errors of unit variance, T: real parts, then imaginary.
    """

    coils: Coils
    change: ComplexArray
    shared: Array


class MetalFrame(NamedTuple):
    """Holds what references and tools read of metal in one frame, at a time in s.

    The readings are those of the references, then of each tool with a pose; ``place`` (3,), m, is
    where the refit sees the metal.
    """

    time: float
    readings: tuple[CoilReadings, ...]
    place: Array


def real_parts(values: NDArray[Any]) -> Array:
    """Return real and imaginary parts of rows, one after the other: (n, ...) to (2n, ...)."""
    return np.concatenate([values.real, values.imag])


Report = Callable[[str, float], None]

TRIAL_FRAMES = 14
"""Frames that the size of a lattice is tried with."""
COUNTS, SPACINGS_M = (9, 9, 2), (0.015, 0.025, 0.035, 0.045)
"""Points across and up, and the spacings that are tried: bodies of 14 to 40 cm. A smaller lattice
than the body carries badly to other places; time grows with the cube of the points."""
MISFITS = (0.3, 0.1, 0.05, 0.02)
"""Relative error of a lattice's readings that each stage of the fit allows: with the last one from
the start, frames near the metal decide before their pose is known, and the fit gets stuck."""
LARGE_MISFIT = 0.15
"""Relative misfit of frames that took no part from which on nothing has been learnt."""
ANSWER_SIGMA, SLOPE_SIGMA = 1.0, 0.3
"""Spread of answers and slopes, in units of a conducting ball."""
START_ANSWER = -0.1
"""Answer of all points at the start: little, so that they hardly drive each other."""
PLACE_SIGMA_M, TURN_SIGMA = 0.06, 0.3
"""How far the body may be from where the refit sees it, and how far it may turn, rad."""
MOVE_M, MOVE_RAD = 0.06, 0.1
"""How far it may move and turn between two of the frames."""
ROUNDS, TRIAL_ROUNDS = 24, 10
"""Most rounds of the fit, and of a trial of a size."""
ENOUGH, STAGE_ENOUGH = 3e-3, 0.1
"""Relative gain of a round below which the fit, or a stage of it, has ended."""


def learn_metal(
    frames: Sequence[MetalFrame],
    excitation: Excitation,
    frequencies_hz: tuple[float, ...],
    volume: TrackedVolume,
    noise_t: float,
    name: str,
    report: Report = lambda stage, share: None,
) -> KnownMetal:
    """Learn the metal that is in some frames.

    Every other one of the frames, in the order of time, takes no part, and shows what is left
    unexplained. ``noise_t`` is that of a phasor component of the readings, T; ``report`` is called
    with the stage and its share done. Raises `FitError` when no lattice explains the readings.
    """
    train, held_out = frames[::2], frames[1::2]
    mean_hz = float(np.exp(np.log(frequencies_hz).mean()))
    few = train[:: max(len(train) // TRIAL_FRAMES, 1)]
    tilt = np.log(np.asarray(frequencies_hz) / mean_hz)
    setting = Setting(excitation, tilt)
    starts: dict[float, Lattice] = {}
    for count, spacing in enumerate(SPACINGS_M):
        report('trying sizes', count / len(SPACINGS_M))
        points = lattice_points(COUNTS, spacing)
        answers = np.full(len(points), START_ANSWER, dtype=complex)
        flat = np.zeros(len(points), dtype=complex)
        start = Lattice(points, ball_answer(spacing), answers, flat, mean_hz)
        trial = _Fit(start, few, setting, noise_t)
        trial.run(TRIAL_ROUNDS, MISFITS[:3])
        starts[trial.cost] = start
    fit = _Fit(starts[min(starts)], train, setting, noise_t)
    fit.run(ROUNDS, MISFITS, lambda share: report('fitting', share))
    misfit = fit.misfit(held_out)
    if misfit > LARGE_MISFIT:
        raise FitError(
            f'no rigid piece of metal explains what the references read: {misfit:.0%} of it is '
            'left in frames that took no part'
        )
    placed = [setting.placed(fit.lattice, pose) for pose in fit.poses]
    nearest = min(
        one.nearest_m(reading.coils)
        for one, frame in zip(placed, train, strict=True) for reading in frame.readings
    )  # fmt: skip
    return KnownMetal(
        name, fit.lattice, directions_of(fit.lattice, fit.covariance, setting, fit.poses, volume),
        misfit, max(one.strongest_t() for one in placed), nearest,
        fit.poses[:, :3].min(axis=0), fit.poses[:, :3].max(axis=0),
        fit.poses[len(fit.poses) // 2, 3:],
    )  # fmt: skip


class _Fit:
    """Fits answers and poses of a lattice to frames, by a damped Gauss-Newton descent."""

    def __init__(
        self, lattice: Lattice, frames: Sequence[MetalFrame], setting: Setting, noise_t: float
    ) -> None:
        self.lattice, self._frames, self._setting, self._noise = lattice, frames, setting, noise_t
        n = len(lattice)
        self._prior = np.repeat([ANSWER_SIGMA, SLOPE_SIGMA], 2 * n)
        self._pose_sigma = np.repeat([PLACE_SIGMA_M, TURN_SIGMA], 3)
        self._move_sigma = np.repeat([MOVE_M, MOVE_RAD], 3)
        self._starts = np.array([np.concatenate([f.place, np.zeros(3)]) for f in frames])
        self.poses = self._starts.copy()
        self._allowed = MISFITS[0]
        self.cost = math.inf
        self.covariance: Array = np.eye(4 * n)

    def run(
        self, rounds: int, misfits: Sequence[float], report: Callable[[float], None] | None = None
    ) -> None:
        """Descend through stages that allow less and less misfit."""
        stages = list(misfits)
        self._allowed, damping = stages.pop(0), 1e-3
        self.cost = self._cost_of(self.lattice, self.poses)
        for count in range(rounds):
            if report is not None:
                report(count / rounds)
            normal, pull = self._normal()
            before = self.cost
            damping = self._step(normal, pull, damping)
            gain = (before - self.cost) / before
            if gain < (STAGE_ENOUGH if stages else ENOUGH):
                if not stages:
                    break
                self._allowed, damping = stages.pop(0), 1e-3
                self.cost = self._cost_of(self.lattice, self.poses)
        m = 4 * len(self.lattice)
        self.covariance = np.asarray(np.linalg.inv(normal)[:m, :m])

    def _step(self, normal: Array, pull: Array, damping: float) -> float:
        """Take the least damped step that makes the cost less; the damping of the next one."""
        m = 4 * len(self.lattice)
        while damping < 1e3:
            damped = normal.copy()
            damped[np.diag_indices_from(damped)] *= 1.0 + damping
            step = cho_solve(cho_factor(damped), pull)
            lattice = self.lattice.with_parameters(self.lattice.parameters + step[:m])
            steps = step[m:].reshape(-1, 6)
            poses = np.array([moved(*one) for one in zip(self.poses, steps, strict=True)])
            cost = self._cost_of(lattice, poses)
            if cost < self.cost:
                self.lattice, self.poses, self.cost = lattice, poses, cost
                return max(damping / 8.0, 1e-6)
            damping *= 8.0
        return damping

    def _cost_of(self, lattice: Lattice, poses: Array) -> float:
        cost = float(((lattice.parameters / self._prior) ** 2).sum())
        cost += float((((poses - self._starts) / self._pose_sigma) ** 2).sum())
        cost += float(((np.diff(poses, axis=0) / self._move_sigma) ** 2).sum())
        for frame, pose in zip(self._frames, poses, strict=True):
            off, _ = self._rows(frame, lattice, pose, with_columns=False)
            cost += float(off @ off)
        return cost

    def _rows(
        self, frame: MetalFrame, lattice: Lattice, pose: Array, *, with_columns: bool = True
    ) -> tuple[Array, Array]:
        """Return whitened readings of a frame: what is left, and columns by answers and pose."""
        placed = self._setting.placed(lattice, pose)
        left, columns = [], []
        for reading in frame.readings:
            flux = self._setting.flux(lattice, placed, reading.coils)
            # The size is that of the readings where they don't contain errors of a pose.
            size = flux if reading.shared.size else reading.change
            size_t = np.sqrt((np.abs(size) ** 2).mean(axis=1) / 2.0)
            noise = np.tile(
                np.repeat(np.hypot(self._noise, self._allowed * size_t), len(flux[0])), 2
            )
            parts = [real_parts((reading.change - flux).ravel())[:, None]]
            if with_columns:
                by = self._setting.answer_columns(lattice, placed, reading.coils)
                pose_by = self._setting.pose_columns(lattice, pose, reading.coils)
                parts.append(real_parts(by.reshape(flux.size, -1)))
                parts.append(real_parts(pose_by.reshape(flux.size, -1)))
            table = np.concatenate(parts, axis=1)
            if reading.shared.size:
                factor = np.linalg.cholesky(np.diag(noise**2) + reading.shared @ reading.shared.T)
                table = solve_triangular(factor, table, lower=True)
            else:
                table /= noise[:, None]
            left.append(table[:, 0])
            columns.append(table[:, 1:])
        return np.concatenate(left), np.concatenate(columns)

    def _normal(self) -> tuple[Array, Array]:
        """Return the normal matrix and right side of answers (4n), then poses (6 a frame)."""
        m, count = 4 * len(self.lattice), len(self._frames)
        normal, pull = np.zeros((m + 6 * count, m + 6 * count)), np.zeros(m + 6 * count)
        for f, (frame, pose) in enumerate(zip(self._frames, self.poses, strict=True)):
            off, columns = self._rows(frame, self.lattice, pose)
            answers, own = columns[:, :m], columns[:, m:]
            at = slice(m + 6 * f, m + 6 * f + 6)
            normal[:m, :m] += answers.T @ answers
            normal[:m, at] = answers.T @ own
            normal[at, :m] = normal[:m, at].T
            normal[at, at] = own.T @ own
            pull[:m] += answers.T @ off
            pull[at] = own.T @ off
        which = np.arange(m)
        normal[which, which] += self._prior**-2.0
        pull[:m] -= self.lattice.parameters / self._prior**2
        weight = self._move_sigma**-2.0
        for f in range(count):
            own_rows = m + 6 * f + np.arange(6)
            normal[own_rows, own_rows] += self._pose_sigma**-2.0
            pull[own_rows] -= (self.poses[f] - self._starts[f]) / self._pose_sigma**2
            if f + 1 < count:
                after, move = own_rows + 6, (self.poses[f + 1] - self.poses[f]) * weight
                normal[own_rows, own_rows] += weight
                normal[after, after] += weight
                normal[after, own_rows] -= weight
                normal[own_rows, after] -= weight
                pull[own_rows] += move
                pull[after] -= move
        return normal, pull

    def misfit(self, frames: Sequence[MetalFrame]) -> float:
        """Return the relative misfit of references in other frames, between poses of the fit's."""
        times = np.array([frame.time for frame in self._frames])
        left = size = 0.0
        for frame in frames:
            pose = np.array([np.interp(frame.time, times, self.poses[:, i]) for i in range(6)])
            for _ in range(3):
                off, columns = self._rows(frame, self.lattice, pose)
                own = columns[:, 4 * len(self.lattice) :]
                normal = own.T @ own + np.diag(self._pose_sigma**-2.0)
                pose = moved(pose, np.asarray(np.linalg.solve(normal, own.T @ off)))
            reading = frame.readings[0]
            placed = self._setting.placed(self.lattice, pose)
            flux = self._setting.flux(self.lattice, placed, reading.coils)
            noise = 2.0 * flux.size * self._noise**2
            left += max(float((np.abs(reading.change - flux) ** 2).sum()) - noise, 0.0)
            size += float((np.abs(reading.change) ** 2).sum())
        return math.sqrt(left / size)


FRAMES = 80
"""Frames that metal is learnt from, half of which only show what is left unexplained."""
SMOOTHED = 12
"""Frames before and after over which the refit's place of the metal is averaged, half a second."""
SAME_TIME_S = 1e-4
"""Difference of the stamps of references and tools in one frame, at most."""


def learn(
    prepared: PreparedSession, name: str, report: Report = lambda stage, share: None
) -> KnownMetal:
    """Learn the metal that moves in a session, and report the stages and their shares done.

    It must have references, a baseline without the metal, and a tool with optical poses. Raises
    `BagError` when the session lacks what is needed, or no rigid piece explains it.
    """
    session = prepared.session
    if session.reference is None or not len(session.reference.sensors):
        raise BagError(f'{session.path}: metal is learnt with reference sensors, there are none')
    if prepared.baseline is None:
        raise BagError('metal is learnt against --baseline, a recording without it')
    settings = session.setup.refit
    tables = build_tables(
        prepared.model, session.reference.sensors, settings, prepared.nominal.field,
        stated_volume(session.setup), report=lambda share: report('preparing', share),
    )  # fmt: skip
    refit = LiveRefit(
        prepared.model, session.reference.sensors, prepared.baseline.flux, settings, tables=tables
    )
    report('reading', 0.0)
    frames = metal_frames(prepared, refit, tables.excitation.phase, FRAMES)
    try:
        return learn_metal(
            frames, tables.excitation, prepared.model.frequencies_hz, prepared.volume,
            settings.accuracy.flux_noise_t, name, report,
        )  # fmt: skip
    except FitError as error:
        raise BagError(f'{session.path}: {error}') from error


def metal_frames(
    prepared: PreparedSession, refit: LiveRefit, phase: ComplexArray, count: int
) -> list[MetalFrame]:
    """Return at most ``count`` frames, spread evenly over those with metal.

    The session must have references, a baseline and optical poses of the tools; ``phase`` (K,) is
    that of the emitters' fields. Raises `BagError` when the session has no metal, or no tool with
    poses.
    """
    session = correct(prepared).session
    reference, baseline = session.reference, prepared.baseline
    assert reference is not None and baseline is not None
    places = np.full((len(reference.time), 3), np.nan)
    for row, time in enumerate(reference.time.tolist()):
        result = refit.update(
            session.start_ns + round(time / NANO), reference.sensors.channel,
            reference.flux[row], reference.flags[row],
        )  # fmt: skip
        if result.metal is not None:
            places[row] = result.metal.centroid
    there = np.flatnonzero(np.isfinite(places[:, 0]))
    if there.size < count:
        raise BagError(
            f'{session.path}: the references see metal in {there.size} frames, {count} are needed'
        )
    noise, out = session.setup.refit.accuracy.flux_noise_t, []
    for row in there[np.linspace(0, there.size - 1, count).astype(int)].tolist():
        change = (reference.flux[row] - baseline.flux) * phase.conj()
        good = np.isfinite(change).all(axis=1) & reference.valid[row]
        fixed, read = reference.sensors.select(np.flatnonzero(good)), change[good]
        coils = Coils(fixed.position, fixed.axis, fixed.length)
        readings = [CoilReadings(coils, read, np.zeros((2 * read.size, 0)))]
        for tool in session.tools:
            near = np.flatnonzero(np.abs(tool.time - reference.time[row]) < SAME_TIME_S)
            if near.size and tool.has_pose[near[0]] and tool.valid[near[0]].any():
                readings.append(_of_tool(tool, int(near[0]), prepared, phase.conj() / noise))
        around = places[max(row - SMOOTHED, 0) : row + SMOOTHED + 1]
        out.append(
            MetalFrame(float(reference.time[row]), tuple(readings), np.nanmean(around, axis=0))
        )
    if not any(len(frame.readings) > 1 for frame in out):
        raise BagError(f'{session.path}: no tool has optical poses while metal is there')
    return out


def _of_tool(
    tool: Measurements, row: int, prepared: PreparedSession, turn: ComplexArray
) -> CoilReadings:
    settings = prepared.session.setup.refit
    accuracy, noise = settings.accuracy, settings.accuracy.flux_noise_t
    used = np.flatnonzero(tool.valid[row])
    table = tool.sensors.select(used)
    reading = ToolReading(table, tool.flux[row, used], tool.position[row], tool.rotation[row])
    rows = linearised(reading, prepared.model, prepared.model.moments, turn)
    jitter = np.repeat([accuracy.optical_position_m, accuracy.optical_rotation_rad], 3)
    by_pose = rows.pose * jitter / np.repeat([FREE_M, FREE_RAD], 3)
    by_own = rows.own * coil_spread(len(used), settings.tools)
    shared = noise * real_parts(np.concatenate([by_pose, by_own], axis=1))
    change = noise * rows.left.reshape(len(used), -1)
    return CoilReadings(Coils(rows.at, rows.axes, table.length), change, shared)
