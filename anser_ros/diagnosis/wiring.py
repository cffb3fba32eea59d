"""Finds what is wired or mounted wrongly, before anything else is looked for.

Plugs in each other's sockets, coils wound or plugged in the other way round, channels that receive
nothing, and bodies that stand in their holder by a quarter turn. All of them are exact symmetries
of a prediction, so that no fit is needed: the right one leaves a small part of what others leave.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.diagnosis import decisions
from anser_ros.diagnosis.problem import Problem
from anser_ros.effects.correction import Fields, tool_view
from anser_ros.effects.effect import Site, Term
from anser_ros.effects.seen import (
    BODY_TURNED,
    COIL_POLARITY,
    DEAD_CHANNEL,
    SENSOR_POLARITY,
    SWAPPED_CHANNELS,
    SWAPPED_COILS,
)
from anser_ros.field.measurements import Measurements

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class _Readings:
    """Holds a tool's readings and what some terms predict, zero where they do not count."""

    channels: NDArray[np.int64]  # (S,)
    seen: ComplexArray  # (F, S, K), T
    wanted: ComplexArray  # (F, S, K), T
    driven: Mask  # (S,), sensors that receive anything

    @staticmethod
    def of(tool: Measurements, good: Mask, terms: Sequence[Term], fields: Fields) -> '_Readings':
        wanted = np.where(good[..., None], tool_view(tool, terms, fields).flux, 0.0)
        seen = np.where(good[..., None], tool.flux, 0.0)
        return _Readings(tool.sensors.channel, seen, wanted, ~_silent(seen, wanted))

    def cells(self) -> ComplexArray:
        """Return each sensor's correlation with its prediction, emitter by emitter, (S, K)."""
        cross = np.einsum('fsk,fsk->sk', self.wanted.conj(), self.seen)
        power = _power(self.wanted, (0,)) * _power(self.seen, (0,))
        return np.asarray(cross / np.sqrt(np.maximum(power, 1e-300)))

    def left(self) -> float:
        """Return the share of the readings' power that the prediction leaves."""
        seen, wanted = self.seen[:, self.driven], self.wanted[:, self.driven]
        return float(_power(seen - wanted) / np.maximum(_power(seen), 1e-300))


def _power(values: ComplexArray, axes: tuple[int, ...] = (0, 1, 2)) -> Array:
    return np.asarray(np.sum(np.abs(values) ** 2, axis=axes))


def _silent(seen: ComplexArray, wanted: ComplexArray) -> Mask:
    """Mask (S,) of sensors with hardly any of the reading that they should have."""
    power, expected = _power(seen, (0, 2)), _power(wanted, (0, 2))
    return np.asarray((power < decisions.DEAD**2 * expected) & (expected > 0))


def wiring_faults(problem: Problem) -> list[Term]:
    """Return terms for the faults of wiring and mounting of the tools and emitters."""
    found: list[Term] = []
    coils = _swapped_coils(_read(problem, found))
    if coils is not None:
        found.append(coils)
    for number in range(len(problem.tools)):
        found += _rewired(problem, number, found)
    tools = _read(problem, found)
    dead = [int(c) for tool in tools for c in tool.channels[~tool.driven]]
    found += _reversed(tools)
    if dead := dead + _silent_references(problem):
        found.append(Term(DEAD_CHANNEL, {'channels': tuple(dead)}))
    return found


def _read(problem: Problem, terms: Sequence[Term]) -> list[_Readings]:
    pairs = zip(problem.tools, problem.good, strict=True)
    return [_Readings.of(tool, good, terms, problem.fields) for tool, good in pairs]


def _silent_references(problem: Problem) -> list[int]:
    """Channels of references with hardly any of their clean reading."""
    if problem.references is None:
        return []
    readings, clean = problem.references.readings, problem.references.baseline
    counted = readings.valid[..., None]
    silent = _silent(np.where(counted, readings.flux, 0.0), np.where(counted, clean, 0.0))
    return [int(c) for c in readings.sensors.channel[silent]]


def _rewired(problem: Problem, number: int, known: Sequence[Term]) -> list[Term]:
    """Exchanged channels of a tool, or its quarter turn, whichever leaves less or says less.

    A turn of a triaxial sensor is also an exchange of its coils, some of them reversed. What is
    one fault is named before what is two.
    """
    tool, good = problem.tools[number], problem.good[number]

    def read(terms: Sequence[Term]) -> _Readings:
        return _Readings.of(tool, good, [*known, *terms], problem.fields)

    def judged(way: Sequence[Term]) -> tuple[float, int, Sequence[Term]]:
        signs = _reversed([read(way)])
        return read([*way, *signs]).left(), len(way) + len(signs), way

    plain = read(())
    none = judged(())
    ways = [judged([term]) for term in _swapped_channels(plain)]
    for terms in _turns(plain, read) if none[0] > 1 - decisions.OTHERS_CORRELATION**2 else ():
        way = judged(terms)
        if way[0] < min(1 - decisions.OTHERS_CORRELATION**2, decisions.BETTER * none[0]):
            ways.append(way)
    if not ways:
        return []
    least = min(left for left, _, _ in ways)
    alike = [way for way in ways if way[0] <= decisions.AS_LITTLE * least]
    return list(min(alike, key=lambda way: way[1])[2])


