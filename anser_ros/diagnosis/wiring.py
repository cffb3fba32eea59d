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
from anser_ros.field.model import Dipoles
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


class _Told(NamedTuple):
    """Holds tools, which of their readings count, and what predicts them, as a problem does."""

    tools: Sequence[Measurements]
    good: Sequence[Booleans]
    fields: Fields


def wiring_faults(problem: Problem) -> list[Term]:
    """Return terms for the faults of wiring and mounting of the tools and emitters."""
    found, dead = _tool_faults(problem)
    if dead := dead + _silent_references(problem):
        found.append(Term(DEAD_CHANNEL, {'channels': tuple(dead)}))
    return found


def _tool_faults(problem: Problem | _Told) -> tuple[list[Term], list[int]]:
    """The faults of tools and emitters, and the channels of tools that receive nothing."""
    found = _swapped_coils(_read(problem, ()))
    for number in range(len(problem.tools)):
        found += _rewired(problem, number, found)
    tools = _read(problem, found)
    dead = [int(c) for tool in tools for c in tool.channels[~tool.driven]]
    return found + _reversed(tools), dead


def without_dead(problem: Problem) -> Problem:
    """Return the problem without the frames in which an emitter is dead that gives at times."""
    good = []
    for tool, own in zip(_read(problem, ()), problem.good, strict=True):
        dead = _silent(tool.seen, tool.wanted, (1,))  # (F, K)
        good.append(own & ~np.any(dead & ~dead.all(axis=0), axis=1, keepdims=True))
    return replace(problem, good=tuple(good))


def power_left(problem: Problem, known: Sequence[Term]) -> tuple[float, float, float]:
    """Return what predictions leave: the share of a tool's power, and of all tools, T^2, the
    real and the imaginary parts.
    """
    tools = _read(problem, known)
    left = [t.seen - t.wanted for t in tools]
    in_phase, quadrature = (
        sum(float(_power(part)) for part in parts)
        for parts in ([one.real for one in left], [one.imag for one in left])
    )
    return max(t.left() for t in tools), in_phase, quadrature


def common_gain(problem: Problem) -> float | None:
    """Return how many times what is predicted all tools read, None where that explains little."""
    tools = _read(problem, ())
    seen = np.concatenate([t.seen.ravel() for t in tools])
    wanted = np.concatenate([t.wanted.ravel() for t in tools])
    gain = np.vdot(wanted, seen) / max(np.vdot(wanted, wanted).real, 1e-300)
    left, plain = (np.linalg.norm(seen - factor * wanted) for factor in (gain, 1.0))
    return float(np.abs(gain)) if left**2 < decisions.BETTER * plain**2 else None


def _read(problem: Problem | _Told, terms: Sequence[Term]) -> list[_Readings]:
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


def _rewired(problem: Problem | _Told, number: int, known: Sequence[Term]) -> list[Term]:
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


def scan_faults(measurements: Sequence[Measurements], places: Array) -> list[Term]:
    """Return what is reversed or turned in a scan, whose field is still unknown.

    ``measurements``: with poses; ``places`` (P, 3): about where the emitters are, m. Each emitter
    is three free dipoles at every place. Signs of emitters are signs of their dipoles, and nothing
    is named unless it leaves a small part of what is left without it.
    """
    read = [m for m in measurements if m.usable.any()]
    none = _scan_signs(read, places) if read else ([], 0.0, 0.0)
    if none[2] < MOST_LEFT:
        return []
    tried = [none]
    for channels in {tuple(m.sensors.channel.tolist()): None for m in read}:
        for term in (*_exchanges(channels), *_quarter_turns(np.array(channels))):
            righted = [rightly_wired(m, [term]) for m in read]
            terms, left, _ = _scan_signs(righted, places)
            tried.append(([term, *terms], left, none[2]))
    least = min(left for _, left, _ in tried)
    if least > decisions.BETTER * none[2]:
        return []
    alike = [way for way in tried if way[1] <= decisions.AS_LITTLE * least]
    return min(alike, key=lambda way: len(way[0]))[0]


