"""Says what the name of a column means: a place, a rotation, a time, of whom and in which unit."""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from anser_ros.errors import ParameterError

LENGTH_M = {
    'm': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'um': 1e-6, 'inch': 0.0254, 'dm': 0.1, 'km': 1e3,
    'ft': 0.3048,
}  # fmt: skip
"""Metres in a unit of length."""
TIME_NS = {'s': 1e9, 'ms': 1e6, 'us': 1e3, 'ns': 1.0, 'min': 6e10, 'h': 3.6e12, 'day': 8.64e13}
"""Nanoseconds in a unit of time."""
_WORDS = {
    'm': 'm meter meters metre metres', 'cm': 'cm centimeter centimeters centimetres',
    'mm': 'mm millimeter millimeters millimetre millimetres', 'inch': 'in inch inches',
    'um': 'um μm micron microns micrometer micrometers micrometre micrometres',
    's': 's sec secs second seconds', 'ms': 'ms msec millisec milliseconds',
    'us': 'us usec microseconds', 'ns': 'ns nsec nanosec nanoseconds nsecs nanosecs',
    'min': 'min minute minutes', 'h': 'h hr hour hours', 'day': 'day days',
    'dm': 'dm', 'km': 'km', 'ft': 'ft foot feet',
    'deg': 'deg degree degrees', 'rad': 'rad radian radians',
}  # fmt: skip
UNITS = {word: unit for unit, words in _WORDS.items() for word in words.split()}
"""Units by the words for them."""
PLACE, TURN, TIME, ANGLES, OTHER = (
    set(words.split())
    for words in (
        't p pos position trans translation loc location coord coordinate',
        'q quat quaternion rot rotation ori orient orientation o r',
        'time timestamp timestamps stamp clock',
        'roll pitch yaw azimuth elevation euler heading',
        'v vel velocity acc accel acceleration gyro mag force sigma std cov err error bias',
    )
)
"""Words of places, turns, times, angles, and of columns with axes that are none of these."""
_AXIS = re.compile(f'({"|".join(sorted(PLACE | TURN, key=len, reverse=True))}|)([xyzw])')


class Meaning(NamedTuple):
    """Holds what a name says: kind (``place``, ``turn``, ``time``, ``angle`` or none), axis, unit,
    and the other words, which are of a body or sensor."""

    kind: str = ''
    axis: str = ''
    unit: str = ''
    group: tuple[str, ...] = ()


def is_unit(cell: str) -> bool:
    """Return whether a cell is the word for a unit, or says that there is none."""
    word = re.sub(r'[\W_]', '', cell).casefold()
    return not word or word in UNITS or word in ('none', 'quat', 'quaternion')


def words_of(name: str) -> list[str]:
    """Return the words of a name: ``Tool1 posX (mm)`` has tool, 1, pos, x, mm."""
    parted = re.sub('([a-z])([A-Z])', r'\1 \2', name)
    return re.findall('[^\\W\\d_]+|\\d+', parted.casefold())


def meaning_of(name: str, unit: str = '') -> Meaning:
    """Return what a name means, with the unit that a row of units states."""
    words = words_of(name)
    unit = UNITS.get(unit, '')
    stated = [word for word in words[:-1] if word in UNITS and len(word) > 1 and word != 'in']
    stated += [word for word in words[-1:] if word in UNITS]
    if len(words) > 1 and stated:
        unit = UNITS[stated[-1]]
        words.remove(stated[-1])
    is_span = len(words) == 1 and UNITS.get(words[0]) in TIME_NS
    if is_span or words == ['t'] or TIME.intersection(words[:1] + words[-1:]):
        group = tuple(word for word in words if word not in UNITS)
        return Meaning('time', '', unit or UNITS.get(words[0], ''), group)
    if ANGLES.intersection(words) or unit in ('deg', 'rad'):
        return Meaning('angle', '', unit)
    kind, axis, place = _axis(words)
    others = [*words[:place], *words[place + 1 :]]
    if not axis or OTHER.intersection(others):
        return Meaning()
    kinds = [word for word in others if word in TURN or word in PLACE]
    is_turn = axis == 'w' or (kind or ''.join(kinds[:1])) in TURN
    group = tuple(word for word in others if word not in kinds)
    return Meaning('turn' if is_turn else 'place', axis, unit, group)


