"""Serves recorder and replay: message definitions, who listens, and what was recorded."""

import importlib
import json
import os
import re
import statistics
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import GetParameterTypes
from rclpy.node import Node

from anser_ros.errors import BagError
from anser_ros.wire.bag_writer import BagRecord

# What rosbag2 and mcap put between the definitions of a message and of its parts.
SEPARATOR = '=' * 80
# The integers of ROS's interface language.
NUMBERS = {f'{kind}{bits}' for kind in ('int', 'uint') for bits in (8, 16, 32, 64)}
PRIMITIVES = NUMBERS | {'bool', 'byte', 'char', 'float32', 'float64', 'string', 'wstring'}
FIELD = re.compile(r'^([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+\w+')


def message_class(type_name: str) -> type:
    """Return the class of a type such as ``std_msgs/msg/String``.

    Raises `BagError` where it is not installed.
    """
    package, kind, name = _split(type_name)
    try:
        found: type = getattr(importlib.import_module(f'{package}.{kind}'), name)
    except (ImportError, AttributeError) as error:
        raise BagError(f'type {type_name} is not installed') from error
    return found


def definition(type_name: str) -> str:
    """Return the text of a type followed by those of all types in it, as rosbag2 stores them.

    Raises `BagError` where a definition is not installed.
    """
    parts: list[str] = []
    names = [type_name]
    for current in names:  # which grows meanwhile
        text = _file(current, 'msg').read_text(encoding='utf-8')
        package, _, name = _split(current)
        title = f'{SEPARATOR}\nMSG: {package}/{name}\n' if parts else ''
        parts.append(title + text)
        inner = dict.fromkeys(_contained(text, package))
        names += [one for one in inner if one not in names]
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


REPLY_TIMEOUT_S = 2.0
"""Time, s, that a listener has for an answer before it is asked again."""
# A listener may be compiling its kernels.
ATTEMPTS = 30
# Fewest for one that has not answered yet: answers can miss a client that is new to the server.
FIRST_ATTEMPTS = 5
POLL_S = 0.1
"""How often a wait looks whether it was given up, s: a Ctrl-C takes so long."""
# How often the graph is asked for new listeners, in messages.
REFRESH_EVERY = 50


class Consumers:
    """Finds the nodes that subscribe to topics; the executor of the ``node`` that asks them must
    be spinning in another thread.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._clients: dict[str, Any] = {}
        self._listeners: dict[tuple[str, ...], set[str]] = {}
        self._silent: set[str] = set()
        self._answered: set[str] = set()
        self._calls = 0
        self._given_up = threading.Event()

    def wait(self, *topics: str, attempts: int = ATTEMPTS) -> None:
        """Wait until all listeners of the topics, by their full names, have handled what was
        published; after so many ``attempts`` to ask one it is gone on without it, after
        `FIRST_ATTEMPTS` at least where it has never answered.
        """
        if self._calls % REFRESH_EVERY == 0:
            self._listeners.clear()
        self._calls += 1
        if topics not in self._listeners:
            self._listeners[topics] = set().union(*map(self._find, topics))
        waiting = {name: self._ask(name) for name in self._listeners[topics]}
        for name, answered in waiting.items():
            patience = attempts if name in self._answered else max(attempts, FIRST_ATTEMPTS)
            if self._answers(name, answered, patience):
                self._answered.add(name)
            else:
                self._listeners[topics].discard(name)

    def give_up(self) -> None:
        """End every wait that is going on."""
        self._given_up.set()

    def _find(self, topic: str) -> set[str]:
        """Return the listeners that can be asked."""
        own = self._node.get_fully_qualified_name()
        found = set()
        for info in self._node.get_subscriptions_info_by_topic(topic):
            name = f'{info.node_namespace.rstrip("/")}/{info.node_name}'
            if name == own or name in self._silent:
                continue
            if name not in self._clients:
                service = f'{name}/get_parameter_types'
                self._clients[name] = self._node.create_client(GetParameterTypes, service)
            if self._clients[name].wait_for_service(REPLY_TIMEOUT_S):
                found.add(name)
            else:  # a listener without parameters can't be asked
                self._silent.add(name)
        return found

    def _ask(self, name: str) -> threading.Event:
        answered = threading.Event()
        future = self._clients[name].call_async(GetParameterTypes.Request())
        future.add_done_callback(lambda _future: answered.set())
        return answered

    def _answers(self, name: str, answered: threading.Event, attempts: int) -> bool:
        """Wait for a listener's answer; it is asked again, for an answer can miss a new client."""
        for _ in range(attempts):
            end_s = time.monotonic() + REPLY_TIMEOUT_S
            while time.monotonic() < end_s:
                if answered.wait(POLL_S):
                    return True
                # One that the graph does not know now is looked for again with the others.
                if self._given_up.is_set() or not self._clients[name].service_is_ready():
                    return False
            answered = self._ask(name)
        self._silent.add(name)
        self._node.get_logger().warning(f'{name} does not answer; going on without it')
        return False


