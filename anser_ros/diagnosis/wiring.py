"""Finds wiring faults: they are not small, and show by whose prediction a reading resembles."""

import numpy as np
from numpy.typing import NDArray

from anser_ros.diagnosis.problem import Problem, State, evaluate
from anser_ros.effects.sensor_polarity import SENSOR_POLARITY
from anser_ros.effects.term import Site, Term
from anser_ros.effects.wiring import DEAD_CHANNEL, SWAPPED_CHANNELS, SWAPPED_COILS

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]

OWN_CORRELATION = 0.9
"""Correlation (0 to 1) with its own prediction from which a reading is its own, whatever its sign:
the prediction then leaves less than a fifth of its power. Smaller calls a reading reversed that is
hardly like its prediction; larger misses a reversed plug if there is another effect. No more is
known of its choice than that thresholds of the diagnosis were chosen on seeds below 100
(`docs/log.md`)."""
POLARITY_GAIN = 0.3
"""A gain within this of -1 is a polarity: as far as a gain is expected from one (the prior of
`sensor_gain`). Smaller misses a turned sensor whose gain is off as well; larger takes a weak
sensor with a turned phase for one."""
ALIKE, BETTER = 0.95, 0.1
"""Correlation (0 to 1) with another's prediction, and share of the power that its own leaves which
the other's may leave, from which a plug is in its socket. A looser pair takes neighbours that read
alike for exchanged ones; a stricter one misses an exchange if there are other effects. No more is
known of the choice than that thresholds of the diagnosis were chosen on seeds below 100
(`docs/log.md`)."""
DEAD = 0.02
"""Share of the expected reading below which a channel hears nothing: a fifth of the leak that
`channel_crosstalk` expects, so that one that still hears its neighbours is not called dead.
Smaller, and a dead channel that hears its neighbours is taken for a weak one; larger, and a weak
one is given up."""


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
        (order != rows) & is_driven & (best > ALIKE) & (1 - best**2 < BETTER * (1 - own**2))
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
