"""Finds what is wired or mounted wrongly, before anything else is looked for.

Plugs in each other's sockets, coils wound or plugged in the other way round, channels that receive
nothing, and bodies that stand in their holder by a quarter turn. All of them are exact symmetries
of a prediction, so that no fit is needed: the right one leaves a small part of what others leave.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from anser_ros.arrays import AnyArray, Array, Booleans, ComplexArray, Integers
from anser_ros.diagnosis import decisions
from anser_ros.diagnosis.problem import Problem
from anser_ros.effects.correction import Fields, tool_view
from anser_ros.effects.effect import Site, Term
from anser_ros.effects.seen import (
    COIL_POLARITY,
    DEAD_CHANNEL,
    SENSOR_POLARITY,
    SWAPPED_CHANNELS,
    SWAPPED_COILS,
)
from anser_ros.effects.sensors import BODY_TURNED
from anser_ros.field.measurements import Measurements
from anser_ros.physics.constants import DEGREES
from anser_ros.physics.dipole import flux_basis
from anser_ros.physics.sensor import SensorTable, along_each_axis


@dataclass(frozen=True)
class _Readings:
    """Holds a tool's readings and what some terms predict, zero where they do not count."""

    channels: Integers  # (S,)
    seen: ComplexArray  # (F, S, K), T
    wanted: ComplexArray  # (F, S, K), T
    driven: Booleans  # (S,), sensors that receive anything

    @staticmethod
    def of(
        tool: Measurements, good: Booleans, terms: Sequence[Term], fields: Fields
    ) -> '_Readings':
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


def _power(values: AnyArray, axes: tuple[int, ...] = (0, 1, 2)) -> Array:
    return np.asarray(np.sum(np.abs(values) ** 2, axis=axes))


def _silent(seen: ComplexArray, wanted: ComplexArray, axes: tuple[int, ...] = (0, 2)) -> Booleans:
    """What has hardly any of the reading that it should have: sensors (S,), or over other axes."""
    power, expected = _power(seen, axes), _power(wanted, axes)
    return np.asarray((power < decisions.DEAD**2 * expected) & (expected > 0))


def wiring_faults(problem: Problem) -> list[Term]:
    """Return terms for the faults of wiring and mounting of the tools and emitters."""
    found = _swapped_coils(_read(problem, ()))
    for number in range(len(problem.tools)):
        found += _rewired(problem, number, found)
    tools = _read(problem, found)
    dead = [int(c) for tool in tools for c in tool.channels[~tool.driven]]
    found += _reversed(tools)
    if dead := dead + _silent_references(problem):
        found.append(Term(DEAD_CHANNEL, {'channels': tuple(dead)}))
    return found


def without_dead(problem: Problem) -> Problem:
    """Return the problem without the frames in which an emitter is dead that gives at times."""
    good = []
    for tool, own in zip(_read(problem, ()), problem.good, strict=True):
        dead = _silent(tool.seen, tool.wanted, (1,))  # (F, K)
        good.append(own & ~np.any(dead & ~dead.all(axis=0), axis=1, keepdims=True))
    return replace(problem, good=tuple(good))


def power_left(problem: Problem, known: Sequence[Term]) -> tuple[float, float]:
    """Return the share of power that predictions leave of a tool, and of imaginary parts, T^2."""
    tools = _read(problem, known)
    quadrature = sum(float(_power((t.seen - t.wanted).imag)) for t in tools)
    return max(t.left() for t in tools), quadrature


def common_gain(problem: Problem) -> float | None:
    """Return how many times what is predicted all tools read, None where that explains little."""
    tools = _read(problem, ())
    seen = np.concatenate([t.seen.ravel() for t in tools])
    wanted = np.concatenate([t.wanted.ravel() for t in tools])
    gain = np.vdot(wanted, seen) / max(np.vdot(wanted, wanted).real, 1e-300)
    left, plain = (np.linalg.norm(seen - factor * wanted) for factor in (gain, 1.0))
    return float(np.abs(gain)) if left**2 < decisions.BETTER * plain**2 else None


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
    moved = _moved(_likeness([(plain.seen, plain.wanted)]), plain.driven, plain.channels)
    swaps = [Term(SWAPPED_CHANNELS, {'channels': t, 'read_as': r}) for t, r in moved]
    ways = [judged([term]) for term in swaps]
    is_wrong = none[1] > 0 or none[0] > 1 - decisions.OTHERS_CORRELATION**2
    for terms in _turns(plain, read) if is_wrong else ():
        way = judged(terms)
        if way[0] < min(1 - decisions.OTHERS_CORRELATION**2, decisions.BETTER * none[0]):
            ways.append(way)
    if not ways:
        return []
    least = min(left for left, _, _ in ways)
    alike = [way for way in ways if way[0] <= decisions.AS_LITTLE * least]
    return list(min(alike, key=lambda way: way[1])[2])


