"""Reads values of a setup document, or refuses them with their place in the document.

All functions raise `SetupError` with one line that names the value and its place.
"""

import difflib
import math
import re
from collections.abc import Iterable
from typing import Any

import numpy as np

from anser_ros.errors import SetupError

AXIS_TOLERANCE = 1e-3
"""Largest deviation of an axis' length from one; axes with three written digits pass."""
LARGEST_NUMBER = 1e300
"""Size from which on a number counts as infinite, in any unit."""
LIKENESS = 0.8
"""Ratio of equal letters (`difflib`) from which an unknown key is taken for a misspelt one: one
letter off in a short key, two in a long one. Smaller, and a user's own keys are refused."""
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


def read_mapping(value: Any, where: str) -> dict[str, Any]:
    """Return what has to be a mapping."""
    if not isinstance(value, dict):
        got = 'nothing' if value is None else type(value).__name__
        raise SetupError(f'setup: {where} must be a mapping, got {got}')
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