# Intervals from which a topic's own period is learnt.
LEARNING = 25
# An interval of more than so many usual ones is a gap: less than the two of one lost message.
GAP_FACTOR = 1.5


@dataclass
class TopicLog:
    """Records what arrived of one topic."""

    n_publishers: int = 1  # how many nodes publish it
    # messages that the publisher numbered and that never came; known while there is only one
    lost: int = 0
    gaps: int = 0  # intervals between stamps longer than one and a half of the topic's usual ones
    longest_gap_s: float = 0.0
    jumps_back: int = 0  # stamps that lie before the one that came before them
    _sequence: int | None = None
    _stamp_ns: int | None = None
    _intervals_s: list[float] = field(default_factory=list)
    _period_s: float = 0.0

    @property
    def faults(self) -> str:
        """Return what is wrong with the topic, in words; empty when nothing is."""
        gaps = f'{self.gaps} gaps up to {self.longest_gap_s:.3g} s'
        found = [f'{self.lost} lost', gaps, f'{self.jumps_back} jumps back in time']
        return ', '.join(words for words in found if not words.startswith('0 '))

    def publishers(self, count: int) -> None:
        """Note how many publish the topic now."""
        self.n_publishers = max(self.n_publishers, count)

    def add(self, sequence: int | None, stamp_ns: int | None) -> None:
        """Note one message by its publisher's number and its stamp, where it has them."""
        if sequence is not None and self.n_publishers == 1:
            # A smaller number is a publisher that was started again.
            if self._sequence is not None and sequence > self._sequence + 1:
                self.lost += sequence - self._sequence - 1
            self._sequence = sequence
        if stamp_ns is not None:
            if self._stamp_ns is not None:
                self._add_interval((stamp_ns - self._stamp_ns) * 1e-9)
            self._stamp_ns = stamp_ns

    def _add_interval(self, interval_s: float) -> None:
        if interval_s < 0.0:
            self.jumps_back += 1
            return
        self._intervals_s.append(interval_s)
        if not self._period_s:
            if len(self._intervals_s) < LEARNING:
                return
            self._period_s = statistics.median(self._intervals_s)
        gaps = [s for s in self._intervals_s if s > GAP_FACTOR * self._period_s]
        self.gaps += len(gaps)
        self.longest_gap_s = max(self.longest_gap_s, *gaps, 0.0)
        self._intervals_s.clear()


def report(
    folder: Path, record: BagRecord, logs: Mapping[str, TopicLog]
) -> tuple[str, tuple[str, ...]]:
    """Return the counts of a bag in one short line, and a line for each topic with faults."""
    text = (
        f'{folder}: {record.messages} messages of {len(record.topics)} topics '
        f'in {record.duration_s:.1f} s'
    )
    faulty = {name: log for name, log in sorted(logs.items()) if log.faults}
    if not faulty:
        return f'{text}; no gaps', ()
    found = [
        f'{sum(log.lost for log in faulty.values())} messages lost',
        f'{sum(log.gaps > 0 for log in faulty.values())} topics with gaps',
        f'{sum(log.jumps_back > 0 for log in faulty.values())} that jump back in time',
    ]
    words = ', '.join(word for word in found if not word.startswith('0 '))
    faults = tuple(f'{name} {log.faults}' for name, log in faulty.items())
    return f'{text}; {words} (named in the log)', faults
