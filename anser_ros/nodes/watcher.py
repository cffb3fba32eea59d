"""Watches live for what a field model or a tracker of poses lacks; names it in /diagnostics."""

import queue
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from anser_ros.errors import AnserError
from anser_ros.field.model import EffectRecord
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import parameter
from anser_ros.nodes.runtime.process import main
from anser_ros.nodes.runtime.shared_names import optical_parameter
from anser_ros.nodes.runtime.stated_parameters import stated, stated_by
from anser_ros.nodes.streams.flux_reader import read_frame
from anser_ros.nodes.streams.one_source import OneSource, sender_words, setup_source
from anser_ros.nodes.watcher_parts.pose_streams import PoseStreams, pose_values, pose_words
from anser_ros.nodes.watcher_parts.sighting_words import (
    figures_of,
    plain_text,
    title_of,
    values_of,
    words_of,
)
from anser_ros.pose_states import TWO_SOURCES
from anser_ros.poses.live_look import PoseSighting, PoseWatch
from anser_ros.poses.live_window import PoseWindow
from anser_ros.poses.sequence import PoseSession
from anser_ros.sessions.model_file import load_model
from anser_ros.sessions.prepared import prepare
from anser_ros.sessions.session import Session, empty_session, load_session
from anser_ros.sessions.sliding_window import LIVE, SlidingWindow
from anser_ros.sessions.starting_model import NOMINAL, model_for
from anser_ros.sessions.watch import Sighting, Watch
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.pose_topics import optical_topic
from anser_ros.wire.setup import parse_setup

POLL_S = 0.2
"""How often it is asked whether a look is due, s: far less than the time between looks."""
FILLED = 0.5
"""Share of the window that must be there before the first look."""
SILENCE_S = 2.0
"""Time without fluxes, s, after which the stream counts as silent and no look begins."""


@dataclass(frozen=True)
class WatcherParameters:
    """Holds the parameters of the watcher."""

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
        20.0, 'length of the stretch that it diagnoses, s', minimum=5.0, maximum=120.0
    )
    frames: int = parameter(100, 'flux frames of it that are used', minimum=40, maximum=400)
    period_s: float = parameter(
        5.0,
        'shortest time from one diagnosis to the next, s',
        minimum=0.1,
        maximum=600.0,
        live=True,
    )
    cpu_share: float = parameter(
        0.2, 'largest share of one processor on average', minimum=0.01, maximum=1.0, live=True
    )
    flux_noise_t: float = stated('flux_noise_t')
    optical_position_m: float = stated('optical_position_m')
    optical_rotation_rad: float = stated('optical_rotation_rad')
    reference_position_m: float = stated('reference_position_m')
    reference_axis_rad: float = stated('reference_axis_rad')
    reference_gain: float = stated('reference_gain')


@dataclass(frozen=True)
class Task:
    """States what one look is at, and with whom."""

    watch: Watch | PoseWatch
    session: Session | PoseSession
    first_ns: int


