"""Makes setup documents from plain data, YAML text or a file."""

import os
from collections.abc import Mapping
from typing import Any

import yaml

from anser_ros.errors import SetupError
from anser_ros.wire.setup import Setup, parse_setup
from anser_ros.wire.text_files import read_text

SetupSource = Setup | Mapping[str, Any] | str | os.PathLike[str]


def load_setup(source: SetupSource) -> Setup:
    """Check a setup document (``docs/setup.md`` explains every key).

    Parameters
    ----------
    source : Setup, mapping, str or path
        The document as plain data, as YAML text, or a `pathlib.Path` of a file that holds it.

    Raises
    ------
    SetupError
        With the rule that is broken and the key where it is, or when the file cannot be read.

    Examples
    --------
    >>> from pathlib import Path
    >>> from anser_ros import load_setup
    >>> setup = load_setup(Path('config/demo_setup.yaml'))
    >>> setup.bodies, len(setup.tool_sensors), len(setup.reference_sensors)
    (('tool_a',), 9, 32)
    """
    if isinstance(source, Setup):
        return source
    if isinstance(source, Mapping):
        return parse_setup(yaml.safe_dump(dict(source), sort_keys=False))
    if isinstance(source, str):
        return parse_setup(source)
    return parse_setup(read_text(source, SetupError))
