"""Finds parameter files without an entry for the node that they were given to."""

import difflib
import itertools
from collections.abc import Collection, Iterator, Sequence
from typing import Any

import yaml

from anser_ros.errors import ParameterError
from anser_ros.wire.config_folder import config_path, read_config
from anser_ros.wire.text_files import read_text
from anser_ros.wire.yaml_text import read_yaml

OPTION = '--params-file'
LEAF = 'ros__parameters'
WILDCARDS = ('*', '**')


def _documents(arguments: Sequence[str]) -> Iterator[tuple[str, Any]]:
    """Yield the path and content of each parameter file among a process's arguments.

    Files that cannot be read or are not YAML are left out: rclpy refuses them.
    """
    for option, value in itertools.pairwise(arguments):
        if option != OPTION:
            continue
        try:
            document = read_yaml(read_text(value))
        except (ParameterError, yaml.YAMLError):
            continue
        yield value, document


def complaints(arguments: Sequence[str], node: str) -> list[str]:
    """Return one line for each parameter file without a section for a node.

    rclpy ignores such a file silently, and the node runs with its defaults. A file that is not a
    parameter file is left to rclpy, which refuses it.
    """
    found = []
    for value, document in _documents(arguments):
        keys = [key for key, _ in _sections(document)]
        names = [key.rsplit('/', 1)[-1] for key in keys]
        if node in names or any(name in WILDCARDS for name in names):
            continue
        close = difflib.get_close_matches(node, names, n=1)
        hint = f"is '{keys[names.index(close[0])]}' meant?" if close else f'it has: {_list(keys)}'
        found.append(f'{value} has nothing for {node}; {hint}')
    return found


def names_for(arguments: Sequence[str], node: str) -> Iterator[str]:
    """Yield the names of the values that parameter files have in sections of just this node."""
    for _, document in _documents(arguments):
        for key, values in _sections(document):
            if key.rsplit('/', 1)[-1] == node and isinstance(values, dict):
                yield from map(str, values)


def checked(name: str, nodes: Collection[str]) -> str:
    """Return the path of a parameter file for several nodes: a path, or a file of `config/`.

    Raises `SetupError`: there is no such file, and `ParameterError`: it is no YAML, holds no
    section, or one whose node is not among ``nodes``: all would start with their defaults then.
    """
    path = str(config_path(name))
    try:
        document = read_yaml(read_config(name))
    except (ValueError, yaml.YAMLError) as error:
        raise ParameterError(f'{path}: not YAML: {" ".join(str(error).split())}') from error
    keys = [key for key, _ in _sections(document)]
    if not keys:
        raise ParameterError(f'{path}: no section with {LEAF}')
    for key in keys:
        last = key.rsplit('/', 1)[-1]
        if last not in (*nodes, *WILDCARDS):
            close = difflib.get_close_matches(last, nodes, n=1)
            hint = f', is {close[0]} meant?' if close else f'; there are: {", ".join(nodes)}'
            raise ParameterError(f'{path}: no node {key}{hint}')
    return path


def _sections(document: Any, path: str = '') -> Iterator[tuple[str, Any]]:
    """Yield the full name of every section that holds parameters, and what it holds."""
    if not isinstance(document, dict):
        return
    if LEAF in document:
        yield path, document[LEAF]
    for key, value in document.items():
        if key != LEAF:
            yield from _sections(value, f'{path}/{key}' if path else str(key))


def _list(keys: Sequence[str]) -> str:
    return ', '.join(keys) or 'no section at all'
