"""Publishes a bag again with its own stamps, as far as it reads."""

import argparse
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import yaml
from rcl_interfaces.srv import GetParameterTypes
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock

from anser_ros.errors import AnserError, BagError, ParameterError
from anser_ros.nodes.recorder import message_class
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import optical_parameter, parameter
from anser_ros.nodes.runtime.process import main
from anser_ros.nodes.streams.readiness import Readiness
from anser_ros.stamps import set_stamp
from anser_ros.wire.bag import RawMessage, Salvage, iter_messages
from anser_ros.wire.recorded import OPTICAL
from anser_ros.wire.text_files import read_yaml

REPLY_TIMEOUT_S = 2.0
"""Time, s, that a listener has for an answer before it is asked again."""
# A listener may be compiling its kernels.
ATTEMPTS = 30
# Fewest for one that has not answered yet: answers can miss a client that is new to the server.
FIRST_ATTEMPTS = 5
ANSWER_POLL_S = 0.1
"""How often a wait looks whether it was given up, s: a Ctrl-C takes so long."""
# How often the graph is asked for new listeners, in messages.
REFRESH_EVERY = 50


class Consumers:
    """Finds the nodes that subscribe to topics; the executor of the ``node`` that asks them must
    be spinning in another thread. All waits end when ``ending`` is set.
    """

    def __init__(self, node: Node, ending: threading.Event) -> None:
        self._node, self._ending = node, ending
        self._clients: dict[str, Any] = {}
        self._listeners: dict[tuple[str, ...], set[str]] = {}
        self._silent: set[str] = set()
        self._answered: set[str] = set()
        self._calls = 0

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

    def _find(self, topic: str) -> set[str]:
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
                if answered.wait(ANSWER_POLL_S):
                    return True
                # One that the graph does not know now is looked for again with the others.
                if self._ending.is_set() or not self._clients[name].service_is_ready():
                    return False
            answered = self._ask(name)
        self._silent.add(name)
        self._node.get_logger().warning(f'{name} does not answer; going on without it')
        return False


BAG_NAMESPACE = '/anser/'
FLUX_ENDINGS = ('/tool/flux', '/reference/flux')
# What the nodes that listen will publish themselves.
OUTPUT_ENDINGS = ('/pose', '/pose_with_covariance', '/field_model')
OUTPUT_TOPICS = ('/diagnostics', '/tf', '/tf_static', '/clock')
# How long listeners are waited for, s, before the bag is played without them.
WAIT_S = 30.0
# A node that is there and starting, and may compile its kernels, is given so many times that.
STARTING_FACTOR = 5.0
# How often a paused or waiting replay looks whether it may go on, s.
POLL_S = 0.05
# Who is waited for is said after so long.
REPORT_AFTER_S = 3.0
# Time of the recording between two messages on /clock, ns: half a window at 50 Hz.
CLOCK_PERIOD_NS = 10_000_000
# How long listeners have to acknowledge the first and the last messages, s.
LONGEST_ACK_S = 5.0
# How often a silent listener of poses is asked again: fewer times than one of fluxes, for it is
# asked after every frame.
ATTEMPTS_OF_LISTENERS = 2


@dataclass(frozen=True)
class ReplayParameters:
    """Holds the parameters of the replay: what two of them on one graph must not share."""

    optical: str = optical_parameter()
    clock: str = parameter('/clock', 'topic of the time in the bag')