def _axis(words: list[str]) -> tuple[str, str, int]:
    """Kind and axis that a word says, and which word; the last that says one."""
    for place in reversed(range(len(words))):
        if match := _AXIS.fullmatch(words[place]):
            return match[1], match[2], place
    for place in reversed(range(len(words))):
        word = words[place]
        if word in ('qr', 'qs'):
            return 'q', 'w', place
        if word in ('0', '1', '2', '3', 'r') and place and words[place - 1] in TURN:
            return '', 'w' if word == 'r' else word, place
    return '', '', 0


def triples(names: Sequence[str], found: Sequence[Meaning]) -> dict[str, Any]:
    """Return the columns of places and turns, by kind, the body's words and axis.

    Raises `ParameterError` for two of the same meaning.
    """
    axes: dict[str, dict[tuple[str, ...], dict[str, int]]] = {'place': {}, 'turn': {}}
    for column, one in enumerate(found):
        if one.kind in axes:
            known = axes[one.kind].setdefault(one.group, {})
            axis = 'w' if one.axis == '0' else one.axis  # NDI's Q0 Qx Qy Qz
            if axis in known:
                raise ParameterError(f'{names[known[axis]]} and {names[column]} mean the same')
            known[axis] = column
    return axes


class PoseColumns(NamedTuple):
    """Holds which columns are the pose of one body: x y z, and the quaternion x y z w."""

    place: list[int]
    turn: list[int]
    unit: str  # of length, a key of `LENGTH_M`; empty if no name states it


def pose_columns(
    names: Sequence[str], units: Sequence[str]
) -> tuple[dict[str, PoseColumns], list[tuple[int, str]]]:
    """Return the poses in a table by the body's words, and its times: column and unit.

    Raises `ParameterError`, which says what is not clear, when no pose or no time is named.
    """
    found = list(map(meaning_of, names, units))
    axes = triples(names, found)
    places = {group: one for group, one in axes['place'].items() if set('xyz') <= set(one)}
    turns = {group: one for group, one in axes['turn'].items() if set('xyzw') <= set(one)}
    both = {group: (places[group], turns[group]) for group in places if group in turns}
    if not both and len(places) == len(turns) == 1:
        both = {(): (*places.values(), *turns.values())}
    if not both:
        angles = [n for n, one in zip(names, found, strict=True) if one.kind in ('angle', 'turn')]
        raise ParameterError(
            'no position x, y, z' if not places else
            f'{", ".join(angles)} are no quaternion x, y, z, w' if angles else 'no quaternion'
        )  # fmt: skip
    bodies = {}
    common = set.intersection(*map(set, both)) if len(both) > 1 else set()
    for group, (place, turn) in both.items():
        unit = {found[place[axis]].unit for axis in 'xyz'}
        if len(unit) > 1 or not unit <= {*LENGTH_M, ''}:
            raise ParameterError(f'the columns x, y, z are in {", ".join(sorted(unit))}')
        label = '_'.join(word for word in group if word not in common)
        columns = [place[axis] for axis in 'xyz'], [turn[axis] for axis in 'xyzw']
        bodies[label] = PoseColumns(*columns, unit.pop())
    return bodies, _times(names, found)


def _times(names: Sequence[str], found: Sequence[Meaning]) -> list[tuple[int, str]]:
    """The column of times and its unit; two where seconds and their rest in ns stand apart."""
    times = [(column, one) for column, one in enumerate(found) if one.kind == 'time']
    times = [one for one in times if 'stamp' in one[1].group] or times
    if len({one.group for _, one in times}) == 1 < len(times):
        times.sort(key=lambda one: one[1].unit == 'ns')
        if [one.unit for _, one in times] == ['s', 'ns']:
            return [(column, one.unit) for column, one in times]
    if len(times) != 1:
        words = ', '.join(names[column] for column, _ in times)
        raise ParameterError(f'several times: {words}' if times else 'no time')
    return [(times[0][0], times[0][1].unit)]
