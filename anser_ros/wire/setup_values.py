"""Reads values of a setup document, or refuses them with their place, and the tips of tools.

All functions raise `SetupError` with one line that names the value and its place. Tips are the key
``tips`` of a setup document, or a file of their own.
"""

import difflib
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

from anser_ros.arrays import Array
from anser_ros.errors import SetupError
from anser_ros.wire.text_files import read_own_yaml, read_yaml

AXIS_TOLERANCE = 1e-3
"""Largest deviation of an axis' length from one; axes with three written digits pass."""
LARGEST_NUMBER = 1e300
"""Size from which on a number counts as infinite, in any unit."""
LIKENESS = 0.8
"""Ratio of equal letters (`difflib`) from which an unknown key is a misspelt one: one letter off
in a short key, two in a long one. Smaller, and a user's own keys are refused."""
NAME = re.compile(r'^[A-Za-z0-9_]+(/[A-Za-z0-9_]+)*$')
Vector = tuple[float, float, float]
Winding = tuple[float, float, float, float]


def read_number(value: Any, where: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Return a finite number within bounds."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise SetupError(f'setup: {where} must be a number, got {value!r}')
    # A whole number may be too large for a float; its digits then are too many to show.
    number = float(value) if abs(value) < LARGEST_NUMBER else math.inf
    if not math.isfinite(number) or not low <= number <= high:
        shown = repr(value) if math.isfinite(number) else 'a number that is not finite'
        raise SetupError(f'setup: {where} must be finite and in [{low:g}, {high:g}], got {shown}')
    return number


def read_vector(value: Any, where: str) -> Vector:
    """Return three numbers, in m or parts of an axis, of at most 100 each."""
    if not isinstance(value, list) or len(value) != 3:
        raise SetupError(f'setup: {where} must be a list of three numbers, got {value!r}')
    x, y, z = (read_number(v, f'{where}[{i}]', -100.0, 100.0) for i, v in enumerate(value))
    return x, y, z


def read_axis(value: Any, where: str) -> Vector:
    """Return a unit vector, its length exactly one."""
    vector = np.asarray(read_vector(value, where))
    norm = math.hypot(*vector)  # the same to the last bit on every machine
    if abs(norm - 1.0) > AXIS_TOLERANCE:
        raise SetupError(f'setup: {where} must be a unit vector, its length is {norm:.6g}')
    if abs(norm - 1.0) > 1e-12:
        vector = vector / norm
    x, y, z = (float(v) for v in vector)
    return x, y, z


def read_windings(value: Any, where: str) -> tuple[Winding, ...]:
    """Return the points of a sensor that is no single coil: offsets, m, and weights."""
    if not isinstance(value, list) or len(value) < 2:
        raise SetupError(f'setup: {where} must be a list of at least two windings, got {value!r}')
    windings = []
    for i, item in enumerate(value):
        here = f'{where}[{i}]'
        if not isinstance(item, list) or len(item) != 4:
            raise SetupError(f'setup: {here} must be [x, y, z, weight], got {item!r}')
        weight = read_number(item[3], f'{here}[3]', -100.0, 100.0)
        windings.append((*read_vector(item[:3], here), weight))
    return tuple(windings)


def read_mapping(value: Any, where: str, *keys: str) -> dict[str, Any]:
    """Return what has to be a mapping; where keys are named, it may have no others."""
    if not isinstance(value, dict):
        got = 'nothing' if value is None else type(value).__name__
        raise SetupError(f'setup: {where} must be a mapping, got {got}')
    unknown = sorted(set(map(str, value)) - set(keys))
    if keys and unknown:
        raise SetupError(
            f'setup: {where} has only the keys {" and ".join(keys)}, not {unknown[0]}'
        )
    return value


def take(document: dict[str, Any], key: str, where: str) -> Any:
    """Return the value of a key that has to be there."""
    if key not in document:
        raise SetupError(f'setup: {where} lacks the key {key!r}')
    return document[key]


def read_name(value: Any, where: str) -> str:
    """Return words joined by /, as names of coils, sensors and bodies are."""
    if not isinstance(value, str) or not NAME.match(value):
        raise SetupError(f'setup: {where} must be words joined by /, got {value!r}')
    return value


def refuse_repeats(values: list[Any], what: str) -> None:
    """Refuse values that appear twice."""
    seen: set[Any] = set()
    for value in values:
        if value in seen:
            raise SetupError(f'setup: {what} {value!r} appears twice')
        seen.add(value)


def refuse_misspelt(given: Iterable[Any], known: Iterable[str]) -> None:
    """Refuse a key that is nearly one of ours: its values would be passed over in silence."""
    for key in map(str, given):
        meant = difflib.get_close_matches(key.lower(), list(known), n=1, cutoff=LIKENESS)
        if meant:
            raise SetupError(f'setup: unknown key {key!r}: is {meant[0]!r} meant?')


SCHEMA = 'anser_tips/1'
"""Schema of a file of tips alone."""
KEY = 'tips'
KEYS = ('position_m', 'covariance_m2')
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Order of a covariance's six numbers: xx, xy, xz, yy, yz, zz."""
LONGEST_TIP_M = 2.0
"""A tip is no farther from its body's origin, m: it is a hand-held tool's, or in millimetres."""
NOT_NEGATIVE = -1e-9
"""Smallest eigenvalue of a covariance over its largest that rounding makes."""


@dataclass(frozen=True)
class TipSpec:
    """Describes a tool's tip in its body's frame, m, with its covariance, m^2, by `UPPER`."""

    position_m: Vector
    covariance_m2: tuple[float, ...] = (0.0,) * 6

    @property
    def covariance(self) -> Array:
        """Return the covariance as a matrix, shape (3, 3), m^2, body's frame."""
        matrix = np.zeros((3, 3))
        for (i, j), value in zip(UPPER, self.covariance_m2, strict=True):
            matrix[i, j] = matrix[j, i] = value
        return matrix


def parse_tips(item: Any) -> dict[str, TipSpec]:
    """Return the tips of a mapping from bodies to places; `SetupError` names what is no tip."""
    tips = {}
    for body, value in read_mapping(item, KEY).items():
        where = f'{KEY}.{body}'
        read_name(body, f'a body of {KEY}')
        tip = read_mapping(value, where, *KEYS)
        place = read_vector(take(tip, 'position_m', where), f'{where}.position_m')
        if max(map(abs, place)) > LONGEST_TIP_M:
            raise SetupError(f'setup: {where}.position_m is in m, got {list(place)}')
        numbers = tip.get('covariance_m2', [0.0] * 6)
        if not isinstance(numbers, list) or len(numbers) != len(UPPER):
            raise SetupError(
                f'setup: {where}.covariance_m2 must be six numbers (xx, xy, xz, yy, yz, zz)'
            )
        spec = TipSpec(
            place, tuple(read_number(v, f'{where}.covariance_m2', -1.0, 1.0) for v in numbers)
        )
        values = np.linalg.eigvalsh(spec.covariance)
        if values[0] < NOT_NEGATIVE * max(values[-1], 1e-30):
            raise SetupError(
                f'setup: {where}.covariance_m2 is not a covariance: a variance is negative'
            )
        tips[str(body)] = spec
    return tips


def refuse_unknown_bodies(
    tips: Iterable[str], bodies: Mapping[str, str], topics: Iterable[str]
) -> None:
    """Raise `SetupError` for tips of unknown bodies, or whose topic is taken."""
    taken = set(topics)
    for body in tips:
        if body not in bodies:
            names = ', '.join(sorted(bodies)) or 'none'
            raise SetupError(f'setup: {KEY}.{body}: no such body that moves; there are: {names}')
        if tip_name(bodies[body]) in taken:
            raise SetupError(
                f'setup: {KEY}.{body} would be on the topic of a sensor, '
                f'{tip_name(bodies[body])!r}: give the sensor another name'
            )


def tip_name(body: str) -> str:
    """Return what a body's tip is called, in topics and in ``/diagnostics``."""
    return f'{body}/tip'


def read_tips(text: str) -> dict[str, TipSpec]:
    """Return the tips of a setup document, or of a file of tips alone; raises `SetupError`."""
    root = read_own_yaml(text, 'tips')
    if not isinstance(root, dict) or KEY not in root:
        raise SetupError(f'tips: the document has no key {KEY}')
    return parse_tips(root[KEY])


def dump_tips(tips: Mapping[str, TipSpec]) -> dict[str, Any]:
    """Return the value of the key ``tips`` that `parse_tips` reads back."""
    return {
        body: {'position_m': list(t.position_m), 'covariance_m2': list(t.covariance_m2)}
        for body, t in tips.items()
    }


def with_tips(text: str, tips: Mapping[str, TipSpec]) -> str:
    """Return a document's text with these tips beside its own; all else is unchanged."""
    root = read_mapping(read_yaml(text), 'the document')
    whole = {**(parse_tips(root[KEY]) if KEY in root else {}), **tips}
    kept, inside = [], False
    for line in text.splitlines():
        if line.startswith(f'{KEY}:'):
            inside = True
        elif inside and line[:1] not in (' ', '\t', '}', ''):
            inside = False
        if not inside:
            kept.append(line)
    while kept and not kept[-1].strip():
        kept.pop()
    block = yaml.safe_dump({KEY: dump_tips(whole)}, sort_keys=False, default_flow_style=None)
    return '\n'.join([*kept, block])
