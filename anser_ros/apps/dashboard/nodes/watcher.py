"""Watches live for what a field model or a tracker of poses lacks; names it in /diagnostics."""

import queue
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from anser_ros import extensions
from anser_ros.apps.dashboard.watch import LIVE, Sighting, SlidingWindow, Watch
from anser_ros.errors import AnserError
from anser_ros.field.model import EffectRecord
from anser_ros.nodes.operator_words import (
    figures_of,
    findings_words,
    plain_text,
    title_of,
    titles_of,
)
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import from_file, optical_parameter, parameter
from anser_ros.nodes.runtime.process import main
from anser_ros.nodes.streams.clouds import read_frame
from anser_ros.nodes.streams.one_source import OneSource, sender_words, setup_source
from anser_ros.pose_states import TWO_SOURCES
from anser_ros.sessions.prepared import prepare
from anser_ros.sessions.session import empty_session, load_session
from anser_ros.sessions.starting_model import load_model, model_for
from anser_ros.stamps import stamp_of
from anser_ros.wire.cdr import PointCloud
from anser_ros.wire.recorded import optical_topic, pose_numbers
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import NOMINAL

POLL_S = 0.2
"""How often it is asked whether a look is due, s: far less than the time between looks."""
FILLED = 0.5
"""Share of the window that must be there before the first look."""
SILENCE_S = 2.0
"""Time without fluxes, s, after which the stream counts as silent and no look begins."""


@dataclass(frozen=True)
class WatcherParameters:
    model_file: str = parameter(
        NOMINAL,
        "the tracker's model: a file, or nominal for that of the setup's own geometry",
        live=True,
    )
    optical: str = optical_parameter()
    tracked_poses: tuple[str, ...] = parameter(
        (),
        'topics of tracked poses (PoseStamped); with these it diagnoses another tracker by '
        'its poses',
    )
    reference_pose: str = parameter(
        '',
        'with tracked_poses: topic of the reference; none to compare the sensors with each other',
    )
    baseline_file: str = parameter(
        '', 'distortion-free recording of the same board; without one the references are not used'
    )
    window_s: float = parameter(
        20.0, 'length of the stretch that it diagnoses, s', within=(5.0, 120.0)
    )
    frames: int = parameter(100, 'flux frames of it that are used', within=(40, 400))
    period_s: float = parameter(
        5.0, 'shortest time from one diagnosis to the next, s', within=(0.1, 600.0), live=True
    )
    cpu_share: float = parameter(
        0.2, 'largest share of one processor on average', within=(0.01, 1.0), live=True
    )


class Streams(Protocol):
    """States what a watcher looks at: streams into a window, and who looks at the window.

    `FluxStreams` are those of this package's own fluxes; others are an application's.
    """

    WHAT: str  # what comes, in a word
    sources: list[OneSource]
    received_s: float  # when the last of it came, by the monotonic clock
    window: Any  # has ``span_s`` and ``restarts``; None before anything can be taken
    watch: Any  # has ``searches``; another one where all begins again

    def quiet_topics(self) -> tuple[str, ...]: ...
    def look(self) -> Callable[[], Any] | None:
        """Return what looks at the window as it is now; None where that has too little."""

    def words(self, seen: Any) -> str: ...
    def values(self, seen: Any) -> dict[str, object]: ...
    def on_parameters(self, old: WatcherParameters, new: WatcherParameters) -> None: ...


