"""What the best possible estimator could know of moving metal, by few references and a tool.

The Bayesian Cramer-Rao bound: the posterior covariance of all that is unknown (metal, path, errors
of all coils, poses), linearised at simulated bodies that are drawn from a class, from every
frame of a session up to the one in question. It assumes

- the class: 147 points, 35 mm apart, in a block of 245 x 245 x 105 mm, which drive each other.
  Each has an answer of its own, as large as that of a conducting ball that fills its place, in
  both phases, and a part of it changes with the frequency. The estimator knows the block, and real
  metal leaves nothing over: both make the bound optimistic;
- the path: `PATHS`, of which the estimator knows that it is smooth (a spline of place and turn
  with a knot every 2.5 s), and nothing else;
- noise and errors of references and tool: as large as the session's setup states them;
- board, references and places of the tool: those of the recorded sessions, whose truth is not
  read.

A *known* body was seen in the other session by all references and by the tool at its optical
poses. With *one frame* there is no memory: of the metal is known what was known before, and what
this frame tells. A single coil is tracked alone in the field that all readings together determine.
Errors are those by the field and by noise; the tool's own, and the jitter of the optical pose that
measured ones contain, are not in them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import harness
import numpy as np
from ablation import spread_out
from bound_block import Block, block_points
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_triangular

from anser_ros.field.model import FieldModel
from anser_ros.physics.dipole import flux_jacobian
from anser_ros.physics.rotations import tangents
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.clouds import Excitation, excitation_for
from anser_ros.refit.witness import FREE_M, FREE_RAD, ToolReading, linearised
from anser_ros.sessions.nominal_board import NominalBoard, stated_volume
from anser_ros.sessions.session import Session, load_session

PATHS = {
    'online/approach': (6.0, 30.0, (0.0, 0.0, -0.30), (0.0, 0.0, -0.006)),
    'online/sweep': (5.0, 35.0, (-0.30, 0.0, -0.05), (0.30, 0.0, -0.05)),
}
"""As the sessions are described: begin and end, s, and the middle of the body's top then, m."""
KNOTS, KNOT_SIGMA = 17, 0.3
"""Of the path, and what is known of each, m and rad."""
ALL = 99
"""References, more than there are."""
SEED = 101


def real(rows: Any) -> Any:
    """Real parts above imaginary ones."""
    return np.concatenate([rows.real, rows.imag])


@dataclass
class Frame:
    """Rows of a tool's readings by all unknowns, by its pose, and of each coil by its own."""

    rows: Any
    pose: Any
    coils: list[tuple[Any, Any]]


