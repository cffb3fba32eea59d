"""Explains the system's state in the words of the nodes' diagnostics, the gravest cause first.

A service answers with the same words, because both come from the node concerned.
"""

from collections.abc import Mapping

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
    """Name what is wrong: nodes that complain, then sensors without pose, by their reasons.

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
    texts = [words for _, words in found] + reasons
    return [_short(text) for text in texts[:MOST_CAUSES]]


def _loss(one: LastStatus, flux_rate_hz: float) -> str:
    """The share of frames that are missing, where a node states its rate."""
    try:
        rate_hz = float(one.values['rate_hz'])
    except (KeyError, ValueError):
        return ''
    share = 1.0 - rate_hz / flux_rate_hz if flux_rate_hz > 0 else 0.0
    return f'; {share:.0%} of the frames are missing' if share > LEAST_LOSS else ''


def _short(text: str) -> str:
    return text if len(text) <= MOST_TEXT else text[: MOST_TEXT - 3] + '...'
