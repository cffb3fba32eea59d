"""Defines a node's parameter table, a frozen dataclass of fields made by :func:`parameter`: the
only place that knows a parameter's name, type, default, range and meaning. The node declares it,
``--help`` prints it, and an instance of it is what the node reads. Then follow the parameters that
several nodes have, and what parameter files say.
"""

import contextlib
import dataclasses
import difflib
import itertools
import math
import re
import typing
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from anser_ros.errors import AnserError, ParameterError
from anser_ros.wire.recorded import OPTICAL, TRACKED
from anser_ros.wire.text_files import NOMINAL, config_path, read_config, read_text, read_yaml

LIST_ITEMS = {tuple[float, ...]: float, tuple[int, ...]: int, tuple[str, ...]: str}
SCALARS = (bool, int, float, str)


@dataclasses.dataclass(frozen=True)
class Rule:
    """States what a parameter's value must satisfy, and what it means."""

    description: str  # one line for the operator, with the unit
    # inclusive bounds of a number, or of every number of a list
    within: tuple[float, float] = (-math.inf, math.inf)
    choices: tuple[str, ...] = ()  # the allowed texts; empty when any will do
    pattern: str = '(?s).*'  # what a text must be
    live: bool = False  # whether it may change while the node runs


def parameter(default: Any, description: str, **rule: Any) -> Any:
    """Return the dataclass field of one parameter, with the values of its :class:`Rule`."""
    return dataclasses.field(default=default, metadata={'rule': Rule(description, **rule)})


def rules(table: type) -> dict[str, Rule]:
    """Return the rule of every parameter of a table."""
    return {field.name: field.metadata['rule'] for field in dataclasses.fields(table)}


QOS = 'qos_overrides.'
"""How the names of parameters begin that change a topic's quality of service."""


def is_foreign(name: str) -> bool:
    """Return whether a parameter is rclpy's own."""
    own = 'use_sim_time', 'start_type_description_service'
    return name in own or name.startswith(QOS)


def is_known(table: type, name: str) -> bool:
    """Return whether a node with a table knows a parameter."""
    return name in types(table) or is_foreign(name)


def types(table: type) -> dict[str, Any]:
    """Return the type of every parameter of a table.

    Raises `ParameterError` where ROS has no parameters of a type.
    """
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
    known, rule_of = types(table), rules(table)
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise ParameterError(
            f'no parameter {", ".join(unknown)}; there are: {", ".join(known) or "none"}'
        )
    return table(**{n: _check(n, known[n], rule_of[n], value) for n, value in values.items()})


def _check(name: str, kind: Any, rule: Rule, value: Any) -> Any:
    """One value in the type of its field."""
    if kind in LIST_ITEMS:
        is_text = isinstance(value, str | bytes) and len(value) > 0
        if is_text or not isinstance(value, Iterable):
            raise ParameterError(f'parameter {name}: {value!r} is not a list')
        return tuple(_check(name, LIST_ITEMS[kind], rule, item) for item in value)
    # A YAML file that says ``rate_hz: 25`` is right.
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
        raise ParameterError(f'parameter {name}: {value!r} is not a {kind.__name__}')
    if kind is float and math.isnan(value):
        raise ParameterError(f'parameter {name}: not a number')
    if kind in (int, float):
        low, high = rule.within
        if value < low:
            raise ParameterError(f'parameter {name}: {value} is below {low}')
        if value > high:
            raise ParameterError(f'parameter {name}: {value} is above {high}')
    if kind is str and not re.fullmatch(rule.pattern, value):
        raise ParameterError(f'parameter {name}: {value!r} is no {rule.description}')
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
        limits = list(rule.choices)
        if rule.within != Rule.within:
            limits.append('{:g} to {:g}'.format(*rule.within))
        default = list(field.default) if isinstance(field.default, tuple) else field.default
        notes = f' [{" | ".join(limits)}]' if limits else ''
        notes += ' (may change while it runs)' if rule.live else ''
        lines.append(f'  {field.name} = {default!r}{notes}\n      {rule.description}')
    return '\n'.join(lines) or '  none'


STALE_AFTER_S = 0.3
"""Time without fluxes, or poses, s, after which a sensor is stale, unless parameters differ."""


