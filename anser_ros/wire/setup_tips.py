"""Reads and writes tips of tools: the key ``tips`` of a setup document, and files of tips only."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from anser_ros.errors import SetupError
from anser_ros.wire.setup_values import Vector, read_mapping, read_name, read_number, read_vector
from anser_ros.wire.yaml_text import read_yaml

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
    def covariance(self) -> NDArray[np.float64]:
        """Return the covariance as a matrix, shape (3, 3), m^2, body's frame."""
        matrix = np.zeros((3, 3))
        for (i, j), value in zip(UPPER, self.covariance_m2, strict=True):
            matrix[i, j] = matrix[j, i] = value
        return matrix


def parse_tips(item: Any) -> dict[str, TipSpec]:
    """Return the tips of a mapping from bodies to places.

    Raises
    ------
    SetupError
        With the place of what is no tip.
    """
    tips = {}
    for body, value in read_mapping(item, KEY).items():
        where = f'{KEY}.{body}'
        read_name(body, f'a body of {KEY}')
        tip = read_mapping(value, where)
        unknown = sorted(set(map(str, tip)) - set(KEYS))
        if unknown:
            raise SetupError(
                f'setup: {where} has only the keys {" and ".join(KEYS)}, not {unknown[0]}'
            )
        if 'position_m' not in tip:
            raise SetupError(f'setup: {where} lacks position_m')
        place = read_vector(tip['position_m'], f'{where}.position_m')
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
    """Refuse tips of unknown bodies, or whose topic exists; bodies are given with their topics.

    Raises
    ------
    SetupError
        With the body.
    """
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
    """Return the tips of a setup document's text, or of a file of tips alone.

    Raises
    ------
    SetupError
        When it is no YAML, or has no tips.
    """
    try:
        root = read_yaml(text)
    except (yaml.YAMLError, UnicodeError, ValueError) as error:
        raise SetupError(f'tips: not YAML: {" ".join(str(error).split())}') from error
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
    """Return a document's text with these tips beside its own; all else stays letter for letter.

    Raises
    ------
    SetupError
        As `parse_tips`, for the tips that it has.
    """
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