class Replay(AnserNode):
    """Plays one bag in a thread of its own; the executor stays free for parameters and replies.

    A rate of 0 is as fast as the listeners take it. With ``all_topics``, topics that running nodes
    publish themselves (poses, model, diagnostics) are played too. Raises `ParameterError`: the
    rate or the wait is negative, and `BagError`: there is no such bag, or nothing of it can be
    read.
    """

    NAME = 'replay'
    EXAMPLE = 'bags/moving.mcap --rate 0.5'
    PARAMETERS = ReplayParameters

    @classmethod
    def add_arguments(cls, parser: argparse.ArgumentParser) -> None:
        parser.add_argument('bag', help='the .mcap file, or the folder that holds it')
        words = 'speed; 0: as fast as the subscribers take it'
        parser.add_argument('--rate', type=float, default=1.0, help=words)
        parser.add_argument('--loop', action='store_true', help='begin again at the end')
        words = 'poses and diagnostics as well'
        parser.add_argument('--all', dest='all_topics', action='store_true', help=words)
        parser.add_argument(
            '--wait', type=float, default=WAIT_S,
            help='longest wait for subscribers, s (%(default)g, and up to five times that before '
            'while a node is still starting): replay begins when all nodes that use the '
            'fluxes are ready and all subscribers to fluxes and poses are connected, but '
            'not in the first 3 s; who subscribes later misses what was published before',
        )  # fmt: skip

    def __init__(
        self,
        bag: str,
        rate: float = 1.0,
        loop: bool = False,
        all_topics: bool = False,
        wait: float = WAIT_S,
        **options: Any,
    ) -> None:
        if not 0.0 <= rate < float('inf'):
            raise ParameterError(f'rate {rate} is neither 0 nor a positive number')
        if not wait >= 0.0:
            raise ParameterError(f'wait {wait} is negative')
        super().__init__(**options)
        self._bag, self._rate, self._loop, self._all_topics = bag, rate, loop, all_topics
        self._wait_s = wait
        self._outlets: dict[str, Any] = {}
        self._latched: dict[str, RawMessage] = {}
        self._total = self._done = self._passes = 0
        self._lost = ''
        self._poses: list[str] = []
        self._ending = threading.Event()
        self._scan()
        self._ticks = self.create_publisher(Clock, self.parameters.clock, qos.STREAM)
        self._consumers = Consumers(self, self._ending)
        self._thread = threading.Thread(target=self._play_guarded, name='replay', daemon=True)
        self._thread.start()

    def status(self) -> Status:
        values = {'published': self._done, 'messages': self._total, 'passes': self._passes}
        if self._lost:
            return Status('', Level.WARN, f'replaying a damaged bag: {self._lost}', values)
        return Status('', Level.OK, 'replaying', values)

    def close(self) -> None:
        self._ending.set()
        self._thread.join(LONGEST_ACK_S)

    # Before playing -----------------------------------------------------------------------

    def _scan(self) -> None:
        """Read the bag once for its topics, so that all are announced before the first message."""
        salvage, counts = Salvage(), Counter[str]()
        firsts: dict[str, RawMessage] = {}
        for message in iter_messages(self._bag, salvage):
            if self._is_played(message.topic):
                counts[message.topic] += 1
                firsts.setdefault(message.topic, message)
        setups = [topic for topic in firsts if topic.endswith('/setup')]
        home = setups[0].removesuffix('setup') if setups else BAG_NAMESPACE
        for message in firsts.values():
            self._announce(message, home)
        wanted = any(topic.endswith(('/setup', *FLUX_ENDINGS)) for topic in self._outlets)
        if not wanted and not self._all_topics:
            raise BagError(f'{self._bag}: neither a setup nor fluxes that could be replayed')
        self._total = sum(counts[topic] for topic in self._outlets)
        self._lost = salvage.lost
        if self._lost:
            self.get_logger().warning(f'the bag is damaged: {self._lost}')
        self.get_logger().info(f'{self._total} messages of {len(self._outlets)} topics')

    def _is_played(self, topic: str) -> bool:
        if self._all_topics or OPTICAL in topic:
            return topic != '/clock'
        return topic not in OUTPUT_TOPICS and not topic.endswith(OUTPUT_ENDINGS)

    def _announce(self, message: RawMessage, home: str) -> None:
        try:
            kind = message_class(message.type_name)
        except AnserError as error:
            self.warn('topics_left_out', f'{message.topic}: {error}')
            return
        name = name_played(message.topic, home, self.parameters.optical)
        profile = qos.LATCHED if _is_latched(message) else qos.STREAM
        self._outlets[message.topic] = self.create_publisher(kind, name, profile)
        if profile is qos.LATCHED and _message_of(message, kind) is not None:
            self._latched[message.topic] = message

    def _wait_for_listeners(self) -> None:
        """Publish what nodes need before they can take fluxes, and wait until all who can be known
        to listen are ready, at most as long as wanted.
        """
        setup = ''
        for topic, message in self._latched.items():
            self._outlets[topic].publish(message.data)
            self._done += 1
            if topic.endswith('/setup'):
                setup = getattr(_message_of(message, self._outlets[topic].msg_type), 'data', '')
        fluxes = [o for t, o in self._outlets.items() if t.endswith(FLUX_ENDINGS)]
        readiness = Readiness(self, fluxes or list(self._outlets.values()), setup)
        self._poses = readiness.poses
        began_s = started_s = time.monotonic()
        reported = ''
        while not self._ending.wait(POLL_S):
            now_s, missing = time.monotonic(), readiness.missing()
            waited_s = now_s - began_s
            if not missing:
                break
            if readiness.is_starting and waited_s < STARTING_FACTOR * self._wait_s:
                started_s = now_s
            if now_s - started_s > self._wait_s:
                self.warn('no_listeners', f'begins after {waited_s:.3g} s although {missing}')
                break
            if waited_s > REPORT_AFTER_S and missing != reported:
                reported = missing
                self.get_logger().info(f'waits: {missing}')
        readiness.close()

    # Playing ------------------------------------------------------------------------------

    def _play_guarded(self) -> None:
        try:
            self._wait_for_listeners()
            while self._play_once():
                self._passes += 1
                if not self._loop:
                    break
                self._done = 0
            self._finish()
        except AnserError as error:
            self.get_logger().error(str(error))
            self.stop(2)
        except Exception:  # noqa: BLE001 - the outermost place of this thread
            if self.context.ok() and not self._ending.is_set():
                self.get_logger().error(f'replay failed\n{traceback.format_exc()}')
                self.stop(1)

    def _play_once(self) -> bool:
        """Play the bag from its begin; return whether it came to its end."""
        first_ns, began_s, clock_ns = None, time.monotonic(), 0
        given = dict(self._latched) if self._passes == 0 else {}
        begun: set[str] = set()
        for message in self._messages():
            if given.pop(message.topic, None) is not None:
                continue  # the first of a latched topic is out already
            now_ns = message.log_time_ns
            first_ns = now_ns if first_ns is None else first_ns
            if self._rate > 0.0:
                due_s = began_s + (now_ns - first_ns) * 1e-9 / self._rate
                # Waiting also ends when the node does.
                if self._ending.wait(max(due_s - time.monotonic(), 0.0)):
                    return False
            if now_ns - clock_ns >= CLOCK_PERIOD_NS or now_ns < clock_ns:
                clock_ns, tick = now_ns, Clock()
                set_stamp(tick.clock, now_ns)
                self._ticks.publish(tick)
            self._outlets[message.topic].publish(message.data)
            self._done += 1
            if self._rate == 0.0 and message.topic.endswith(FLUX_ENDINGS):
                if message.topic not in begun:
                    # A listener that is known here may not know of this publisher yet: it would
                    # answer, and get what it missed after more than its queue holds.
                    begun.add(message.topic)
                    self._acknowledged(message.topic)
                # Those who take fluxes, and those who take poses made of them, catch up. After
                # every frame: of several messages that wait an executor may have worked off one
                # when it answers.
                self._consumers.wait(self._outlets[message.topic].topic_name)
                if self._poses:
                    self._consumers.wait(*self._poses, attempts=ATTEMPTS_OF_LISTENERS)
        return not self._ending.is_set()

    def _acknowledged(self, topic: str) -> None:
        self._outlets[topic].wait_for_all_acked(Duration(seconds=LONGEST_ACK_S))

    def _messages(self) -> Iterator[RawMessage]:
        """Yield what can be published; bytes that are no message of their type are left out."""
        for message in iter_messages(self._bag, Salvage()):
            if self._ending.is_set():
                return
            outlet = self._outlets.get(message.topic)
            if outlet is None:
                continue
            if _message_of(message, outlet.msg_type) is None:
                self.warn('messages_left_out', f'{message.topic}: no {outlet.msg_type.__name__}')
                continue
            yield message

    def _finish(self) -> None:
        """Wait until all is received, and end the process."""
        for topic in self._outlets:
            if not self._ending.is_set():
                self._acknowledged(topic)
        left_out = self.counters['messages_left_out']
        played = f'{self._done} of {self._total} messages'
        if self._loop:  # in which every pass counts again
            played = f'the bag {self._passes} times, and {played} once more'
        played += f'; lost: {self._lost}' if self._lost else ''
        played += f'; {left_out} messages that do not decode left out' if left_out else ''
        self.get_logger().info(f'published {played}')
        self.stop(0)


def name_played(topic: str, home: str, optical: str) -> str:
    """Return the name that a bag's topic is played under.

    The player's namespace replaces ``home``, that of the bag's nodes with a slash at its end, and
    ``optical`` that of the bag's optical poses.
    """
    _, is_optical, rest = topic.partition(OPTICAL)
    if is_optical:
        return f'{optical.rstrip("/")}/{rest}'
    return topic.removeprefix(home) if home != '/' else topic


def _message_of(message: RawMessage, kind: type) -> Any:
    """Return the decoded message, or None where the bytes are not of that type."""
    try:
        return deserialize_message(message.data, kind)
    except Exception:  # noqa: BLE001 - rclpy names none that is narrower
        return None


def _is_latched(message: RawMessage) -> bool:
    """Return whether a topic was latched in the recording, or must be by docs/interfaces.md."""
    if message.topic.endswith(('/setup', '/field_model')):
        return True
    try:
        offered = read_yaml(message.channel.metadata.get('offered_qos_profiles', ''))
        return any(profile['durability'] in ('transient_local', 1) for profile in offered)
    except (yaml.YAMLError, TypeError, KeyError):
        return False


if __name__ == '__main__':
    sys.exit(main(Replay))
