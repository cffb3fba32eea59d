"""Finds what the applications in `anser_ros/apps` add to the core, which names none of them.

An application states its additions in the module ``extension`` of its folder, as tables of texts,
so that reading them loads nothing. An entry is a module of the application, or ``module:name``,
an object in it; it is loaded when the core uses it. Tables that are not stated are empty:

- ``NODES``, ``OFFLINE``: commands with their line of help, in ``nodes`` and ``cli`` of the
  application; ``SESSION_KINDS``: kinds of sessions with their module and line; ``NEEDED``:
  packages that a node cannot do without. `cli.commands` and `cli.main` read these.
- ``ENGINES``: tuples of `sessions.calibration.Engine`, asked before the scan's own.
- ``DIAGNOSES``: modules that diagnose sessions of their kind, see `sessions.diagnosis.other_way`.
- ``OBSERVERS``: what else is tracked in a session, see `sessions.tracked_session.SessionObserver`.
- ``STREAMS``: what a watcher can watch besides fluxes, by the parameter that asks for it.
- ``PASSIVE``: nodes for which no source waits.
"""

import functools
import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

APPS = Path(__file__).with_name('apps')


@functools.cache
def _extensions() -> tuple[ModuleType, ...]:
    names = sorted(path.parent.name for path in APPS.glob('*/extension.py'))
    return tuple(importlib.import_module(f'{__package__}.apps.{name}.extension') for name in names)


def tables(name: str) -> Iterator[Any]:
    """Yield a table of each application that states it."""
    return (vars(one)[name] for one in _extensions() if hasattr(one, name))


def loaded(table: str, is_wanted: Callable[[str], Any] = bool) -> Iterator[Any]:
    """Yield the modules or objects that a table names; of a mapping, the values of wanted keys."""
    for extension in _extensions():
        stated = getattr(extension, table, ())
        is_named = isinstance(stated, dict)
        for entry in (stated[key] for key in stated if is_wanted(key)) if is_named else stated:
            module, _, name = entry.partition(':')
            found = importlib.import_module(f'{extension.__package__}.{module}')
            yield getattr(found, name) if name else found
