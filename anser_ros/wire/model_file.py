"""Reads and writes model files, YAML text, as plain data (what it means is the field model's)."""

import os
import tempfile
from typing import Any

import yaml

from anser_ros.errors import ModelFileError
from anser_ros.wire.yaml_text import DUMPER, MOST_CHARACTERS, read_yaml


def read_document(path: str | os.PathLike[str]) -> Any:
    """Parse a model file; raises `ModelFileError` when it can't be read or is no YAML."""
    name = os.fspath(path)
    try:
        with open(name, encoding='utf-8') as stream:
            return read_yaml(stream.read(MOST_CHARACTERS + 1))
    except OSError as error:
        raise ModelFileError(f'{name}: {error.strerror}') from error
    except UnicodeError as error:
        raise ModelFileError(f'{name}: not a text: {error}') from error
    except (yaml.YAMLError, ValueError) as error:
        raise ModelFileError(f'{name}: not YAML: {" ".join(str(error).split())}') from error


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