MOST_EXCHANGED = 12
"""Channels of a body up to which each pair is tried in each other's place: 66 pairs."""
RIDGE = 1e-6
"""Damping of the free dipoles of a scan, over their mean information: they are nearly alike."""
MOST_LEFT = 0.02
"""Share of a scan's power that free dipoles leave at most where its wiring is right: less than a
hundredth for coils of some centimetres, a third where one sensor of three is reversed."""


class ScanFaults(NamedTuple):
    """Holds what is wired or mounted wrongly: in all sessions of a scan, or in some alone."""

    common: list[Term]
    own: list[tuple[int, Term]]  # with the number of the session


class _Seen(NamedTuple):
    """Holds what C free dipoles can tell of a session's readings."""

    normal: Array  # (C, C)
    right: dict[int, ComplexArray]  # of each channel, (C, K)
    power: Array  # (K,), of the readings


def scan_faults(sessions: Sequence[Sequence[Measurements]], places: Array) -> ScanFaults:
    """Return what is reversed, exchanged or turned in a scan, whose field is still unknown.

    ``sessions``: measurements with poses; ``places`` (P, 3): about where the emitters are, m. Each
    emitter is three free dipoles at every place. Signs of emitters are signs of their dipoles, but
    where sessions differ, and nothing is named unless it leaves a small part of what is left
    without it.
    """
    plain = [_seen(session, places) for session in sessions]
    if not any(one.power.any() for one in plain):
        return ScanFaults([], [])
    first, left, none = _scan_signs(plain)
    if none < MOST_LEFT:
        return ScanFaults([], [])
    tried = [(first, left)]
    for channels in {tuple(m.sensors.channel.tolist()): None for s in sessions for m in s}:
        for term in (*_exchanges(channels), *_quarter_turns(np.array(channels))):
            righted = [_seen([rightly_wired(m, [term]) for m in s], places) for s in sessions]
            faults, left, _ = _scan_signs(righted)
            tried.append((ScanFaults([term, *faults.common], faults.own), left))
            for number in range(len(sessions)) if len(sessions) > 1 else ():
                parts = [*plain[:number], righted[number], *plain[number + 1 :]]
                faults, left, _ = _scan_signs(parts)
                own = [(number, term), *faults.own]
                tried.append((ScanFaults(faults.common, own), left))
    least = min(left for _, left in tried)
    if least > decisions.BETTER * none:
        return ScanFaults([], [])
    alike = [way for way, left in tried if left <= decisions.AS_LITTLE * least]
    return min(alike, key=lambda way: len(way.common) + len(way.own))


def wiring_words(term: Term, sensors: SensorTable, emitters: Sequence[str]) -> str:
    """Say what is wired or mounted wrongly, and how, by the names of sensors and emitters."""
    rows = np.isin(sensors.channel, term.channels)
    if term.effect is BODY_TURNED:
        ways = zip(np.round(term.theta / np.abs(term.theta).max()), 'xyz', strict=True)
        about = ''.join(f'{"-" if way < 0 else "+"}{name}' for way, name in ways if way)
        turned = f'turned by {DEGREES * np.linalg.norm(term.theta):.0f} deg about {about}'
        return f'{sensors.body[np.argmax(rows)]} stands {turned} against its stated axes'
    record = term.recorded_site
    named = [f'sensor {name}' for name, own in zip(sensors.name, rows, strict=True) if own]
    named += [f'emitter {emitters[k]}' for k in record.get('coils', ())]
    how = 'exchanged' if 'read_as' in record else 'reversed'
    return f'{" and ".join(named)} {"are" if named[1:] else "is"} {how}'