class FluxStreams:
    """Takes the fluxes of a setup's sensors and the optical poses of its bodies."""

    WHAT = 'fluxes'

    def __init__(self, node: 'Watcher', table: WatcherParameters) -> None:
        self._node = node
        from_file('model_file', table.model_file, load_model)  # refused now, not when fluxes come
        self._baseline_bag = from_file('baseline_file', table.baseline_file, load_session)
        self._setup_text = self._offered = ''
        self.window: SlidingWindow | None = None
        self.watch: Watch | None = None
        self.received_s = 0.0
        self._pose_subscriptions: dict[str, Any] = {}
        self.sources = [setup_source(node, self.on_setup)] + [
            OneSource(node, PointCloud2, topic, partial(self.on_fluxes, topic), qos.STREAM)
            for topic in ('tool/flux', 'reference/flux')
        ]

    def on_setup(self, message: String) -> None:
        if message.data == self._setup_text:
            return
        self._offered = message.data
        try:
            self._begin(message.data)
        except AnserError as error:
            self._node.refuse('setups_refused', error)

    def on_parameters(self, old: WatcherParameters, new: WatcherParameters) -> None:
        if old.model_file != new.model_file and self._offered:
            self._begin(self._offered)

    def _begin(self, text: str) -> None:
        """Watch what a setup's fluxes say, from an empty window on.

        Raises `AnserError` when the text is not a setup, or model or baseline do not fit it.
        """
        setup, table = parse_setup(text), self._node.parameters
        name = from_file('model_file', table.model_file, str, NOMINAL)
        # An empty window has a session's setup already, and a model must fit that.
        empty = empty_session(setup, LIVE)
        prepared = prepare(empty, model_for(name, empty), self._baseline_bag)
        self._setup_text = text
        self.window = SlidingWindow(setup, table.window_s, table.frames)
        self.watch = Watch(prepared)
        self._node.forget()
        for body in setup.bodies:
            if body not in self._pose_subscriptions:
                topic, take = optical_topic(body, table.optical), partial(self._on_optical, body)
                self._pose_subscriptions[body] = self._node.create_subscription(
                    PoseStamped, topic, take, qos.OTHERS
                )

    def _on_optical(self, body: str, message: PoseStamped) -> None:
        if self.window is not None:
            self.window.take_pose(body, stamp_of(message), pose_numbers(message.pose))

    def on_fluxes(self, topic: str, message: PointCloud) -> None:
        window = self.window
        if window is None:
            return
        fluxes = window.tool if topic == 'tool/flux' else window.reference
        try:
            window.take(fluxes, *read_frame(message, window.setup.frame_id, self._node.count))
            self.received_s = time.monotonic()
            self._node.count('frames')
        except AnserError as error:
            self._node.refuse('fluxes_refused', error)

    def quiet_topics(self) -> tuple[str, ...]:
        """Return none: silence is that of all fluxes."""
        return ()

    def look(self) -> Callable[[], Sighting] | None:
        session = None if self.window is None else self.window.session()
        if session is None or self.watch is None or self.window is None:
            return None
        return partial(self.watch.look, session, self.window.first_ns)

    def words(self, seen: Sighting) -> str:
        size = (
            f'residual {1e12 * seen.flux_rms_t:.0f} pT, {seen.excess**0.5:.1f} x the expected one'
        )
        if seen.findings:
            left = f'{seen.excess_left**0.5:.1f} x with it corrected'
            return f'{findings_words(seen.findings)}; {size}, {left}'
        if seen.is_clear:
            return f'nothing found; {size}'
        cause = seen.remark or 'no known effect explains it'
        depends = f', it depends on {", ".join(seen.depends_on)}' if seen.depends_on else ''
        return f'{size}; {cause}{depends}'

    def values(self, seen: Sighting) -> dict[str, object]:
        return {
            'compared_with': seen.truth,
            'frames_compared': seen.frames,
            'flux_rms_t': seen.flux_rms_t,
            'excess': seen.excess,
            'excess_left': seen.excess_left,
            'findings': titles_of(seen.findings),
            'depends_on': ', '.join(seen.depends_on),
        }


