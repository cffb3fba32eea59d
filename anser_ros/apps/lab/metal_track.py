"""Follows known metal by what tools read, without reference sensors.

An extended Kalman filter holds the metal's pose and speeds, the `KnownMetal.directions` in which
its answers may be wrong, and the errors of the tools' own coils. A tool's pose is free in every
frame: it is solved for together with the metal, and what is left of the readings updates the
filter. The pose that is given out is not this one: a tracker finds it with the field that the
filter predicted from the frames before (`predicted`), so that no reading counts twice.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from anser_ros.apps.lab import metal_lattice
from anser_ros.apps.lab.metal_learning import real_parts
from anser_ros.arrays import Array, Integers
from anser_ros.field.model import FieldModel
from anser_ros.physics.sensor import SensorTable, along_each_axis
from anser_ros.refit.clouds import Excitation
from anser_ros.refit.prior import vector_basis
from anser_ros.refit.witness import (
    FREE_M,
    FREE_RAD,
    ToolReading,
    coil_spread,
    linearised,
    surroundings,
)
from anser_ros.settings import ToolSettings

MEMORY_S = 2.0
"""Time over which a lattice's misfit stays the same: it counts once in it, not in every frame."""
MISFIT_ELSEWHERE, LEAST_MISFIT = 2.0, 0.05
"""Misfit where the metal was not learnt, over that of frames between the learnt ones, and the
least that is reckoned with: frames at contact, which are strong, say little of others."""
SPEED_M_S, SPIN_RAD_S, SPEED_MEMORY_S = 0.05, 0.02, 3.0
"""Usual speed and turn of the metal, and the time for which they last."""
PLACE_M, TURN_RAD = 0.08, 0.15
"""How far the place and turn may be off where a track begins."""
POSE_ROUNDS, ROUNDS = 2, 2
"""Steps of the tool's pose with the metal as predicted, and of both: the first step of a tool that
is displaced by millimetres must not move the metal."""
FAR = 1.0
"""Change of the answers' factors from which on their screening is worked out anew."""
RATES = slice(6, 12)
"""Of a state's step, the change of the rates."""


@dataclass(frozen=True)
class MetalState:
    """Holds what is known of the metal and of the tools' coils."""

    # (6,), place (m) and rotation vector; their change, /s
    pose: Array
    rates: Array
    answers: Array  # (D,), factors of `KnownMetal.directions`
    own: Array  # (7 S,), errors of all tools' coils, as `CoilErrors`
    covariance: Array  # of a step of the pose, rates, answers and own errors, in this order

    def stepped(self, step: Array) -> 'MetalState':
        """Return the state after a step of all that it holds."""
        ends = 12 + len(self.answers)
        return replace(
            self, pose=metal_lattice.moved(self.pose, step[:6]), rates=self.rates + step[RATES],
            answers=self.answers + step[12:ends], own=self.own + step[ends:],
        )  # fmt: skip

    def step_to(self, other: 'MetalState') -> Array:
        """Return the step that leads to another state."""
        return np.concatenate(
            [
                metal_lattice.step_between(self.pose, other.pose), other.rates - self.rates,
                other.answers - self.answers, other.own - self.own,
            ]
        )  # fmt: skip


class Scene:
    """Holds what does not change: known metal, the calibrated model, and the tools' coils.

    ``sensors``: of all rigid tools. ``noise_t``: noise of a phasor component of what tools read,
    T.
    """

    def __init__(
        self,
        known: metal_lattice.KnownMetal,
        model: FieldModel,
        excitation: Excitation,
        sensors: SensorTable,
        tools: ToolSettings,
        noise_t: float,
    ) -> None:
        self.known, self.model, self.noise_t, self.tools = known, model, noise_t, tools
        self.setting = metal_lattice.Setting(excitation, known.lattice.tilt(model.frequencies_hz))
        self.turn = excitation.phase.conj() / noise_t
        self.noise = math.hypot(noise_t, model.flux_error_t) / noise_t
        self.misfit = max(MISFIT_ELSEWHERE * known.misfit, LEAST_MISFIT)
        self._lattice, self._about = known.lattice, np.zeros(known.directions.shape[1])
        self._own_row = {name: row for row, name in enumerate(sensors.name)}
        self._own_sigma = coil_spread(len(sensors), tools)

    def start(self, pose: Array) -> MetalState:
        """Return the state of metal near a pose (6,)."""
        d = self.known.directions.shape[1]
        sigma = np.concatenate(
            [
                np.repeat([PLACE_M, TURN_RAD], 3), np.repeat([SPEED_M_S, SPIN_RAD_S], 3),
                np.ones(d), self._own_sigma,
            ]
        )  # fmt: skip
        return MetalState(
            pose, np.zeros(6), np.zeros(d), np.zeros(len(self._own_sigma)), np.diag(sigma**2)
        )

    def lattice(self, answers: Array) -> metal_lattice.Lattice:
        """Return the lattice with other answers, exact or near ones to first order."""
        known = self.known
        off = answers - self._about
        if np.linalg.norm(off) > FAR:
            self._about, off = answers, 0.0 * off
            whole = known.lattice.parameters + known.directions @ answers
            self._lattice = known.lattice.with_parameters(whole)
        return self._lattice.near(known.directions @ off)

    def own_columns(self, table: SensorTable) -> Integers:
        """Return which of the state's own errors are those of some coils."""
        first = [7 * self._own_row[name] for name in table.name]
        return (np.array(first)[:, None] + np.arange(7)).ravel()


