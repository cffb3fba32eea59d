"""Turns fluxes into poses of every tool sensor and rigid body, with covariance, state and reason.

A pose is published only in the state ``ok``; ``/diagnostics`` gives the reason for any other
state.
"""

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String

from anser_ros.chain.chain import AnsweredFrames
from anser_ros.chain.frame import ChainFrame, FrameReadings
from anser_ros.chain.tracking_half import TrackingHalf
from anser_ros.errors import AnserError
from anser_ros.field.model import FieldModel
from anser_ros.fingerprint import fingerprint_of
from anser_ros.nodes.pose_output import (
    PoseTopic,
    state_board,
    transform_message,
    transform_publisher,
)  # fmt: skip
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import (
    STALE_AFTER_S,
    from_file,
    from_text,
    parameter,
    prefix_parameter,
)  # fmt: skip
from anser_ros.nodes.runtime.process import main
from anser_ros.nodes.streams import one_source
from anser_ros.nodes.streams.clouds import GivenModel, read_frame, readings_of
from anser_ros.nodes.tracker_models import ModelIntake, ModelReader
from anser_ros.pose_states import OK, TWO_SOURCES, Withheld
from anser_ros.sessions.session import sensor_table, settings_for
from anser_ros.sessions.starting_model import check_emitters, load_model
from anser_ros.stamps import SECOND_NS, is_live
from anser_ros.tracking.estimate import NO_GATE, USUAL_GATE, PoseEstimate, Tip, TrackerSettings
from anser_ros.tracking.tracker import Tracker, warm_up
from anser_ros.wire.cdr import PointCloud
from anser_ros.wire.setup import Setup, parse_setup
from anser_ros.wire.setup_values import read_tips, tip_name


@dataclass(frozen=True)
class TrackerParameters:
    """Holds the parameters of the tracker."""

    model_file: str = parameter(
        '',
        'model whose effects are corrected, and whose field is used until field_model publishes '
        'one; empty or nominal for none',
        live=True,
    )
    tips_file: str = parameter(
        '', "tips.yaml of pivot, or a setup document, whose tips replace the setup's own"
    )
    frame_prefix: str = prefix_parameter()
    parent_frame: str = parameter(
        '', 'frame in which /tf_static states where the board is; empty: not stated', live=True
    )
    board_pose: tuple[float, ...] = parameter(
        (), "the board's pose in it: x y z, m, and quaternion x y z w", live=True
    )
    registration_file: str = parameter(
        '', 'handeye.json, or another file with board_pose, in place of that', live=True
    )
    allow_uncalibrated: bool = parameter(
        False, 'whether poses are given by the nominal model though field_model withholds them'
    )
    adaptive: bool = parameter(
        TrackerSettings.adaptive,
        'whether the noise follows the residuals of good poses',
        live=True,
    )
    gate: float = parameter(
        TrackerSettings.gate,
        'largest residual of a pose, in units of the expected one',
        within=(1.0, NO_GATE),
        live=True,
    )
    max_sigma_m: float = parameter(
        TrackerSettings.max_sigma_m,
        'largest uncertainty of a pose, m',
        within=(1e-5, 1.0),
        live=True,
    )
    stale_after_s: float = parameter(
        STALE_AFTER_S,
        'time without fluxes after which a sensor is stale, s',
        within=(0.02, math.inf),
        live=True,
    )
    model_wait_s: float = parameter(
        0.1,
        'longest time that a frame waits for its model while field_model refits, s',
        within=(0.0, 10.0),
        live=True,
    )
    publish_tf: bool = parameter(True, 'whether /tf is published where tf2_msgs is installed')


def settings_of(table: TrackerParameters) -> TrackerSettings:
    """Return settings of the core."""
    return TrackerSettings(adaptive=table.adaptive, gate=table.gate, max_sigma_m=table.max_sigma_m)


EARLIEST_DIAGNOSTICS_S = 0.1
"""Least time between two messages in /diagnostics that a changed state asks for, s: a state that
flickers from frame to frame must not flood the topic."""
WAIT_PERIOD_S = 0.02
"""How often, s, frames that wait for a model are looked at beside the arrival of models: how
inexact the parameter ``model_wait_s`` is."""
WIDE_GATE = 2.0 * USUAL_GATE
"""A gate that is wider than this is warned of: one that was opened for a trial."""


