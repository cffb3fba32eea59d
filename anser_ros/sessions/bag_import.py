"""Makes a session of somebody else's bag: topics renamed, a setup document added."""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from anser_ros.errors import BagError, ParameterError
from anser_ros.wire import cdr
from anser_ros.wire.bag import Salvage
from anser_ros.wire.foreign_bag import read_foreign
from anser_ros.wire.session_writer import SETUP_TYPE, SessionWriter
from anser_ros.wire.setup import parse_setup


@dataclass(frozen=True)
class ImportedBag:
    """Holds how many messages each topic got, and how many were left out, by topic and type.

    What is left out has no known definition; ``lost`` says in words what could not be read.
    """

    messages: dict[str, int]
    left_out: dict[str, int]
    lost: str


def parse_remaps(entries: Sequence[str]) -> dict[str, str]:
    """Return new names by old ones from entries ``FROM:=TO``.

    Raises
    ------
    ParameterError
        When an entry is not of that form, a name is not absolute, or one is renamed twice.
    """
    names: dict[str, str] = {}
    for entry in entries:
        old, _, new = entry.partition(':=')
        if not old.startswith('/') or not new.startswith('/') or old in names:
            raise ParameterError(f'a new name must be /FROM:=/TO, each once, got {entry!r}')
        names[old] = new
    return names


def import_bag(
    path: str | os.PathLike[str],
    out: Path,
    remaps: Mapping[str, str] | None = None,
    setup_text: str | None = None,
) -> ImportedBag:
    """Write the messages of any ROS 2 bag as one MCAP file that every command reads.

    ``remaps`` are new names of topics; a setup document's text is written at the start, in place
    of any in the bag.

    Raises
    ------
    BagError
        When the bag cannot be read, has no message, or lacks a topic that is to be renamed.
    SetupError
        When the text is not a setup document.
    """
    if setup_text is not None:
        parse_setup(setup_text)
    names, salvage = dict(remaps or {}), Salvage()
    written: Counter[str] = Counter()
    left_out: Counter[str] = Counter()
    types: dict[str, str] = {}
    seen: set[str] = set()
    with SessionWriter(out) as writer:
        for message in read_foreign(path, salvage):
            if setup_text is not None and not seen:
                writer.write_setup(setup_text, message.log_time_ns)
            seen.add(message.topic)
            topic, type_name = names.get(message.topic, message.topic), message.type_name
            is_setup = topic.endswith('/setup') and type_name == SETUP_TYPE
            if is_setup and setup_text is not None:
                continue
            if types.setdefault(topic, type_name) != type_name:
                clash = f'{topic} would have {types[topic]} and {type_name}'
                raise BagError(f'{os.fspath(path)}: {clash}')
            if type_name not in cdr.DEFINITIONS and not message.definition:
                left_out[f'{message.topic} ({type_name})'] += 1
                continue
            channel = writer.channel(topic, type_name, message.definition)
            writer.write(channel, message.log_time_ns, message.data)
            written[topic] += 1
        missing = sorted(set(names) - seen)
        if missing or not written:
            what = f'no topic {", ".join(missing)}; there are: {", ".join(sorted(seen))}'
            raise BagError(f'{os.fspath(path)}: {what if missing else "no message can be read"}')
    return ImportedBag(dict(written), dict(left_out), salvage.lost)