class MetalUpdate(NamedTuple):
    """Holds what a frame's readings made of a state, and their log likelihood.

    ``ratio`` is the squared misfit to the prediction per degree of freedom; 1 is expected, or
    less.
    """

    state: MetalState
    ratio: float
    log_likelihood: float


def predicted(state: MetalState, seconds: float) -> MetalState:
    """Return the state some time later."""
    keep = math.exp(-seconds / SPEED_MEMORY_S)
    on = np.eye(len(state.covariance))
    on[:6, RATES] = seconds * np.eye(6)
    on[RATES, RATES] *= keep
    covariance = on @ state.covariance @ on.T
    gained = np.repeat([SPEED_M_S, SPIN_RAD_S], 3) ** 2 * (1.0 - keep**2)
    which = np.arange(6)
    covariance[which + 6, which + 6] += gained
    covariance[which, which] += gained * seconds**2 / 3.0
    pose = metal_lattice.moved(state.pose, state.rates * seconds)
    return replace(state, pose=pose, rates=keep * state.rates, covariance=covariance)


def updated(scene: Scene, state: MetalState, reading: ToolReading, step_s: float) -> MetalUpdate:
    """Take in what a tool reads, at a pose that is near its own.

    ``state``: as predicted for the frame. ``step_s``: time between frames, s.
    """
    lasting = 1.0 + MEMORY_S / step_s
    covariance, columns = state.covariance, scene.own_columns(reading.table)
    reading = _posed(scene, state, reading, columns)
    now, ratio, likelihood = state, math.nan, math.nan
    for count in range(ROUNDS):
        rows = _rows(scene, scene.lattice(now.answers), now, reading, columns)
        off = rows.left + rows.design @ state.step_to(now)
        spread = rows.design @ covariance
        expected = spread @ rows.design.T + rows.pose @ rows.pose.T
        expected[np.diag_indices(len(off))] += scene.noise**2
        if count == 0:
            factor = cho_factor(expected + np.diag(rows.wrong), lower=True)
            misfit = float(off @ cho_solve(factor, off))
            ratio = misfit / max(len(off) - 6, 1)
            likelihood = -0.5 * misfit - float(np.log(np.diagonal(factor[0])).sum())
        factor = cho_factor(expected + np.diag(lasting * rows.wrong), lower=True)
        solved = cho_solve(factor, off)
        now = state.stepped(spread.T @ solved)
        reading = _shifted(reading, rows.pose.T @ solved)
    left = covariance - spread.T @ cho_solve(factor, spread)
    return MetalUpdate(replace(now, covariance=0.5 * (left + left.T)), ratio, likelihood)


def _posed(
    scene: Scene, state: MetalState, reading: ToolReading, columns: Integers
) -> ToolReading:
    """Return a reading at the pose that fits with the metal of a state."""
    lattice = scene.lattice(state.answers)
    whole = scene.setting.in_field(lattice, scene.setting.placed(lattice, state.pose), scene.model)
    own = 12 + len(state.answers) + columns
    return posed(scene, whole, reading, state.own[columns], state.covariance[np.ix_(own, own)])


def posed(
    scene: Scene, model: FieldModel, reading: ToolReading, errors: Array, spread: Array
) -> ToolReading:
    """Return a reading at the pose that fits with a model.

    ``reading``: at a pose that is right to some centimetres. ``errors``, ``spread`` (7 S,), (7 S,
    7 S): mean and covariance of the errors of its coils, as `CoilErrors`.
    """
    for _ in range(POSE_ROUNDS):
        rows = linearised(reading, model, model.moments, scene.turn)
        by_own, pose = real_parts(rows.own), real_parts(rows.pose)
        expected = by_own @ spread @ by_own.T + pose @ pose.T
        expected[np.diag_indices(len(expected))] += scene.noise**2
        off = real_parts(rows.left) - by_own @ errors
        reading = _shifted(reading, pose.T @ cho_solve(cho_factor(expected), off))
    return reading


def _shifted(reading: ToolReading, shift: Array) -> ToolReading:
    """Return a reading at another pose; the shift is in units of `FREE_M` and `FREE_RAD`."""
    turn = Rotation.from_rotvec(FREE_RAD * shift[3:]).as_matrix()
    return replace(
        reading, position=reading.position + FREE_M * shift[:3], rotation=turn @ reading.rotation
    )