def session_faults(
    sessions: Sequence[Sequence[Measurements]], places: Array
) -> tuple[int, list[Term]]:
    """Return which session alone is wired or mounted otherwise than the others of a scan, and how.

    Free dipoles at the places, as in `scan_faults`, that explain the others predict its readings.
    Without such a session there are no faults; of two that only differ, it is the shorter.
    """
    found = list[tuple[int, int, list[Term]]]()
    for number, own in enumerate(sessions):
        others = [m for k, one in enumerate(sessions) if k != number for m in one]
        dipoles, left = _free_dipoles(others, places)
        if left > MOST_LEFT:
            continue
        omega = np.zeros(dipoles.moments.shape[1])
        told = _Told(own, [m.usable for m in own], Fields(dipoles, dipoles, omega))
        terms, _ = _tool_faults(told)
        after, before = (max(r.left() for r in _read(told, some)) for some in (terms, ()))
        if after < min(1 - decisions.OTHERS_CORRELATION**2, decisions.BETTER * before):
            found.append((sum(m.time.size for m in own), number, terms))
    return min(found, key=lambda one: (len(one[2]), one[0]))[1:] if found else (0, [])


def _free_dipoles(measurements: Sequence[Measurements], places: Array) -> tuple[Dipoles, float]:
    """The free dipoles at places that explain measurements, and the share of power they leave."""
    normal, right, power = _sums(measurements, places)
    together = np.sum(list(right.values()), axis=0)
    moments = np.linalg.solve(normal, together)
    explained = np.sum(together.conj() * moments, axis=0).real / np.maximum(power, 1e-300)
    return Dipoles(*along_each_axis(places), moments), 1.0 - float(np.mean(explained))


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


def _sums(
    measurements: Sequence[Measurements], places: Array
) -> tuple[Array, dict[int, ComplexArray], Array]:
    """The damped normal matrix (3 P, 3 P) of free dipoles at places (P, 3), its right side for
    each channel, (3 P, K), and the power (K,) of the readings.
    """
    positions, directions = along_each_axis(places)
    count = 3 * len(places)
    normal, power = np.zeros((count, count)), np.zeros(measurements[0].flux.shape[2])
    right: dict[int, ComplexArray] = {}
    for m in measurements:
        points, axes = m.placed()
        for row, channel in enumerate(m.sensors.channel.tolist()):
            keep = m.usable[:, row]
            lengths, flux = np.full(keep.sum(), m.sensors.length[row]), m.flux[keep, row]
            basis = flux_basis(points[keep, row], axes[keep, row], lengths, positions, directions)
            normal += basis.T @ basis
            right[channel] = right.get(channel, 0.0) + basis.T @ flux
            power += np.sum(np.abs(flux) ** 2, axis=0)
    return normal + RIDGE * float(np.trace(normal)) / count * np.eye(count), right, power


def _scan_signs(
    measurements: Sequence[Measurements], places: Array
) -> tuple[list[Term], float, float]:
    """The sensors that are reversed, and the shares of power left with and without their signs.

    With signs q of the sensors the dipoles explain q M q, where M is a sum over the emitters.
    """
    normal, right, power = _sums(measurements, places)
    sums = np.array(list(right.values()))  # (S, 3 P, K)
    solved = np.linalg.solve(normal, sums)
    share = 1.0 / np.maximum(power, 1e-300)
    together = np.einsum('sck,tck,k->st', sums.conj(), solved, share).real / len(share)
    starts = np.concatenate([np.ones((1, len(together))), np.linalg.eigh(together)[1].T, together])
    signs = max((_climbed(q, together) for q in starts), key=lambda q: float(q @ together @ q))
    signs = -signs if (signs < 0).sum() > (signs > 0).sum() else signs
    left, plain = (1.0 - float(q @ together @ q) for q in (signs, np.ones(len(signs))))
    reversed_ = tuple(c for c, sign in zip(right, signs, strict=True) if sign < 0)
    if not reversed_ or left > decisions.BETTER * plain:
        return [], plain, plain
    return [Term(SENSOR_POLARITY, {'channels': reversed_})], left, plain


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