class Scene:
    """A session with a simulated body instead of the recorded metal."""

    def __init__(
        self, name: str, session: Session, model: FieldModel, body: Block, exc: Excitation,
        count: int, every: int,
    ) -> None:  # fmt: skip
        self.body, self.exc, self.model, self.every = body, exc, model, every
        accuracy, tools = session.setup.accuracy, session.setup.refit.tools
        assert session.reference is not None
        sensors = session.reference.sensors
        chosen = spread_out(sensors, count) if count else np.empty(0, np.int64)
        self.references: SensorTable = sensors.select(chosen)
        self.tool = session.tools[0].frames(slice(None, None, every))
        self.noise_t, self.accuracy = accuracy.flux_noise_t, accuracy
        time = session.reference.time[::every]
        knots = np.linspace(time[0], time[-1], KNOTS)
        self.spline = CubicSpline(knots, np.eye(KNOTS), bc_type='natural')(time)
        begin, end, start, stop = PATHS[name]
        share = np.clip((time - begin) / (end - begin), 0.0, 1.0)[:, None]
        share = share**2 * (3.0 - 2.0 * share)
        path = np.array(start) * (1.0 - share) + np.array(stop) * share
        self.places = np.concatenate([path, np.zeros_like(path)], axis=1)
        gain, place, axis = (
            tools.tool_coil_gain, tools.tool_coil_position_m, tools.tool_coil_axis_rad
        )  # fmt: skip
        self.tool_sigma = np.tile([gain] * 2 + [place] * 3 + [axis] * 2, len(self.tool.sensors))
        self.survey = np.array(
            [accuracy.reference_gain] * 2 + [accuracy.reference_position_m] * 3
            + [accuracy.reference_axis_rad] * 2
        )  # fmt: skip
        self.metal = 4 * len(block_points())
        self.shared = self.metal + 6 * KNOTS
        self.size = self.shared + len(self.tool_sigma) + 7 * len(chosen)
        self.frames = range(len(time))

    def _spread(self, frame: int, columns: Any) -> Any:
        """Columns by metal and place at an instant, as columns by metal and path."""
        path = np.einsum('ra,b->rba', columns[:, self.metal :], KNOT_SIGMA * self.spline[frame])
        return np.concatenate([columns[:, : self.metal], path.reshape(len(columns), -1)], axis=1)

    def frame(self, frame: int) -> Frame:
        """What the tool reads, over the noise."""
        tool, place = self.tool, self.places[frame]
        model = self.body.in_field(place, self.exc, self.model)
        reading = ToolReading(
            tool.sensors, np.zeros((len(tool.sensors), len(model.emitters)), complex),
            tool.position[frame], tool.rotation[frame],
        )  # fmt: skip
        found = linearised(reading, model, model.moments, self.exc.phase.conj() / self.noise_t)
        by = self.body.columns(place, self.exc, found.at, found.axes, tool.sensors.length)
        by = self._spread(frame, by / self.noise_t)
        rows = np.zeros((len(by), self.size), complex)
        rows[:, : self.shared] = by
        rows[:, self.shared : self.shared + len(self.tool_sigma)] = found.own * self.tool_sigma
        k = len(model.emitters)
        coils = []
        for s in range(len(tool.sensors)):
            own = slice(s * k, (s + 1) * k)
            whole = np.zeros((k, self.size), complex)
            whole[:, : self.shared] = by[own]
            coils.append((real(whole), real(found.own[own, 7 * s + 2 : 7 * s + 7])))
        return Frame(real(rows), real(found.pose), coils)

    def heard(self, frame: int) -> Any:
        """Rows of what the references read."""
        table, place = self.references, self.places[frame]
        by = self.body.columns(place, self.exc, table.position, table.axis, table.length)
        points, moments = self.body.moments(place, self.exc)
        count, k = len(table), len(moments)
        flux, d_at, d_axis = flux_jacobian(
            table.position, table.axis, table.length, np.repeat(points, 3, axis=0),
            np.tile(np.eye(3), (len(points), 1)), moments.transpose(1, 2, 0).reshape(-1, k),
        )  # fmt: skip
        rows = np.zeros((count * k, self.size), complex)
        rows[:, : self.shared] = self._spread(frame, by)
        across = tangents(table.axis)
        for s in range(count):
            own = np.stack([flux[s], 1j * flux[s], *d_at[s], *(across[s] @ d_axis[s])], axis=1)
            start = self.size - 7 * (count - s)
            rows[s * k : (s + 1) * k, start : start + 7] = own * self.survey
        return real(rows / self.noise_t)

    def learnt(self) -> Any:
        """Information on the answers of the metal, the tool being at its optical poses."""
        jitter = self.accuracy.optical_position_m, self.accuracy.optical_rotation_rad
        tied = np.diag(np.repeat([FREE_M / jitter[0], FREE_RAD / jitter[1]], 3) ** 2)
        whole = sum(self._added(index, self.frame(index), tied) for index in self.frames)
        return marginal(self.every * whole, self.metal)

    def bounds(self, known: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
        """Error, mm rms, of the body's place and of single coils.

        By what is known of the answers before: information, added to their own variance of 1.
        """
        total, open_pose = np.eye(self.size), np.zeros((6, 6))
        found: dict[str, list[tuple[float, float]]] = {}
        for index in self.frames:
            frame = self.frame(index)
            told = self._added(index, frame, open_pose)
            total += self.every * told
            for kind, before in known.items():
                for name, base in (
                    (kind, total),
                    (f'{kind}, one frame', told + np.eye(self.size)),
                ):
                    whole = (base + base.T) / 2.0
                    whole[: self.metal, : self.metal] += before
                    variances = self._variances(frame, np.linalg.cholesky(whole))
                    found.setdefault(name, []).append(variances)
        return {
            kind: tuple(1e3 * np.sqrt(np.mean(values, axis=0))) for kind, values in found.items()
        }

    def _variances(self, frame: Frame, factor: Any) -> tuple[float, float]:
        """Variances of the body's place and of a coil's, by the factor of the information."""
        field = frame.rows.copy()
        field[:, self.shared :] = 0.0
        inverse = np.linalg.inv(frame.pose.T @ frame.pose)
        carried = solve_triangular(factor, field.T @ frame.pose @ inverse, lower=True)
        body = FREE_M**2 * np.trace((inverse + carried.T @ carried)[:3, :3])
        coils = []
        for rows, own in frame.coils:
            open_field = solve_triangular(factor, rows.T, lower=True)
            spread = np.eye(len(rows)) + open_field.T @ open_field
            coils.append(np.trace(np.linalg.inv(own.T @ np.linalg.solve(spread, own))[:3, :3]))
        return float(body), float(np.mean(coils))

    def _added(self, index: int, frame: Frame, tied: Any) -> Any:
        """What a frame tells, the pose of the tool being open, or known to an information."""
        crossed = frame.pose.T @ frame.rows
        told = frame.rows.T @ frame.rows
        told -= crossed.T @ np.linalg.solve(frame.pose.T @ frame.pose + tied, crossed)
        if len(self.references):
            heard = self.heard(index)
            told += heard.T @ heard
        return told


def marginal(information: Any, kept: int) -> Any:
    """Information on the first unknowns where the others are open, of unit variance before."""
    rest = information[kept:, kept:] + np.eye(len(information) - kept)
    cross = information[kept:, :kept]
    return information[:kept, :kept] - cross.T @ np.linalg.solve(rest, cross)


def rows(
    counts: Sequence[int] = (0, 4), bodies: int = 2, every: int = 16
) -> Iterator[harness.Row]:
    """Bounds for both recorded sessions; none without them."""
    scan, paths = harness.online_recordings()
    if not set(PATHS) <= set(paths):
        return
    model = harness.calibrated(load_session(scan))
    sessions = {name: load_session(paths[name]) for name in PATHS}
    setup = sessions['online/sweep'].setup
    exc, _ = excitation_for(model, NominalBoard.of(setup).field, stated_volume(setup))
    tilt = np.log(model.frequencies_hz) - np.log(model.frequencies_hz).mean()
    found: dict[tuple[str, int, str], list[tuple[float, float]]] = {}
    for index in range(bodies):
        body = Block.drawn(np.random.default_rng([SEED, index]), tilt)
        learnt = {
            name: Scene(name, session, model, body, exc, ALL, every).learnt()
            for name, session in sessions.items()
        }
        for name, session in sessions.items():
            other = next(one for one in sessions if one != name)
            for count in counts:
                scene = Scene(name, session, model, body, exc, count, every)
                known = {'unknown': 0.0, 'known': learnt[other]}
                for kind, bound in scene.bounds(known).items():
                    found.setdefault((name, count, kind), []).append(bound)
    for (name, count, kind), bounds in found.items():
        for what, value in zip(('body', 'coils'), np.mean(bounds, axis=0), strict=True):
            yield harness.row(
                f'bound, {name}, {count} references, metal {kind}, {what}: position error',
                float(value),
                'mm',
            )