class _Linearised(NamedTuple):
    """Readings of a tool over the noise: real parts, then imaginary parts.

    ``left`` is what they leave of the prediction, ``design`` how they depend on the state,
    ``pose`` on the tool's free pose, ``wrong`` the variance of the lattice's misfit.
    """

    left: Array
    design: Array
    pose: Array
    wrong: Array


def _rows(
    scene: Scene,
    lattice: metal_lattice.Lattice,
    state: MetalState,
    reading: ToolReading,
    columns: Any,
) -> _Linearised:
    setting, noise = scene.setting, scene.noise_t
    placed = setting.placed(lattice, state.pose)
    whole = setting.in_field(lattice, placed, scene.model)
    rows = linearised(reading, whole, whole.moments, scene.turn)
    coils = metal_lattice.Coils(rows.at, rows.axes, reading.table.length)
    count = len(rows.left)
    by_pose = setting.pose_columns(lattice, state.pose, coils).reshape(count, -1) / noise
    by = setting.answer_columns(lattice, placed, coils).reshape(count, -1)
    design = np.zeros((2 * count, len(state.covariance)))
    design[:, :6] = real_parts(by_pose)
    ends = 12 + len(state.answers)
    design[:, 12:ends] = real_parts(by @ scene.known.directions) / noise
    design[:, ends + columns] = real_parts(rows.own)
    left = real_parts(rows.left) - design[:, ends:] @ state.own
    metal = setting.flux(lattice, placed, coils) / noise
    wrong = scene.misfit**2 * (np.abs(metal) ** 2).mean(axis=1) / 2.0
    return _Linearised(
        left, design, real_parts(rows.pose), np.tile(np.repeat(wrong, metal.shape[1]), 2)
    )


def field_of(
    scene: Scene, state: MetalState, near: Array, modes: int, growth: float
) -> tuple[FieldModel, metal_lattice.PlacedLattice]:
    """Return the field with the metal of a state, and its uncertainty as modes.

    ``near`` (P, 3): where tools are, m: the modes are right there. ``growth``: factor on the
    variance of all that is uncertain.
    """
    setting, lattice = scene.setting, scene.lattice(state.answers)
    placed = setting.placed(lattice, state.pose)
    model = setting.in_field(lattice, placed, scene.model)
    at = np.unique(np.round(surroundings(near), 4), axis=0)
    coils = metal_lattice.Coils(*along_each_axis(at), None)
    by_pose = setting.pose_columns(lattice, state.pose, coils)
    by = setting.answer_columns(lattice, placed, coils) @ scene.known.directions
    effect = np.concatenate([by_pose, by], axis=2)
    which = np.r_[0:6, 12 : 12 + len(state.answers)]
    covariance = state.covariance[np.ix_(which, which)]
    effect = effect @ np.linalg.cholesky(covariance + 1e-12 * np.eye(len(which)))
    metal = setting.flux(lattice, placed, coils)
    # The misfit is a part of the metal's own field, of each axis, emitter and phase by itself.
    own = scene.misfit / math.sqrt(2.0) * _by_component(metal)
    effect = math.sqrt(growth) * np.concatenate([effect, own], axis=2)
    shape = effect.shape[:2]
    flat = real_parts(effect.reshape(-1, effect.shape[2]))
    values, vectors = np.linalg.eigh(flat.T @ flat)
    order = np.argsort(-values)[:modes]
    kept = effect.reshape(-1, effect.shape[2]) @ vectors[:, order]
    left = max(float(values.sum() - values[order].sum()), 0.0) / (2.0 * len(kept))
    fields = kept.reshape(*shape, -1)
    basis = vector_basis(coils.at, coils.axes, None, placed.points).reshape(shape[0], -1)
    inverse = np.linalg.pinv(basis, rcond=1e-6)
    moments = np.einsum('ns,skr->rnk', inverse, fields, optimize=True)
    moments = moments * setting.excitation.phase
    n = len(scene.model.positions)
    padded = np.zeros((len(order), n + moments.shape[1], moments.shape[2]), dtype=complex)
    padded[:, n:] = moments
    if scene.model.modes is not None:
        base = np.zeros((len(scene.model.modes), *padded.shape[1:]), dtype=complex)
        base[:, :n] = scene.model.modes
        padded = np.concatenate([base, padded])
    error = math.hypot(model.flux_error_t, math.sqrt(left))
    return replace(model, modes=padded, flux_error_t=error), placed


def _by_component(metal: Any) -> Any:
    """Return fields (3P, K) split by axis, emitter and phase, (3P, K, 6K)."""
    k = metal.shape[1]
    by_axis, phases = metal.reshape(-1, 3, k), np.array([1.0, 1.0j])
    out = np.einsum('pae,c,ab,ef->paecbf', by_axis, phases, np.eye(3), np.eye(k))
    return out.reshape(*metal.shape, -1)


def near_points(readings: Sequence[ToolReading]) -> Array:
    """Return the places (P, 3) of some tools' coils, each once, m."""
    at = [one.table.placed(one.position, one.rotation)[0] for one in readings]
    return np.unique(np.round(np.concatenate(at), 3), axis=0)
