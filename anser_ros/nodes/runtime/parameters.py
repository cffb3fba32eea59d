"""Defines a node's parameter table: a frozen dataclass of fields made by :func:`parameter`.

The dataclass is the only place that knows a parameter's name, type, default, range and meaning.
The node declares it, ``--help`` prints it, and an instance of it is what the node reads::

    @dataclass(frozen=True)
    class TrackerParameters:
        gate: float = parameter(4.0, 'largest residual in standard deviations', minimum=0.0)
"""

import dataclasses
import math
import typing
from collections.abc import Iterable, Mapping
from typing import Any

from anser_ros.errors import ParameterError

LIST_ITEMS = {tuple[float, ...]: float, tuple[int, ...]: int, tuple[str, ...]: str}
SCALARS = (bool, int, float, str)


@dataclasses.dataclass(frozen=True)
class Rule:
    """States what a parameter's value must satisfy, and what it means.

    Attributes
    ----------
    description : str
        One line for the operator, with the unit.
    minimum, maximum : float or None
        Inclusive bounds of a number, or of every number of a list.
    choices : tuple of str
        The allowed texts; empty when any will do.
    live : bool
        Whether it may change while the node runs.
    """

    description: str
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = False


def parameter(
    default: Any,
    description: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """Return the dataclass field of one parameter (see :class:`Rule`)."""
    rule = Rule(description, minimum, maximum, choices, live)
    return dataclasses.field(default=default, metadata={'rule': rule})


def rules(table: type) -> dict[str, Rule]:
    """Return the rule of every parameter of a table."""
    return {field.name: field.metadata['rule'] for field in dataclasses.fields(table)}


FOREIGN = ('use_sim_time', 'start_type_description_service')
"""Parameters that rclpy itself declares or reads ..."""
FOREIGN_PREFIXES = ('qos_overrides.',)
"""... and what the names of others begin with."""


def is_foreign(name: str) -> bool:
    """Return whether a parameter is rclpy's own."""
    return name in FOREIGN or name.startswith(FOREIGN_PREFIXES)


def is_known(table: type, name: str) -> bool:
    """Return whether a node with a table knows a parameter."""
    return name in types(table) or is_foreign(name)


def types(table: type) -> dict[str, Any]:
    """Return the type of every parameter of a table."""
    hints = typing.get_type_hints(table)
    for name, kind in hints.items():
        if kind not in SCALARS and kind not in LIST_ITEMS:
            raise ParameterError(f'parameter {name}: no parameter can be a {kind}')
    return hints


def build(table: type, values: Mapping[str, Any]) -> Any:
    """Return a table's instance from values of the ROS graph, a file or a command line.

    Raises `ParameterError`: a name that the table does not have, a value of the wrong type, or one
    out of its range.
    """
    known = types(table)
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise ParameterError(
            f'no parameter {", ".join(unknown)}; there are: {", ".join(known) or "none"}'
        )
    checked = {
        name: _check(name, known[name], rules(table)[name], values[name]) for name in values
    }
    return table(**checked)


def _check(name: str, kind: Any, rule: Rule, value: Any) -> Any:
    """One value in the type of its field.

    A whole number will do for a float: a YAML file that says ``rate_hz: 25`` is right.
    """
    if kind not in LIST_ITEMS:
        return _check_scalar(name, kind, rule, value)
    is_text = isinstance(value, str | bytes) and len(value) > 0
    if is_text or not isinstance(value, Iterable):
        raise ParameterError(f'parameter {name}: {value!r} is not a list')
    return tuple(_check_scalar(name, LIST_ITEMS[kind], rule, item) for item in value)


def _check_scalar(name: str, kind: type[Any], rule: Rule, value: Any) -> Any:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
        raise ParameterError(f'parameter {name}: {value!r} is not a {kind.__name__}')
    if kind is float and math.isnan(value):
        raise ParameterError(f'parameter {name}: not a number')
    if rule.minimum is not None and value < rule.minimum:
        raise ParameterError(f'parameter {name}: {value} is below {rule.minimum}')
    if rule.maximum is not None and value > rule.maximum:
        raise ParameterError(f'parameter {name}: {value} is above {rule.maximum}')
    if rule.choices and value not in rule.choices:
        raise ParameterError(
            f'parameter {name}: {value!r} is none of {", ".join(map(repr, rule.choices))}'
        )
    return value


def describe(table: type) -> str:
    """Return the table as text, one parameter a line."""
    lines = []
    for field in dataclasses.fields(table):
        rule = field.metadata['rule']
        limits = [str(choice) for choice in rule.choices]
        if rule.minimum is not None or rule.maximum is not None:
            low = '-inf' if rule.minimum is None else f'{rule.minimum:g}'
            high = 'inf' if rule.maximum is None else f'{rule.maximum:g}'
            limits.append(f'{low} to {high}')
        default = list(field.default) if isinstance(field.default, tuple) else field.default
        notes = f' [{" | ".join(limits)}]' if limits else ''
        notes += ' (may change while it runs)' if rule.live else ''
        lines.append(f'  {field.name} = {default!r}{notes}\n      {rule.description}')
    return '\n'.join(lines) or '  none'
