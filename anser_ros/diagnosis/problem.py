"""Sets a session up for diagnosis: what was measured, what is expected, and the rows in blocks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.engine import JointState
from anser_ros.diagnosis.whitening import Spread, Whitener, parts, pose_jacobian
from anser_ros.effects.apparatus import Apparatus
from anser_ros.effects.effect import Remedy
from anser_ros.effects.prediction import Fields, reference_view, tool_view
from anser_ros.effects.term import Term
from anser_ros.effects.view import View
from anser_ros.field.measurements import Measurements

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class References:
    """Holds reference readings as means over short bins, with their clean baseline."""

    readings: Measurements  # one frame a bin; ``valid`` where the bin has any reading
    count: Array  # (B, R), readings in each mean
    baseline: ComplexArray  # (R, K)


@dataclass(frozen=True)
class Problem:
    """Holds everything that a diagnosis starts from."""

    tools: tuple[Measurements, ...]  # frames with a pose only
    blocks: tuple[NDArray[np.int64], ...]  # (F,), number of the time block that each frame is in
    references: References | None
    reference_blocks: NDArray[np.int64]  # (B,)
    fields: Fields
    apparatus: Apparatus
    spread: Spread
    good: tuple[Mask, ...]  # (F, S), values that take part (valid, and no outliers)
    # (F, S), by how much a modelled flux may be off where the model's scan has gaps, T a
    # component.
    gaps_t: tuple[Array, ...]

    def frames(self, keep: Sequence[NDArray[np.generic]], bins: NDArray[np.generic]) -> 'Problem':
        """Return the frames of each tool, and the bins, that are named by index or mask."""
        references = self.references
        if references is not None:
            references = References(
                references.readings.frames(bins), references.count[bins], references.baseline
            )
        return replace(
            self,
            tools=tuple(tool.frames(rows) for tool, rows in zip(self.tools, keep, strict=True)),
            blocks=tuple(b[rows] for b, rows in zip(self.blocks, keep, strict=True)),
            good=tuple(g[rows] for g, rows in zip(self.good, keep, strict=True)),
            gaps_t=tuple(g[rows] for g, rows in zip(self.gaps_t, keep, strict=True)),
            references=references,
            reference_blocks=self.reference_blocks[bins],
        )

    def thinned(self, frames: int) -> 'Problem':
        """Return the problem with about so many frames of a tool, and all of the references."""
        most = max((tool.time.size for tool in self.tools), default=0)
        step = max(1, round(most / frames))
        keep = [np.arange(0, tool.time.size, step) for tool in self.tools]
        return self.frames(keep, np.arange(self.reference_blocks.size))

    def in_blocks(self, wanted: NDArray[np.int64], step: int = 1) -> 'Problem':
        """Return every ``step``-th frame of some blocks, with the bins of those blocks."""
        keep = []
        for blocks in self.blocks:
            rows = np.flatnonzero(np.isin(blocks, wanted))
            keep.append(rows[::step])
        return self.frames(keep, np.flatnonzero(np.isin(self.reference_blocks, wanted)))


@dataclass(frozen=True)
class Part:
    """Holds one body's prediction, residual and whitener at one state."""

    view: View
    residual: Array
    whitener: Whitener
    white: Array
    blocks: NDArray[np.int64]

    @property
    def count(self) -> int:
        """Return the number of values that have a weight."""
        return int(np.count_nonzero(self.whitener.weight))


@dataclass(frozen=True)
class State(JointState[Term, Part]):
    """Holds a problem of fluxes with a list of active effects."""

    problem: Problem

    @property
    def penalty(self) -> float:
        """Return what the freedom that fluctuating effects leave to each frame costs."""
        return float(sum(part.whitener.penalty for part in self.parts))

    def moved(self, terms: Sequence[Term]) -> 'State':
        """Return the state of the same problem with other terms."""
        return evaluate(self.problem, terms)

    def design(self, term: Term, probe: bool = False) -> list[Array | None]:
        """Return whitened columns of a term, one array (F, n, q) a part, None for no columns."""
        columns = []
        for part in self.parts:
            find = term.effect.probe if probe else term.effect.columns
            raw = find(term, part.view)
            columns.append(None if raw is None else part.whitener(parts(raw)))
        return columns


def evaluate(problem: Problem, terms: Sequence[Term]) -> State:
    """Predict all readings with some active effects, and whiten what they differ by."""
    found = []
    for tool, blocks, good, gaps_t in zip(
        problem.tools, problem.blocks, problem.good, problem.gaps_t, strict=True
    ):
        if tool.time.size == 0:
            continue
        view = tool_view(tool, terms, problem.fields)
        residual = parts(np.where(good[..., None], tool.flux - view.flux, 0.0))
        weight = _repeat(good / np.hypot(problem.spread.flux_t, gaps_t), tool.flux.shape[2])
        pose = pose_jacobian(view) * problem.spread.accuracy.pose_jitter
        whitener = Whitener.of(weight, _with_free(pose, terms, view), pose.shape[2])
        found.append(Part(view, residual, whitener, whitener(residual), blocks))
    if problem.references is not None and problem.references.readings.time.size:
        found.append(_reference_part(problem, problem.references, terms))
    return State(problem, tuple(terms), tuple(found))


def _with_free(known: Array, terms: Sequence[Term], view: View) -> Array:
    """Directions (F, n, m) that are known, and those that fluctuating effects leave open."""
    found = [term.effect.directions(term, view) for term in terms]
    return np.concatenate([known, *(parts(d) for d in found if d is not None)], axis=2)


def _repeat(per_sensor: Array, emitters: int) -> Array:
    """Weights (F, S) for all parts of a sensor, (F, 2 S K)."""
    one = np.repeat(per_sensor, emitters, axis=1)
    return np.concatenate([one, one], axis=1)


def _reference_part(problem: Problem, references: References, terms: Sequence[Term]) -> Part:
    readings = references.readings
    view = reference_view(readings, references.baseline, terms, problem.fields)
    good = readings.valid
    residual = parts(np.where(good[..., None], readings.flux - view.flux, 0.0))
    # A survey error is the same in every bin: shared among B bins it must count B times as much.
    exact = [term for term in terms if term.effect.remedy is not Remedy.FIELD]
    unchanged = reference_view(readings, references.baseline, exact, problem.fields)
    change = np.where(good[..., None], readings.flux - unchanged.flux, 0.0)
    size = np.sqrt(np.mean(np.abs(change) ** 2, axis=2, keepdims=True) / 2)
    noise = problem.spread.flux_t / np.sqrt(np.maximum(references.count, 1))
    together = np.sqrt(readings.time.size)
    survey = problem.spread.reference_change * size * together
    gradient = np.zeros_like(view.flux.real)
    for term in terms:
        if term.effect.gradient_error:
            alone = reference_view(readings, references.baseline, [term], problem.fields)
            shifted = np.abs(alone.flux - references.baseline)
            gradient += term.effect.gradient_error * shifted * together
    spread = np.sqrt(noise[..., None] ** 2 + survey**2 + gradient**2)
    weight = np.where(good[..., None], 1 / spread, 0.0).reshape(good.shape[0], -1)
    weight = np.concatenate([weight, weight], axis=1)
    free = _with_free(np.zeros((*weight.shape, 0)), terms, view)
    whitener = Whitener.of(weight, free) if free.shape[2] else Whitener(weight)
    return Part(view, residual, whitener, whitener(residual), problem.reference_blocks)