class TrackerNode(AnserNode):
    """Subscribes to ``setup``, ``field_model`` and ``tool/flux``; publishes poses.

    Where another node of the process has frames and models, it calls ``step`` and ``use``.
    """

    NAME = 'tracker'
    EXAMPLE = '--ros-args -p model_file:=config/demo_model.yaml'
    PARAMETERS = TrackerParameters
    HAS_KERNELS = True

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        table = self.parameters
        self._settings = settings_of(table)
        self._file_model = from_file('model_file', table.model_file, load_model)
        self._file_tips = from_text('tips_file', table.tips_file, read_tips, {})
        self._tips: dict[str, Tip] = {}
        self._setup_text = ''
        self._setup: Setup | None = None
        self._half: TrackingHalf | None = None
        self._reader: ModelReader | None = None
        self._topics: dict[str, PoseTopic] = {}
        self._intake = ModelIntake()
        self._given: GivenModel | None = None
        self.use, self.step = self.given(self._use_model), self.given(self._track)
        self._frames = AnsweredFrames(self)
        self._solve_s = self._diagnosed_s = 0.0
        self._counted = 0, 0
        self._model_age_ns = 0
        self._transforms = transform_publisher(self) if table.publish_tf else None
        self._board = state_board(self, None, table)
        warm_up()
        setups = one_source.setup_source(self, self._on_setup)
        # The executor takes topics in this order, so a model finds its uncertainty there.
        take_error = partial(self._take_model, self._intake.take_error)
        self.create_subscription(PointCloud2, 'field_model_error', take_error, qos.MODEL_ERRORS)
        take = partial(self._take_model, self._intake.take)
        self._models = one_source.OneSource(
            self, PointCloud2, 'field_model', take, qos.MODELS, lasting=self._lasting
        )
        self._fluxes = one_source.NewestSource(
            self,
            'tool/flux',
            self._on_flux,
            partial(self._on_flux, is_doubted=True),
            works_later=True,
        )
        self._sources = [setups, self._models, self._fluxes]
        self._wait = self.create_timer(WAIT_PERIOD_S, self._on_wait, clock=self.steady_clock)
        self._wait.cancel()

    # What is subscribed to ----------------------------------------------------------------

    def _on_setup(self, message: String) -> None:
        if message.data == self._setup_text:
            return
        try:
            setup = parse_setup(message.data)
            setup = setup.with_tips(self._file_tips)
            known = self._setup
            if known is not None and setup.follows_as(known) and setup.tips == known.tips:
                self._measure_anew(message.data, setup)
                return
            sensors = sensor_table(setup.tool_sensors)
            settings = settings_for(setup, self._settings, self._file_model)
            tracker = Tracker(None, sensors, settings)
            if self._file_model is not None:
                check_emitters(setup, self._file_model)
        except AnserError as error:
            self.refuse('setups_refused', error)
            return
        self._setup_text, self._setup = message.data, setup
        self._begin(setup, tracker)
        for topic in self._topics.values():
            topic.destroy(self)
        self._tips = {
            body: Tip(tip_name(body), np.array(tip.position_m), tip.covariance)
            for body, tip in setup.tips.items()
            if body in tracker.bodies
        }
        names = (*sensors.name, *tracker.bodies, *(tip.name for tip in self._tips.values()))
        self._topics = {
            name: PoseTopic(self, name, setup.frame_id, self.parameters.frame_prefix)
            for name in names
        }
        self._trouble.forget()
        self._use_model()

    def _measure_anew(self, text: str, setup: Setup) -> None:
        """Track on with another rate, noise and stamps' uncertainty: topics and model hold.

        To make them again takes 0.1 s, for which no frame would be tracked.
        """
        self._setup_text, self._setup = text, setup
        self._trouble.forget()
        if self._half is not None:
            same = replace(self._settings, volume=self._half.tracker.settings.volume)
            self._half.set_up(settings_for(setup, same, self._file_model))

    def _take_model(self, take: Callable[[Any], GivenModel | None], message: PointCloud) -> None:
        try:
            given = take(message)
        except AnserError as error:
            self.refuse('models_refused', error)
            return
        if given is not None:
            self._frames.follows = given.follows
            self._frames.add_answer(given, time.monotonic())

    def _begin(self, setup: Setup, tracker: Tracker) -> None:
        """Track the tools of a setup with the tracker's own model, until another one is used."""
        name, allowed = self.parameters.model_file, self.parameters.allow_uncalibrated
        self._reader = ModelReader(setup, self._file_model, name, allowed)
        self._half = TrackingHalf(tracker, setup.refit.references_age_s, self._reader.own)

    def _use_model(self, given: GivenModel | None = None, ahead: bool = False) -> None:
        """Use a model, else the last one or the tracker's own, once the setup is known too.

        One that is ``ahead`` is for the frame after its own.
        """
        half, reader = self._half, self._reader
        self._given = given = given or self._given
        if half is None or reader is None:
            return
        before = half.answer.model if given is not None else None
        try:
            answer = reader.own if given is None else reader.answer(given)
            if answer.model is not None:
                half.use(answer, ahead)
                self.count('models', answer.model is not before)
        except AnserError as error:
            self.refuse('models_refused', error)

    def _on_flux(self, message: PointCloud, is_doubted: bool = False) -> None:
        """Track a frame when its model is there, or after so long; say at once of one that may be
        another sender's why it has no poses.
        """
        setup, wait_s = self._setup, self.parameters.model_wait_s
        if setup is None:
            self.count('fluxes_before_setup')
            return
        try:
            stamp_ns, points = read_frame(message, setup.frame_id, self.count)
            frame = ChainFrame(stamp_ns, tools := readings_of(points), None)
        except AnserError as error:
            self.refuse('fluxes_refused', error)
            return
        if is_doubted:
            self._track(stamp_ns, tools)
            return
        lags = is_live(stamp_ns, time.time_ns())
        self._frames.add_frame(frame, time.monotonic(), wait_s, lags)
        if self._frames.waiting:
            self._wait.reset()

    def _lasting(self, message: PointCloud) -> bytes | None:
        """Return what a model says until there is another; None while each frame has its own."""
        return None if self._frames.follows else bytes(message.data.tobytes())

    def _on_wait(self) -> None:
        """Go on with frames whose model does not come."""
        self._frames.work(time.monotonic())
        if not self._frames.waiting:
            self._wait.cancel()

    def _track(self, stamp_ns: int, tools: FrameReadings) -> list[PoseEstimate]:
        """Track a frame with the active model, publish what is good, and return what is found."""
        half, begin_s = self._half, time.perf_counter()
        if half is None:
            self.count('fluxes_before_setup')
            return []
        conflict = one_source.sender_words(self._sources)
        if half.answer.follows:
            self._model_age_ns = max(self._model_age_ns, stamp_ns - half.answer.stamp_ns)
        try:
            doubt = Withheld(TWO_SOURCES, conflict) if conflict else None
            found = half.step(stamp_ns, tools, doubt)
        except AnserError as error:
            self.refuse('fluxes_refused', error)
            return []
        now_ns = self.get_clock().now().nanoseconds
        found += [self._tips[e.name].of_body(e) for e in found if e.name in self._tips]
        changed = self._publish([(self._topics[e.name], e) for e in found], now_ns)
        self.count('frames')
        self._solve_s = time.perf_counter() - begin_s
        self._fluxes.backlog.worked(self._solve_s)
        if changed and time.monotonic() - self._diagnosed_s > EARLIEST_DIAGNOSTICS_S:
            self.publish_diagnostics()
        return found

    def _publish(self, found: list[tuple[PoseTopic, PoseEstimate]], now_ns: int) -> bool:
        """Publish good poses first, then all else; return whether a state is another than before.

        ``now_ns`` is when they were found.
        """
        for topic, estimate in found:
            topic.publish(estimate)
        changed = [topic.note(estimate, now_ns) for topic, estimate in found]
        moved = [topic for topic, estimate in found if estimate.state == OK]
        tf = self._transforms
        if moved and tf is not None and tf.get_subscription_count():
            tf.publish(transform_message(moved, found[0][1].stamp_ns))
        return any(changed)

    # What is reported ---------------------------------------------------------------------

    def on_parameters(self, old: TrackerParameters, new: TrackerParameters) -> None:
        """Track on with the new settings or model, from where the tools were."""
        if old.model_file != new.model_file:
            self._exchange(from_file('model_file', new.model_file, load_model))
        self._board = state_board(self, self._board, new)
        self._settings = settings_of(new)
        if self._half is not None and self._setup is not None:
            self._half.set_up(settings_for(self._setup, self._settings, self._file_model))

    def _exchange(self, file_model: FieldModel | None) -> None:
        """Undo the effects of another model; until that is served too, state other_model."""
        setup = self._setup
        if setup is not None and file_model is not None:
            check_emitters(setup, file_model)
        self._file_model = file_model
        if setup is not None and self._half is not None:
            tracker = self._half.tracker
            if file_model is None and self._given is None:  # there is none any more
                tracker = Tracker(None, tracker.sensors, tracker.settings)
            self._begin(setup, tracker)
            self._use_model()

    def status(self) -> Status:
        """Return what the tracker lacks, if anything, and its counters."""
        self._diagnosed_s = time.monotonic()
        before = self._counted
        self._counted = skipped, frames = self.counters['frames_skipped'], self.counters['frames']
        slow = one_source.too_slow(skipped - before[0], frames - before[1])
        if slow:
            self.warn('seconds_too_slow', slow)
        half, newest = self._half, self._intake.newest or self._given
        tracker = None if half is None else half.tracker
        values: dict[str, object] = {
            'frame_time_s': self._solve_s,
            'model_age_s_max': self._model_age_ns / SECOND_NS,
            'last_refusal': self._trouble.last,
            'ready_for': self._ready_for(),
            'pose_listeners': sum(topic.listeners for topic in self._topics.values()),
        }
        self._model_age_ns = 0
        if tracker is not None:
            values |= {name: count for name, count in tracker.counters.items() if name != 'frames'}
        conflict = one_source.sender_words(self._sources)
        if conflict:
            return Status('', Level.ERROR, f'{TWO_SOURCES}: {conflict}', values)
        if self._setup is None:
            return Status('', Level.WARN, self._trouble.last or 'no setup yet', values)
        if tracker is None or tracker.model is None:
            return Status('', Level.WARN, self._trouble.last or 'no field model yet', values)
        stale_after_s = self.parameters.stale_after_s
        good = sum(topic.state(stale_after_s)[0] == OK for topic in self._topics.values())
        dead = ', '.join(tracker.dead_emitters)
        values |= {
            'dipoles': len(tracker.model.positions),
            'emitters': len(tracker.model.emitters),
            'model_stamp_ns': '' if newest is None else newest.stamp_ns,
            'models_late': self._frames.late,
            'tracked': good,
            'dead_emitters': dead,
            # A drift takes no recorded course here: field_model follows it by its references.
            'left_to_references': ', '.join(tracker.drifting_effects),
            'corrected': ', '.join(tracker.corrected_effects),
            'emitter_strengths': tracker.emitter_strengths,
        }
        withheld = None if half is None else half.withheld
        if withheld is not None and withheld.state != TWO_SOURCES:
            return Status('', Level.ERROR, ': '.join(withheld), values)
        if dead:
            return Status('', Level.WARN, f'no flux of {dead}', values)
        trouble, gate = self._trouble.recent(time.monotonic()), tracker.settings.gate
        words = tracked = f'{good} of {len(self._topics)} tracked'
        if slow:
            words = f'{slow}; {tracked}'
        elif trouble:
            words += f'; lately: {trouble}'
        elif gate > WIDE_GATE:
            words += f'; a gate of {gate:g} lets wrong poses through'
        return Status('', Level.OK if words == tracked else Level.WARN, words, values)

    def _ready_for(self) -> str:
        """Digest of the setup that no pose will be lost of: all listeners and the model are there.

        A sender of fluxes (a replay) reads it in ``/diagnostics`` before it starts.
        """
        half, given = self._half, self._intake.newest or self._given
        lacks_model = given is None and self.count_publishers('field_model')
        lacks_error = given is None or given.error is None
        lacks_error = lacks_error and self.count_publishers('field_model_error') > 0
        if half is None or half.tracker.model is None or lacks_model or lacks_error:
            return ''
        is_matched = all(topic.is_matched(self) for topic in self._topics.values())
        return fingerprint_of(self._setup_text) if is_matched else ''

    def part_statuses(self) -> list[Status]:
        """Return a line for every sensor and body."""
        return [topic.status(self.parameters.stale_after_s) for topic in self._topics.values()]


if __name__ == '__main__':
    sys.exit(main(TrackerNode))
