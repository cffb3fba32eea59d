"""Reads files from anybody: text, YAML within bounds, model files.

A file that cannot be read, or is no text of its kind, is one clear line.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import yaml

from anser_ros.errors import AnserError, ModelFileError, ParameterError, SetupError


def path_of(given: str | os.PathLike[str], what: str) -> Path:
    """Return a path; raises `ParameterError` for anything else."""
    if isinstance(given, str | os.PathLike):
        return Path(given)
    raise ParameterError(f'{what} is wanted as a path, got {type(given).__name__}')


PACKED = {b'PK': ', but a workbook or archive: export CSV', b'\x1f\x8b': ': unpack it (gzip)'}
"""What other files are by their first bytes, and what makes a text of them."""


def read_text(
    path: str | os.PathLike[str],
    kind: type[AnserError] = ParameterError,
    *,
    any_letters: bool = False,
) -> str:
    """Return the text (UTF-8, UTF-16) of a file, or if wanted Windows' letters; raises a kind."""
    try:
        data = Path(path).read_bytes()
        is_wide = data[:2] in (b'\xff\xfe', b'\xfe\xff') or (
            len(data) > 2 and not data[1:64:2].strip(b'\0')
        )
        text = data.decode('utf-16' if is_wide else 'utf-8-sig')
    except OSError as error:
        raise kind(f'{os.fspath(path)}: {error.strerror}') from error
    except UnicodeDecodeError:
        text = data.decode('cp1252', 'replace') if any_letters else '\0'
    if '\0' in text:
        why = next((words for begin, words in PACKED.items() if data.startswith(begin)), '')
        raise kind(f'{os.fspath(path)}: not a text in UTF-8{why}')
    return text


# libyaml's are several times as fast, where it is there.
_LOADER: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
DUMPER: Any = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)
"""What plain data is written with."""
MOST_CHARACTERS = 32_000_000
"""Longest text that is read, a second for each megabyte; a large model is half as long."""
DEEPEST = 40
"""Deepest nesting; ours has eight levels, and the parser's recursion ends the process at 10^4."""
MOST_NODES = 5_000_000
"""Most values of a document with aliases written out: thirty lines may stand for 10^9."""


def read_yaml(text: str) -> Any:
    """Return a document as plain data; `yaml.YAMLError` for another tag, or beyond a bound."""
    if len(text) > MOST_CHARACTERS:
        raise yaml.YAMLError(f'{len(text)} characters are too long, the most is {MOST_CHARACTERS}')
    _check(text)
    return yaml.load(text, Loader=_LOADER)


def read_own_yaml(text: str, what: str, kind: type[AnserError] = SetupError) -> Any:
    """Return a document of ours as plain data; raises a kind, which names what it is."""
    try:
        return read_yaml(text)
    except (yaml.YAMLError, ValueError) as error:  # of which UnicodeError is one
        raise kind(f'{what}: not YAML: {" ".join(str(error).split())}') from error


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


def read_document(path: str | os.PathLike[str], schema: str = '') -> Any:
    """Parse a model file; raises `ModelFileError` when it is no YAML of the schema, if any."""
    found = read_own_yaml(read_text(path, ModelFileError), os.fspath(path), ModelFileError)
    if schema and (not isinstance(found, dict) or found.get('schema') != schema):
        raise ModelFileError(f'{os.fspath(path)}: its schema must be {schema}')
    return found


def write_document(path: str | os.PathLike[str], document: Any) -> None:
    """Write a model file whole or not at all; raises `ModelFileError` when it can't be written."""
    name = os.fspath(path)
    try:
        folder = os.path.dirname(os.path.abspath(name))
        os.makedirs(folder, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=folder, suffix='.tmp')
        with os.fdopen(handle, 'w', encoding='utf-8') as stream:
            yaml.dump(document, stream, Dumper=DUMPER, sort_keys=False, width=4000)
        os.chmod(temporary, 0o644)
        os.replace(temporary, name)
    except OSError as error:
        raise ModelFileError(f'{name}: {error.strerror}') from error


NOMINAL = 'nominal'
"""Name of the model of the setup's own geometry, given where a model file's path may stand."""


def config_path(name: str) -> Path:
    """Return the path of a file: `name` itself, or else in `config/`; raises `SetupError`."""
    given = Path(name).expanduser()
    if given.exists():
        return given
    if given.name == name:
        for folder in Path(__file__).resolve().parents:
            for candidate in (folder / 'config', folder / 'share/anser_ros/config'):
                if (candidate / name).is_file():
                    return candidate / name
    raise SetupError(f'no file {name}, and none of that name among the files of config/')


def read_config(name: str) -> str:
    """Return the text of a file that `config_path` finds; raises `SetupError`."""
    return read_text(config_path(name), SetupError)
