"""Words the parameters of an effect on poses for a clinic's engineer: in mm, ms and degrees."""

import math
from collections.abc import Mapping
from typing import Any

from anser_ros.cli.diagnosis_words import short_ones, value_text

UNSHOWN = ('centre_m', 'size_m', 'lowest', 'middle_s', 'degree', 'strain')
"""Parameters that tell how a map or a course is written, and not what it does."""
SCALES = {'s': (1e3, 'ms'), 'm': (1e3, 'mm'), 'rad': (180 / math.pi, 'deg'), 'deg': (1.0, 'deg'),
          'ppm': (1.0, 'ppm')}  # fmt: skip
"""By the unit at the end of a parameter's name: the factor to the one that is shown, and that."""
TIMES = ('t_start', 't_end', 'since')  # times of a session, which stay in s
MOST_DECIMALS = 4


def sizes(parameters: Mapping[str, Any], sigmas: Mapping[str, Any]) -> list[str]:
    """Return a line for each parameter that fits one, with its standard deviation."""
    by_time = 'rms_s' in parameters
    return [
        _line(key, value, sigmas.get(key), by_time)
        for key, value in short_ones(dict(parameters))
        if key not in UNSHOWN and value not in (None, [], {})
    ]


def _line(key: str, value: Any, sigma: Any, by_time: bool) -> str:
    if isinstance(value, dict):
        factor, unit = SCALES['s'] if by_time else (1.0, '')
        each = [
            f'{name}\xa0{_number(factor * one if isinstance(one, float) else one, None)}'
            for name, one in value.items()
        ]
        return f'{_name(key)}: {", ".join(each)} {unit}'.rstrip()
    name, _, unit = key.rpartition('_')
    if not isinstance(value, float):
        return f'{_name(key)}: {value_text(value)}'
    if key == 'fraction':
        return f'share: {_number(100 * value, None)} %'
    if name in TIMES:
        return f'{_name(name)}: {value:.1f} s'
    factor, shown = SCALES.get(unit, (1.0, '')) if name else (1.0, '')
    spread = factor * sigma if isinstance(sigma, float) else None
    text = _number(factor * value, spread)
    if spread is not None:
        text += f'\xa0±\xa0{_number(spread, spread)}'
    return f'{_name(name if shown else key)}: {text} {shown}'.rstrip()


def _name(key: str) -> str:
    return key.removeprefix('t_').replace('_', ' ')


def _number(value: float, sigma: float | None) -> str:
    """A number with as many decimals as its standard deviation has two digits, or three digits."""
    if isinstance(value, int):
        return str(value)
    size = sigma if sigma else abs(value) / 10
    if not math.isfinite(size) or size <= 0:
        return f'{value:.3g}'
    decimals = 1 - math.floor(math.log10(size))
    return f'{value:.{min(max(decimals, 0), MOST_DECIMALS)}f}'