def rightly_wired(measurements: Measurements, faults: Sequence[Term]) -> Measurements:
    """Return a tool's measurements without the faults that `scan_faults` found in them."""
    flux, sensors = measurements.flux, measurements.sensors
    for term in faults:
        sensors = term.effect.table(term, sensors)
        mixing = term.effect.channel_matrix(term, sensors.channel)
        if mixing is not None:
            flux = np.einsum('ts,fsk->ftk', np.linalg.inv(mixing), flux)
    return replace(measurements, flux=flux, sensors=sensors) if faults else measurements


def _exchanges(channels: Sequence[int]) -> list[Term]:
    """Each two channels of a body of few in each other's place."""
    pairs = combinations(channels, 2) if len(channels) <= MOST_EXCHANGED else ()
    sites: list[Site] = [{'channels': (b, a), 'read_as': (a, b)} for a, b in pairs]
    return [Term(SWAPPED_CHANNELS, site) for site in sites]


def _seen(session: Sequence[Measurements], places: Array) -> _Seen:
    positions, directions = along_each_axis(places)
    count, emitters = len(positions), session[0].flux.shape[2]
    normal, power = np.zeros((count, count)), np.zeros(emitters)
    right: dict[int, ComplexArray] = {}
    for m in session:
        points, axes = m.placed()
        for row, channel in enumerate(m.sensors.channel.tolist()):
            keep = m.usable[:, row]
            lengths, flux = np.full(keep.sum(), m.sensors.length[row]), m.flux[keep, row]
            basis = flux_basis(points[keep, row], axes[keep, row], lengths, positions, directions)
            normal += basis.T @ basis
            right[channel] = right.get(channel, 0.0) + basis.T @ flux
            power += np.sum(np.abs(flux) ** 2, axis=0)
    return _Seen(normal, right, power)


def _scan_signs(sessions: Sequence[_Seen]) -> tuple[ScanFaults, float, float]:
    """The sensors that are reversed, and the shares of power left with and without their signs.

    With signs q of the sensors of all sessions the dipoles explain q M q, where M is a sum over
    the emitters; of these, those between two sessions have the emitter's signs there besides.
    """
    normal = np.sum([s.normal for s in sessions], axis=0)
    share = 1.0 / np.maximum(np.sum([s.power for s in sessions], axis=0), 1e-300)
    owner = np.array([number for number, s in enumerate(sessions) for _ in s.right])
    channels = np.array([channel for s in sessions for channel in s.right])
    sums = np.array([one for s in sessions for one in s.right.values()])  # (R, C, K)
    ridge = RIDGE * np.trace(normal) / len(normal) * np.eye(len(normal))
    solved = np.linalg.solve(normal + ridge, sums)
    each = np.einsum('sck,tck,k->kst', sums.conj(), solved, share / len(share)).real
    left, plain = np.inf, 1.0 - float(each.sum())
    for start in (np.ones((len(share), len(sessions))), _aligned(each, owner, len(sessions))):
        signed = (each * start[:, owner, None] * start[:, None, owner]).sum(axis=0)
        signs = _best_signs(signed)
        if 1.0 - signs @ signed @ signs < left:
            left, q, coils = 1.0 - float(signs @ signed @ signs), signs, start
    power = np.array([s.power.sum() for s in sessions])
    q, coils = _fewest(q, coils, owner, 1.0 + power / (len(power) * power.sum()))
    common = [c for c in dict.fromkeys(channels.tolist()) if (q[channels == c] < 0).all()]
    found = ScanFaults([Term(SENSOR_POLARITY, {'channels': tuple(common)})] * bool(common), [])
    for number in range(len(sessions)):
        if own := channels[(owner == number) & (q < 0) & ~np.isin(channels, common)].tolist():
            found.own.append((number, Term(SENSOR_POLARITY, {'channels': tuple(own)})))
        if of_coils := np.flatnonzero(coils[:, number] < 0).tolist():
            found.own.append((number, Term(COIL_POLARITY, {'coils': tuple(of_coils)})))
    if left > decisions.BETTER * plain or not (found.common or found.own):
        return ScanFaults([], []), plain, plain
    return found, left, plain