class Watcher(AnserNode):
    """Subscribes to fluxes and optical poses, or to the tracked poses that are named and a
    reference's, and publishes ``/diagnostics`` alone.

    The diagnosis runs in a thread, which pauses after each run to keep to its share of the
    processor.
    """

    NAME = 'watcher'
    EXAMPLE = '--ros-args -p model_file:=config/demo_model.yaml -p window_s:=20.0'
    PARAMETERS = WatcherParameters
    HAS_KERNELS = True

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._seen: Any = None
        self._known: dict[str, EffectRecord] = {}
        self._next_s = self._look_s = 0.0
        self._busy = False
        # What looks, and by whose watch; None at the end.
        self._tasks: queue.SimpleQueue[tuple[Any, Callable[[], Any]] | None] = queue.SimpleQueue()
        table = self.parameters
        asked = extensions.loaded('STREAMS', lambda name: getattr(table, name))
        self._streams: Streams = next((make(self, table) for make in asked), None) or FluxStreams(
            self, table
        )
        self.create_timer(POLL_S, self._begin_look, clock=self.steady_clock)
        work = self._guard(self._take_look)
        self._thread = threading.Thread(target=self._work, args=(work,), daemon=True)
        self._thread.start()

    def forget(self) -> None:
        """Forget what was found: something else is watched from now on."""
        self._trouble.forget()
        self._seen, self._known = None, {}

    def on_parameters(self, old: WatcherParameters, new: WatcherParameters) -> None:
        self._streams.on_parameters(old, new)

    # Looking ------------------------------------------------------------------------------

    def _begin_look(self) -> None:
        """Hand the window to the thread when it is due and the thread is free."""
        now_s, streams = time.monotonic(), self._streams
        if self._busy or streams.watch is None or now_s < self._next_s:
            return
        if streams.window.span_s < FILLED * self.parameters.window_s or self._is_silent(now_s):
            return
        look = streams.look()
        if look is not None:
            self._busy = True
            self._next_s = now_s + self.parameters.period_s
            self._tasks.put((streams.watch, look))

    def _work(self, take_look: Callable[[Any, Callable[[], Any]], None]) -> None:
        while (task := self._tasks.get()) is not None:
            began_s = time.thread_time()
            take_look(*task)
            self._look_s = time.thread_time() - began_s
            rest_s = self._look_s * (1.0 / self.parameters.cpu_share - 1.0)
            self._next_s = max(self._next_s, time.monotonic() + rest_s)
            self._busy = False

    def _take_look(self, watch: Any, look: Callable[[], Any]) -> None:
        self.count('looks')
        try:
            seen = look()
        except AnserError as error:
            self.refuse('looks_refused', error)
            self._seen = None
            return
        if watch is self._streams.watch:
            self._trouble.forget()
            self._seen = seen
            self._known |= {title_of(record): record for record in seen.findings}

    def close(self) -> None:
        self._tasks.put(None)

    # What is reported ---------------------------------------------------------------------

    def _is_silent(self, now_s: float) -> bool:
        return now_s - self._streams.received_s > SILENCE_S

    def status(self) -> Status:
        streams, seen = self._streams, self._seen
        values: dict[str, object] = {
            'look_cpu_s': self._look_s,
            'last_refusal': self._trouble.last,
        }
        conflict = sender_words(streams.sources)
        if conflict:
            return Status('', Level.ERROR, f'{TWO_SOURCES}: {conflict}', values)
        if streams.window is None or streams.watch is None:
            return Status('', Level.WARN, self._trouble.last or 'no setup yet', values)
        values |= {'searches': streams.watch.searches, 'restarts': streams.window.restarts}
        if self._is_silent(time.monotonic()):
            return Status('', Level.WARN, f'no {streams.WHAT}', values)
        quiet = streams.quiet_topics()
        if quiet:
            return Status('', Level.WARN, f'no {streams.WHAT} on {", ".join(quiet)}', values)
        if seen is None:
            state = f'collecting data, {streams.window.span_s:.0f} s so far'
            return Status('', Level.OK, self._trouble.last or state, values)
        level = Level.OK if seen.is_clear else Level.WARN
        return Status('', level, streams.words(seen), values | streams.values(seen))

    def part_statuses(self) -> list[Status]:
        """Return a line for everything that was found since the setup came."""
        there = [] if self._seen is None else [title_of(one) for one in self._seen.findings]
        statuses = []
        for title, record in self._known.items():
            if title not in there:
                statuses.append(Status(title, Level.OK, 'gone'))
                continue
            sigmas = {f'{key}_sigma': value for key, value in record.uncertainty.items()}
            found = {**record.parameters, **sigmas, **record.evidence}
            values = {key: plain_text(value) for key, value in found.items()}
            statuses.append(Status(title, Level.WARN, figures_of(record), values))
        return statuses


if __name__ == '__main__':
    sys.exit(main(Watcher))
