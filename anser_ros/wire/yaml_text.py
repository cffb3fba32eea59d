"""Reads YAML from anybody: plain data only, within bounds of size, depth and aliases."""

from typing import Any

import yaml

# libyaml's are several times as fast, where it is there.
_LOADER: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
DUMPER: Any = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)
"""What plain data is written with."""
MOST_CHARACTERS = 32_000_000
"""Longest text that is read. A model of 4000 dipoles with forty modes is half as long; the time to
read grows with it, by a second for each megabyte."""
DEEPEST = 40
"""Deepest nesting. No document here has more than eight levels; the parser's own recursion ends
the process from some ten thousand on."""
MOST_NODES = 5_000_000
"""Most values of a document, with aliases written out, as whoever prints or copies it does. Thirty
lines of aliases of aliases stand for a thousand million."""


def read_yaml(text: str) -> Any:
    """Return a document as plain data.

    Raises
    ------
    yaml.YAMLError
        When it is no YAML, has a tag of its own, or is beyond a bound.
    """
    if len(text) > MOST_CHARACTERS:
        raise yaml.YAMLError(f'{len(text)} characters are too long, the most is {MOST_CHARACTERS}')
    _check(text)
    return yaml.load(text, Loader=_LOADER)


def _check(text: str) -> None:
    """Walk through the events of a document, which takes no recursion and builds nothing."""
    sizes: dict[str, int] = {}
    open_nodes: list[tuple[str | None, int]] = []
    total = 0
    for event in yaml.parse(text, Loader=_LOADER):
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_nodes.pop()
            if anchor is not None:
                sizes[anchor] = total - before
            continue
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise yaml.YAMLError(
                    f'the alias {event.anchor} is not defined, or contains itself'
                )
            total += sizes[event.anchor]
        elif isinstance(event, yaml.NodeEvent):
            total += 1
            if isinstance(event, yaml.CollectionStartEvent):
                open_nodes.append((event.anchor, total - 1))
            elif event.anchor is not None:
                sizes[event.anchor] = 1
        if len(open_nodes) > DEEPEST:
            raise yaml.YAMLError(f'nested deeper than {DEEPEST} levels')
        if total > MOST_NODES:
            raise yaml.YAMLError(f'more than {MOST_NODES} values, aliases written out')