class Watcher(AnserNode):
    """Subscribes to fluxes and optical poses, and publishes ``/diagnostics`` alone.

    If topics of tracked poses are named, it uses these and a reference's, and no fluxes. The
    diagnosis runs in a separate thread, which pauses after each run to keep to its share of the
    processor.
    """

    NAME = 'watcher'
    EXAMPLE = '--ros-args -p model_file:=config/demo_model.yaml -p window_s:=20.0'
    PARAMETERS = WatcherParameters
    HAS_KERNELS = True

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        table = self.parameters
        self._stated = stated_by(table)
        if not table.tracked_poses and table.model_file != NOMINAL:
            load_model(table.model_file)  # refused now, not when fluxes come
        self._baseline_bag = load_session(table.baseline_file) if table.baseline_file else None
        self._setup_text = self._offered = ''
        self._window: SlidingWindow | PoseWindow | None = None
        self._watch: Watch | PoseWatch | None = None
        self._sighting: Sighting | PoseSighting | None = None
        self._trouble = ''
        self._known: dict[str, EffectRecord] = {}
        self._pose_subscriptions: dict[str, Any] = {}
        self._received_s = 0.0
        self._next_s = 0.0
        self._look_s = 0.0
        self._busy = False
        self._tasks: queue.SimpleQueue[Task | None] = queue.SimpleQueue()
        self._poses: PoseStreams | None = None
        if table.tracked_poses:
            self._poses = PoseStreams(
                self, table.tracked_poses, table.reference_pose, table.window_s
            )
            self._window, self._watch = self._poses.window, PoseWatch()
            self._sources = self._poses.sources
        else:
            self._sources = [
                setup_source(self, self._on_setup),
                OneSource(self, PointCloud2, 'tool/flux', self._on_tool, qos.STREAM),
                OneSource(self, PointCloud2, 'reference/flux', self._on_reference, qos.STREAM),
            ]  # fmt: skip
        self.create_timer(POLL_S, self._begin_look, clock=self.steady_clock)
        work = self._guard(self._take_look)
        self._thread = threading.Thread(target=self._work, args=(work,), daemon=True)
        self._thread.start()

    # What is subscribed to ----------------------------------------------------------------

    def _on_setup(self, message: String) -> None:
        if message.data == self._setup_text:
            return
        self._offered = message.data
        try:
            self._begin(message.data)
        except AnserError as error:
            self._refuse('setups_refused', error)

    def on_parameters(self, old: WatcherParameters, new: WatcherParameters) -> None:
        """Start again with another model."""
        if old.model_file != new.model_file and self._offered:
            self._begin(self._offered)

    def _begin(self, text: str) -> None:
        """Watch what a setup's fluxes say, from an empty window on.

        Raises `AnserError` when the text is not a setup, or model or baseline do not fit it.
        """
        setup = parse_setup(text).with_stated(self._stated)
        # An empty window has a session's setup already, and a model must fit that.
        empty = empty_session(setup, LIVE)
        model = model_for(self.parameters.model_file, empty)
        prepared = prepare(empty, model, self._baseline_bag)
        self._setup_text, self._trouble = text, ''
        self._window = SlidingWindow(setup, self.parameters.window_s, self.parameters.frames)
        self._watch = Watch(prepared)
        self._sighting, self._known = None, {}
        for body in setup.bodies:
            if body not in self._pose_subscriptions:
                self._pose_subscriptions[body] = self.create_subscription(
                    PoseStamped,
                    optical_topic(body, self.parameters.optical),
                    self._taker(body),
                    qos.STREAM,
                )

    def _taker(self, body: str) -> Callable[[PoseStamped], None]:
        def take(message: PoseStamped) -> None:
            if isinstance(self._window, SlidingWindow):
                p, q = message.pose.position, message.pose.orientation
                stamp = message.header.stamp
                pose = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
                self._window.take_pose(body, stamp.sec * SECOND_NS + stamp.nanosec, pose)

        return take

    def _on_tool(self, message: PointCloud2) -> None:
        if isinstance(self._window, SlidingWindow):
            self._take(message, self._window, self._window.take_tool)

    def _on_reference(self, message: PointCloud2) -> None:
        if isinstance(self._window, SlidingWindow):
            self._take(message, self._window, self._window.take_reference)

    def _take(
        self, message: PointCloud2, window: SlidingWindow, take: Callable[..., None]
    ) -> None:
        try:
            take(*read_frame(message, window.setup.frame_id, self.count))
        except AnserError as error:
            self._refuse('fluxes_refused', error)
            return
        self._received_s = time.monotonic()
        self.count('frames')

    def _refuse(self, counter: str, error: AnserError) -> None:
        self._trouble = str(error)
        self.warn(counter, str(error))

    # Looking ------------------------------------------------------------------------------

    def _begin_look(self) -> None:
        """Hand the window to the thread when it is due and the thread is free."""
        now_s, window, watch = time.monotonic(), self._window, self._watch
        if self._busy or window is None or watch is None or now_s < self._next_s:
            return
        if window.span_s < FILLED * self.parameters.window_s or self._is_silent(now_s):
            return
        session = window.session() if self._poses is None else self._poses.session()
        if session is not None:
            self._busy = True
            self._next_s = now_s + self.parameters.period_s
            self._tasks.put(Task(watch, session, window.first_ns))

    def _work(self, take_look: Callable[[Task], None]) -> None:
        while (task := self._tasks.get()) is not None:
            began_s = time.thread_time()
            take_look(task)
            self._look_s = time.thread_time() - began_s
            rest_s = self._look_s * (1.0 / self.parameters.cpu_share - 1.0)
            self._next_s = max(self._next_s, time.monotonic() + rest_s)
            self._busy = False

    def _take_look(self, task: Task) -> None:
        self.count('looks')
        try:
            sighting = _look(task)
        except AnserError as error:
            self._refuse('looks_refused', error)
            self._sighting = None
            return
        if task.watch is self._watch:
            self._trouble = ''
            self._sighting = sighting
            self._known |= {title_of(record): record for record in sighting.findings}

    def close(self) -> None:
        """End the thread after the look that it is at."""
        self._tasks.put(None)

    # What is reported ---------------------------------------------------------------------

    def _is_silent(self, now_s: float) -> bool:
        received_s = self._received_s if self._poses is None else self._poses.received_s
        return now_s - received_s > SILENCE_S

    def status(self) -> Status:
        """Return what is there, in one line, with its figures."""
        window, seen = self._window, self._sighting
        values: dict[str, object] = {'look_cpu_s': self._look_s, 'last_refusal': self._trouble}
        conflict = sender_words(self._sources)
        if conflict:
            return Status('', Level.ERROR, f'{TWO_SOURCES}: {conflict}', values)
        if window is None or self._watch is None:
            return Status('', Level.WARN, self._trouble or 'no setup yet', values)
        values |= {'searches': self._watch.searches, 'restarts': window.restarts}
        if self._is_silent(time.monotonic()):
            what = 'fluxes' if self._poses is None else 'poses'
            return Status('', Level.WARN, f'no {what}', values)
        quiet = () if self._poses is None else self._poses.quiet_topics()
        if quiet:
            return Status('', Level.WARN, f'no poses on {", ".join(quiet)}', values)
        if seen is None:
            state = self._trouble or f'collecting data, {window.span_s:.0f} s so far'
            return Status('', Level.OK, state, values)
        values |= pose_values(seen) if isinstance(seen, PoseSighting) else values_of(seen)
        words = pose_words(seen) if isinstance(seen, PoseSighting) else words_of(seen)
        return Status('', Level.OK if seen.is_clear else Level.WARN, words, values)

    def part_statuses(self) -> list[Status]:
        """Return a line for everything that was found since the setup came."""
        seen = self._sighting
        there = {} if seen is None else {title_of(record): record for record in seen.findings}
        statuses = []
        for title, record in self._known.items():
            if title in there:
                record = there[title]
                values = {
                    **{key: plain_text(value) for key, value in record.parameters.items()},
                    **{f'{k}_sigma': plain_text(value) for k, value in record.uncertainty.items()},
                    **{key: plain_text(value) for key, value in record.evidence.items()},
                }
                statuses.append(Status(title, Level.WARN, figures_of(record), values))
            else:
                statuses.append(Status(title, Level.OK, 'gone'))
        return statuses


def _look(task: Task) -> Sighting | PoseSighting:
    """Look at a window as its kind of watch does."""
    if isinstance(task.watch, PoseWatch):
        assert isinstance(task.session, PoseSession)
        return task.watch.look(task.session)
    assert isinstance(task.session, Session)
    return task.watch.look(task.session, task.first_ns)


if __name__ == '__main__':
    sys.exit(main(Watcher))
