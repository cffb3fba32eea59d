"""Finds message types of the installation by name: class, definition text and type hash."""

import importlib
import json
import os
import re
import sys
from pathlib import Path
from typing import Any

from anser_ros.errors import BagError

# What rosbag2 and mcap put between the definitions of a message and of its parts.
SEPARATOR = '=' * 80
# The integers of ROS's interface language.
NUMBERS = {f'{kind}{bits}' for kind in ('int', 'uint') for bits in (8, 16, 32, 64)}
PRIMITIVES = NUMBERS | {'bool', 'byte', 'char', 'float32', 'float64', 'string', 'wstring'}
FIELD = re.compile(r'^([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+\w+')


def message_class(type_name: str) -> type:
    """Return the class of a type such as ``std_msgs/msg/String``.

    Raises
    ------
    BagError
        The type is not installed.
    """
    package, kind, name = _split(type_name)
    try:
        found: type = getattr(importlib.import_module(f'{package}.{kind}'), name)
    except (ImportError, AttributeError) as error:
        raise BagError(f'type {type_name} is not installed') from error
    return found


def definition(type_name: str) -> str:
    """Return the text of a type followed by those of all types in it, as rosbag2 stores them.

    Raises
    ------
    BagError
        A definition is not installed.
    """
    parts: list[str] = []
    seen, waiting = {type_name}, [type_name]
    while waiting:
        current = waiting.pop(0)
        text = _file(current, 'msg').read_text(encoding='utf-8')
        package, _, name = _split(current)
        title = f'{SEPARATOR}\nMSG: {package}/{name}\n' if parts else ''
        parts.append(title + text)
        for inner in _contained(text, package):
            if inner not in seen:
                seen.add(inner)
                waiting.append(inner)
    return '\n'.join(parts)


def type_hash(type_name: str) -> str:
    """Return the type's hash, or nothing where the installation does not have it."""
    try:
        document: dict[str, Any] = json.loads(_file(type_name, 'json').read_text('utf-8'))
        hashes = {entry['type_name']: entry['hash_string'] for entry in document['type_hashes']}
    except (BagError, ValueError, KeyError, TypeError):
        return ''
    return str(hashes.get(type_name, ''))


def _split(type_name: str) -> tuple[str, str, str]:
    tokens = type_name.split('/')
    if len(tokens) != 3 or not all(tokens):
        raise BagError(f'{type_name!r} is not a message type')
    return tokens[0], tokens[1], tokens[2]


def _file(type_name: str, ending: str) -> Path:
    package, kind, name = _split(type_name)
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    for prefix in [*filter(None, prefixes), sys.prefix]:
        path = Path(prefix, 'share', package, kind, f'{name}.{ending}')
        if path.is_file():
            return path
    raise BagError(f'no definition of {type_name} is installed')


def _contained(text: str, package: str) -> list[str]:
    """Return the full names of the types of a definition's fields."""
    found = []
    for line in text.splitlines():
        match = FIELD.match(line.split('#', 1)[0].strip())
        if match is None or match[1] in PRIMITIVES:
            continue
        tokens = match[1].split('/')
        found.append(f'{tokens[0] if len(tokens) > 1 else package}/msg/{tokens[-1]}')
    return found
