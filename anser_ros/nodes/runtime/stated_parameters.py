"""Makes node parameters of `anser_ros.settings`, whose values the setup document may state too.

A parameter that is 0, its default, leaves the value to the setup document; any other value takes
precedence. The names, ranges and meanings are those of `anser_ros.settings.VALUES`.
"""

import dataclasses
from typing import Any

from anser_ros.nodes.runtime.parameters import parameter
from anser_ros.settings import VALUES, settings_from


def stated(name: str) -> Any:
    """Return the field of a parameter table for a value of `VALUES`; see `parameter`."""
    item = VALUES[name]
    meaning, high = item.metadata['meaning'], item.metadata['high']
    text = f'{meaning}; 0 for that of the setup document, or {item.default:.4g} without one'
    return parameter(item.type(0), text, minimum=0.0, maximum=high)  # type: ignore[operator]


def stated_by(table: Any) -> dict[str, float]:
    """Return the values that a node's parameters state, without those that are 0.

    Raises `ParameterError` when a value is out of its range.
    """
    names = [field.name for field in dataclasses.fields(table) if field.name in VALUES]
    values = {name: getattr(table, name) for name in names if getattr(table, name) != 0}
    settings_from(values)
    return values