def optical_parameter() -> Any:
    """Return the parameter of a node that has to do with optical poses."""
    return parameter(OPTICAL.rstrip('/'), 'namespace of the optical poses: NAMESPACE/BODY/pose')


def prefix_parameter() -> Any:
    """Return the parameter of a node that publishes in the board's frame."""
    words = "prefix of the frames, the board's too, for several boards; it ends with _ or /"
    return parameter('', words, pattern='(.*[_/])?')


def tracked_parameter() -> Any:
    """Return the parameter of a node that has to do with the poses of another tracker."""
    return parameter(
        TRACKED.rstrip('/'), "namespace of another tracker's poses: NAMESPACE/SENSOR/pose"
    )


def from_file(name: str, given: str, read: Callable[[Path], Any], none: Any = None) -> Any:
    """Return what a file holds that a parameter gives, by a path or its name in `config/`.

    It is ``none`` where no file is given. An error of the file states the parameter.
    """
    try:
        return none if given in NO_FILE else read(config_path(given))
    except AnserError as error:
        raise type(error)(f'parameter {name}: {error}') from error


def from_text(name: str, given: str, parse: Callable[[str], Any], none: Any = None) -> Any:
    """Return what the text of a file says, found as `from_file` does."""
    return from_file(name, given, lambda path: parse(read_text(path)), none)


NO_FILE = '', NOMINAL
"""Values of parameters of files that name none."""
LEAF = 'ros__parameters'
WILDCARDS = ('*', '**')


def _sections_given(arguments: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the path of each parameter file among a process's arguments, and its sections.

    Files that cannot be read or are not YAML are left out: rclpy refuses them.
    """
    for option, path in itertools.pairwise(arguments):
        if option == '--params-file':
            with contextlib.suppress(ParameterError, yaml.YAMLError):
                yield path, dict(_sections(read_yaml(read_text(path))))


def complaints(arguments: Sequence[str], node: str) -> list[str]:
    """Return one line for each parameter file without a section for a node, by its full name.

    rclpy ignores such a file silently, and the node runs with its defaults.
    """
    return [
        f'{path} has parameters of {", ".join(sections) or "no node"}, none of {node}: write '
        f'{node} or /**/{_node_of(node)}'
        for path, sections in _sections_given(arguments)
        if not any(re.fullmatch(_pattern(key), node) for key in sections)
    ]


def _pattern(key: str) -> str:
    """What names of nodes look like that a section is for: ** are any parts of one, * is one."""
    parts = key.strip('/').replace('**', '.+').replace('*', '[^/]+').replace('.+', '.*')
    return f'/{parts}'.replace('/.*/', '/(.*/)?')


def names_for(arguments: Sequence[str], node: str) -> Iterator[str]:
    """Yield the names of the values that parameter files have in sections of just this node."""
    for _, sections in _sections_given(arguments):
        for key, values in sections.items():
            if _node_of(key) == node and isinstance(values, dict):
                yield from map(str, values)


def checked(name: str, nodes: Collection[str]) -> str:
    """Return the path of a parameter file for several nodes: a path, or a file of `config/`.

    Raises `SetupError`: there is no such file, and `ParameterError`: it is no YAML, holds no
    section, or one whose node is not among ``nodes``: all would start with their defaults then.
    """
    path = str(config_path(name))
    try:
        sections = dict(_sections(read_yaml(read_config(name))))
    except (ValueError, yaml.YAMLError) as error:
        raise ParameterError(f'{path}: not YAML: {" ".join(str(error).split())}') from error
    if not sections:
        raise ParameterError(f'{path}: no section with {LEAF}')
    for key in sections:
        node = _node_of(key)
        if node not in (*nodes, *WILDCARDS):
            close = difflib.get_close_matches(node, nodes, n=1)
            hint = f', is {close[0]} meant?' if close else f'; there are: {", ".join(nodes)}'
            raise ParameterError(f'{path}: no node {key}{hint}')
    return path


def _node_of(key: str) -> str:
    """Return the name of a section's node, without its namespace."""
    return key.rsplit('/', 1)[-1]


def _sections(document: Any, path: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the full name of every section that holds parameters, and what it holds."""
    if not isinstance(document, dict):
        return
    if LEAF in document:
        yield path, document[LEAF]
    for key, value in document.items():
        if key != LEAF:
            yield from _sections(value, f'{path}/{key}' if path else str(key))
