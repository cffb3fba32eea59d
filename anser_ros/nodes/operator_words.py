"""Puts what nodes report and what a watcher finds into words for an operator."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from anser_ros.nodes.runtime.diagnostics import LastStatus, named

MOST_CAUSES = 4
"""Causes that are reported at once: what is behind all else is among the gravest."""
MOST_NAMES = 3
"""Sensors that are named for one cause; of the others the number is given."""
MOST_TEXT = 160
"""Characters of a cause: two lines of a terminal."""
LEAST_LOSS = 0.05
"""Share of missing frames that is reported: a rate over a second is off by a few percent."""


def causes(
    statuses: Mapping[str, LastStatus], namespace: str, flux_rate_hz: float = 0.0
) -> list[str]:
    """Name what is wrong, the gravest first: nodes that complain, then sensors without pose, by
    their reasons.

    ``statuses`` has what was reported last, by ``node`` or ``node: part``; the namespace is
    without slashes around it, and the rate of frames is 0 where it is not known.
    """
    found: list[tuple[int, str]] = []
    silent: dict[tuple[int, str], list[str]] = {}
    for name, one in statuses.items():
        node, _, part = name.partition(': ')
        home, _, short = node.rpartition('/')
        if home != namespace or not one.level:
            continue
        if not part:
            found.append((-one.level, f'{short}: {one.message}{_loss(one, flux_rate_hz)}'))
        elif short == 'tracker':
            silent.setdefault((-one.level, one.message), []).append(part)
    found.sort(key=lambda item: item[0])
    reasons = [
        f'{words} ({named(names, MOST_NAMES)})' for (_, words), names in sorted(silent.items())
    ]
    texts = ([words for _, words in found] + reasons)[:MOST_CAUSES]
    return [text if len(text) <= MOST_TEXT else f'{text[: MOST_TEXT - 3]}...' for text in texts]


def _loss(one: LastStatus, flux_rate_hz: float) -> str:
    """The share of frames that are missing, where a node states its rate."""
    try:
        rate_hz = float(one.values['rate_hz'])
    except (KeyError, ValueError):
        return ''
    share = 1.0 - rate_hz / flux_rate_hz if flux_rate_hz > 0 else 0.0
    return f'; {share:.0%} of the frames are missing' if share > LEAST_LOSS else ''


if TYPE_CHECKING:  # words must not load the kernels
    from anser_ros.field.model import EffectRecord

SITES = ('channel', 'channels', 'coil', 'coils', 'body', 'sensor', 'stream')
MOST_FIGURE_TEXT = 60
"""Characters of a figure beyond which it is left to the values: a line is read at a glance."""


def findings_words(findings: Sequence['EffectRecord']) -> str:
    """Return every effect with its site and its parameters, for a line."""
    return '; '.join(f'{title_of(record)}: {figures_of(record)}' for record in findings)


def titles_of(findings: Sequence['EffectRecord']) -> str:
    return ', '.join(title_of(record) for record in findings)


def title_of(record: 'EffectRecord') -> str:
    """Return the name of an effect and where it sits."""
    sites = [
        f'{key} {plain_text(record.parameters[key])}' for key in SITES if key in record.parameters
    ]
    return f'{record.name} ({", ".join(sites)})' if sites else record.name


def figures_of(record: 'EffectRecord') -> str:
    """Return the parameters that are short enough for a line."""
    texts = {k: plain_text(v) for k, v in record.parameters.items() if k not in SITES}
    parts = [f'{key} {text}' for key, text in texts.items() if len(text) <= MOST_FIGURE_TEXT]
    return ', '.join(parts) or 'found'


def plain_text(value: Any) -> str:
    """Return a parameter as an operator reads it: numbers short, lists and mappings unquoted."""
    if isinstance(value, str):
        return value
    if isinstance(value, complex):
        return f'{value:.4g}'
    if isinstance(value, (bool, int, np.integer)) or value is None:
        return str(value)
    if isinstance(value, (float, np.floating)):
        return f'{value:.5g}'
    if isinstance(value, dict):
        return ', '.join(f'{key} {plain_text(item)}' for key, item in value.items())
    return '[' + ' '.join(plain_text(item) for item in value) + ']'