def _aligned(each: Array, owner: Integers, count: int) -> Array:
    """Signs (K, S) of emitters in sessions, each as it reads beside those before."""
    coils, q = np.ones((len(each), count)), np.zeros(len(owner))
    for number in range(count):
        own = owner == number
        beside = np.einsum('kst,kt,t->ks', each[:, own], coils[:, owner], q)
        if beside.any():
            left, _, right = np.linalg.svd(np.sign(beside), full_matrices=False)
            q[own], coils[:, number] = (np.where(v < 0, -1, 1) for v in (right[0], left[:, 0]))
        else:
            q[own] = _best_signs(each[:, own][:, :, own].sum(axis=0))
    return coils


def _fewest(sensors: Array, coils: Array, owner: Integers, weight: Array) -> tuple[Array, Array]:
    """Signs of sensors (R,) and of emitters (K, S) that say the same with the fewest reversed.

    All of a session's may be turned round, and an emitter's in all sessions, of which those with
    more weight (S,) have it right.
    """
    for of_coils in (False, True):
        turned = np.array([
            sensors[owner == number].sum() + of_coils * own.sum() < 0
            for number, own in enumerate(coils.T)
        ])  # fmt: skip
        sensors = np.where(turned[owner], -sensors, sensors)
        coils = np.where(turned, -coils, coils)
        coils = np.where((coils @ weight < 0)[:, None], -coils, coils)
    return sensors, coils


def _best_signs(together: Array) -> Array:
    """Signs q that make q M q large."""
    starts = np.concatenate([np.ones((1, len(together))), np.linalg.eigh(together)[1].T, together])
    climbed = (_climbed(start, together) for start in starts)
    return max(climbed, key=lambda q: float(q @ together @ q))


def _climbed(start: Array, together: Array) -> Array:
    """Signs q near a start's, of which no other one makes q M q larger."""
    signs = np.where(start < 0, -1.0, 1.0)
    while True:
        gains = np.diag(together) - signs * (together @ signs)
        if gains.max() <= 1e-12:
            return signs
        signs[int(np.argmax(gains))] *= -1.0


def _quarter_turns(channels: Integers) -> list[Term]:
    """The quarter turns of a body with these channels, the least first."""
    group = sorted(Rotation.create_group('O'), key=lambda one: round(float(one.magnitude()), 6))
    own = tuple(channels.tolist())
    return [Term(BODY_TURNED, {'channels': own}, turn.as_rotvec()) for turn in group[1:]]


def _turns(plain: _Readings, read: Callable[[Sequence[Term]], _Readings]) -> Iterator[list[Term]]:
    """Quarter turns of a body that are likest, up to the signs of its readings; least first."""
    tried = []
    for term in _quarter_turns(plain.channels):
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


def _moved(
    alike: Array, is_driven: Booleans, numbers: Integers
) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Numbers of what is read, and as what, where it is plainly another's and a permutation."""
    rows = np.arange(len(alike))
    order, own = np.argmax(alike, axis=1), np.diag(alike)
    best = alike[rows, order]
    moved = rows[
        (order != rows)
        & is_driven
        & (best > decisions.OTHERS_CORRELATION)
        & (1 - best**2 < decisions.BETTER * (1 - own**2))
    ]
    true = order[moved]
    if not moved.size or set(true) != set(moved):
        return []
    return [(tuple(numbers[true].tolist()), tuple(numbers[moved].tolist()))]


def _swapped_coils(tools: Sequence[_Readings]) -> list[Term]:
    """Emitters whose tones are like another's prediction, in all sensors, whatever their signs."""
    alike = _likeness([(np.moveaxis(t.seen, 1, 2), np.moveaxis(t.wanted, 1, 2)) for t in tools])
    pairs = _moved(alike, np.ones(len(alike), dtype=bool), np.arange(len(alike)))
    return [Term(SWAPPED_COILS, {'coils': true, 'read_as': read}) for true, read in pairs]


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


def _is_reversed(seen: ComplexArray, wanted: ComplexArray) -> Booleans:
    """Which sensors (S,) read minus their prediction, (F, S, K) each."""
    cross, power = np.sum(wanted.conj() * seen, axis=(0, 2)), _power(wanted, (0, 2))
    gain = cross / np.where(power > 0, power, 1.0)
    alike = np.abs(cross) / np.sqrt(np.maximum(power * _power(seen, (0, 2)), 1e-300))
    is_own = alike > decisions.OWN_CORRELATION
    return np.asarray((np.abs(gain + 1) < decisions.POLARITY_GAIN) & is_own)