def _turns(plain: _Readings, read: Callable[[Sequence[Term]], _Readings]) -> Iterator[list[Term]]:
    """Quarter turns of a body that are likest, up to the signs of its readings; least first."""
    group = Rotation.create_group('O')
    channels = tuple(int(c) for c in plain.channels)
    tried = []
    for turn in sorted(group, key=lambda one: round(float(one.magnitude()), 6))[1:]:
        degrees = tuple(np.round(np.degrees(turn.as_rotvec()), 6).tolist())
        term = Term(BODY_TURNED, {'channels': channels, 'rotation_deg': degrees})
        readings = read([term])
        weight = _power(readings.seen, (0,))
        alike = float(np.sum(weight * np.abs(readings.cells()) ** 2) / max(weight.sum(), 1e-300))
        tried.append((1 - alike, term))
    least = min(left for left, _ in tried)
    return iter([term] for left, term in tried if left <= decisions.AS_LITTLE * least)


def _likeness(pairs: Sequence[tuple[ComplexArray, ComplexArray]]) -> Array:
    """Correlation of each row's readings with each one's prediction, whatever their signs, (A, A).

    ``pairs``: readings and predictions, (F, A, B) each. The correlations of single B are added up
    without their phases.
    """
    cross = sum(np.abs(np.einsum('ftb,fsb->stb', w.conj(), s)).sum(axis=2) for s, w in pairs)
    own, power = (sum(_power(pair[i], (0, 2)) for pair in pairs) for i in (0, 1))
    return np.asarray(cross / np.sqrt(np.maximum(np.outer(own, power), 1e-300)))


def _moved(alike: Array, is_driven: Mask) -> NDArray[np.int64]:
    """Rows that are plainly another's; none when they are no permutation."""
    rows = np.arange(len(alike))
    order, own = np.argmax(alike, axis=1), np.diag(alike)
    best = alike[rows, order]
    moved = rows[
        (order != rows)
        & is_driven
        & (best > decisions.OTHERS_CORRELATION)
        & (1 - best**2 < decisions.BETTER * (1 - own**2))
    ]
    return np.asarray(moved if set(order[moved]) == set(moved) else moved[:0])


def _swapped_channels(tool: _Readings) -> list[Term]:
    """Channels of a tool that read as another's prediction."""
    alike = _likeness([(tool.seen, tool.wanted)])
    moved = _moved(alike, tool.driven)
    true = np.argmax(alike, axis=1)[moved]
    site: Site = {
        'channels': tuple(tool.channels[true].tolist()),
        'read_as': tuple(tool.channels[moved].tolist()),
    }
    return [Term(SWAPPED_CHANNELS, site)] if moved.size else []


def _swapped_coils(tools: Sequence[_Readings]) -> Term | None:
    """Emitters whose tones are like another's prediction, in all sensors, whatever their signs."""
    alike = _likeness([(np.moveaxis(t.seen, 1, 2), np.moveaxis(t.wanted, 1, 2)) for t in tools])
    moved = _moved(alike, np.ones(len(alike), dtype=bool))
    if not moved.size:
        return None
    true = np.argmax(alike, axis=1)[moved]
    return Term(SWAPPED_COILS, {'coils': tuple(true.tolist()), 'read_as': tuple(moved.tolist())})


def _reversed(tools: Sequence[_Readings]) -> list[Term]:
    """Sensors and emitters that are wound or plugged in the other way round.

    A reading has the product of both signs, so that the signs of all cells are those of a matrix
    of rank one. Reversing everything changes nothing: the fewest are named.
    """
    cells = np.concatenate([np.where(t.driven[:, None], t.cells().real, 0.0) for t in tools])
    left, _, right = np.linalg.svd(cells, full_matrices=False)
    sensors, coils = np.where(left[:, 0] < 0, -1.0, 1.0), np.where(right[0] < 0, -1.0, 1.0)
    count, total = int((sensors < 0).sum() + (coils < 0).sum()), sensors.size + coils.size
    if 2 * count > total or (2 * count == total and (coils < 0).sum() > (sensors < 0).sum()):
        sensors, coils = -sensors, -coils
    own = np.split(sensors[:, None], np.cumsum([len(tool.channels) for tool in tools])[:-1])
    seen = [(t.seen * q).reshape(-1, coils.size, 1) for t, q in zip(tools, own, strict=True)]
    wanted = [t.wanted.reshape(-1, coils.size, 1) for t in tools]
    of_coils = (coils < 0) & _is_reversed(np.concatenate(seen), np.concatenate(wanted))
    found = []
    if of_coils.any():
        found.append(Term(COIL_POLARITY, {'coils': tuple(np.flatnonzero(of_coils).tolist())}))
    signs = np.where(of_coils, -1.0, 1.0)
    turned = [
        int(channel)
        for tool in tools
        for channel in tool.channels[_is_reversed(tool.seen, tool.wanted * signs) & tool.driven]
    ]
    if turned:
        found.append(Term(SENSOR_POLARITY, {'channels': tuple(turned)}))
    return found


def _is_reversed(seen: ComplexArray, wanted: ComplexArray) -> Mask:
    """Which sensors (S,) read minus their prediction, (F, S, K) each."""
    cross, power = np.sum(wanted.conj() * seen, axis=(0, 2)), _power(wanted, (0, 2))
    gain = cross / np.where(power > 0, power, 1.0)
    alike = np.abs(cross) / np.sqrt(np.maximum(power * _power(seen, (0, 2)), 1e-300))
    is_own = alike > decisions.OWN_CORRELATION
    return np.asarray((np.abs(gain + 1) < decisions.POLARITY_GAIN) & is_own)
