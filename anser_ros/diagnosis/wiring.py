"""Finds wiring faults: they are not small, and show by whose prediction a reading resembles."""

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.decisions import (
    BETTER,
    DEAD,
    OTHERS_CORRELATION,
    OWN_CORRELATION,
    POLARITY_GAIN,
)
from anser_ros.diagnosis.problem import Problem, State, evaluate
from anser_ros.effects.sensor_polarity import SENSOR_POLARITY
from anser_ros.effects.term import Site, Term
from anser_ros.effects.wiring import DEAD_CHANNEL, SWAPPED_CHANNELS, SWAPPED_COILS

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]


def wiring_faults(problem: Problem) -> list[Term]:
    """Return terms for the wiring faults of the tools."""
    state = evaluate(problem, ())
    coils = _swapped_coils(state)
    if coils is not None:
        return [coils]
    faults: list[Term] = []
    dead: list[int] = []
    turned: list[int] = []
    for number, part in enumerate(p for p in state.parts if not p.view.is_reference):
        tool = state.problem.tools[number]
        usable = state.problem.good[number]
        channels, silent = tool.sensors.channel, _silent(tool.flux, part.view.flux, usable)
        dead += channels[silent].tolist()
        gain, alike = _likeness(tool.flux, part.view.flux, usable)
        own = np.diag(alike)
        turned += channels[
            (np.abs(np.diag(gain) + 1) < POLARITY_GAIN) & (own > OWN_CORRELATION) & ~silent
        ].tolist()
        order = np.argmax(alike, axis=1)
        moved = _moved(alike, ~silent)
        if moved.size:
            site: Site = {
                'channels': tuple(int(c) for c in channels[order[moved]]),
                'read_as': tuple(int(c) for c in channels[moved]),
            }
            faults.append(Term(SWAPPED_CHANNELS, site))
    dead += _silent_references(problem)
    if turned:
        faults.append(Term(SENSOR_POLARITY, {'channels': tuple(turned)}))
    if dead:
        faults.append(Term(DEAD_CHANNEL, {'channels': tuple(dead)}))
    return faults


def _silent_references(problem: Problem) -> list[int]:
    """Channels of references with hardly any of their clean reading."""
    if problem.references is None:
        return []
    readings, clean = problem.references.readings, problem.references.baseline
    wanted = np.broadcast_to(clean, readings.flux.shape)
    silent = _silent(readings.flux, wanted, readings.valid)
    return [int(c) for c in readings.sensors.channel[silent]]


def _silent(seen: ComplexArray, wanted: ComplexArray, good: Mask) -> Mask:
    """Mask (S,) of sensors with hardly any of the reading that they should have."""
    power = np.where(good[..., None], np.abs(seen) ** 2, 0.0).sum(axis=(0, 2))
    expected = np.where(good[..., None], np.abs(wanted) ** 2, 0.0).sum(axis=(0, 2))
    return np.asarray((power < DEAD**2 * expected) & (expected > 0))


def _likeness(seen: ComplexArray, wanted: ComplexArray, good: Mask) -> tuple[ComplexArray, Array]:
    """Gain and correlation of each sensor's readings with each one's prediction, (S, S)."""
    read = np.where(good[..., None], seen, 0.0)
    cross = np.einsum('ftk,fsk->st', wanted.conj(), read)
    power = np.einsum('ftk,fs->st', np.abs(wanted) ** 2, good.astype(float))
    own = np.sum(np.abs(read) ** 2, axis=(0, 2))
    gain = cross / np.where(power > 0, power, 1.0)
    return gain, np.abs(cross) / np.sqrt(np.maximum(power * own[:, None], 1e-300))


def _moved(alike: Array, is_driven: Mask) -> NDArray[np.int64]:
    """Rows that are plainly another's; none when they are no permutation."""
    rows = np.arange(len(alike))
    order, own = np.argmax(alike, axis=1), np.diag(alike)
    best = alike[rows, order]
    moved = rows[
        (order != rows)
        & is_driven
        & (best > OTHERS_CORRELATION)
        & (1 - best**2 < BETTER * (1 - own**2))
    ]
    return np.asarray(moved if set(order[moved]) == set(moved) else moved[:0])


def _swapped_coils(state: State) -> Term | None:
    """Emitters whose tones are like another's prediction, in all tools."""
    emitters = state.problem.fields.omega.size
    cross = np.zeros((emitters, emitters), dtype=complex)
    power, own = np.zeros(emitters), np.zeros(emitters)
    tools = [p for p in state.parts if not p.view.is_reference]
    for part, tool, good in zip(tools, state.problem.tools, state.problem.good, strict=False):
        read = np.where(good[..., None], tool.flux, 0.0)
        wanted = np.where(good[..., None], part.view.flux, 0.0)
        cross += np.einsum('fsb,fsa->ab', wanted.conj(), read)
        power += np.sum(np.abs(wanted) ** 2, axis=(0, 1))
        own += np.sum(np.abs(read) ** 2, axis=(0, 1))
    alike = np.abs(cross) / np.sqrt(np.maximum(own[:, None] * power[None, :], 1e-300))
    order, moved = np.argmax(alike, axis=1), _moved(alike, np.ones(emitters, dtype=bool))
    if not moved.size:
        return None
    true = tuple(int(c) for c in order[moved])
    return Term(SWAPPED_COILS, {'coils': true, 'read_as': tuple(moved.tolist())})
