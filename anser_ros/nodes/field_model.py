"""Serves the field model: from a file or drawn from the setup, refitted live to references."""

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from anser_ros import pose_states as states
from anser_ros.arrays import ComplexArray
from anser_ros.chain.frame import ChainFrame, FrameReadings
from anser_ros.errors import AnserError, FitError, ModelFileError
from anser_ros.field.model import FieldModel
from anser_ros.frames.intake import Frame, Intake
from anser_ros.nodes import field_model_io, field_model_refit
from anser_ros.nodes.runtime.node import LONGEST_END_S, AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import from_file, parameter, prefix_parameter
from anser_ros.nodes.runtime.process import main
from anser_ros.nodes.streams.clouds import GivenModel, read_frame, readings_of
from anser_ros.nodes.streams.one_source import LOOK_S, NewestSource, sender_words, setup_source
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.frame import MOST_RATE_HZ, Pace, ReadingWindow, check_enough
from anser_ros.sessions.baseline import board_place_of, clean_flux, clean_mean
from anser_ros.sessions.kept_tables import kept_folder
from anser_ros.sessions.session import load_session, sensor_table
from anser_ros.sessions.starting_model import (
    SNAPSHOT,
    as_saved,
    is_nominal,
    is_snapshot,
    load_model,
    save_model,
    starting_model,
)
from anser_ros.stamps import is_live
from anser_ros.wire.cdr import PointCloud
from anser_ros.wire.setup import Setup, parse_setup
from anser_ros.wire.text_files import NOMINAL


@dataclass(frozen=True)
class FieldModelParameters:
    """Holds the parameters of the field model's server."""

    frame_prefix: str = prefix_parameter()
    model_file: str = parameter(
        NOMINAL,
        "model to start from: a file, or nominal for that of the setup's own geometry",
        live=True,
    )
    allow_uncalibrated: bool = parameter(
        False, 'whether trackers may give poses by the nominal model', live=True
    )
    refit: bool = parameter(
        True, 'whether the model follows the reference sensors once a baseline is set', live=True
    )
    baseline_file: str = parameter(
        '', 'distortion-free recording of the same board; empty: wait for set_baseline'
    )
    baseline_at_start: bool = parameter(
        False, 'whether the first readings are the distortion-free ones'
    )
    baseline_s: float = parameter(
        1.0, 'time that a baseline is averaged over, s', within=(0.05, 60.0)
    )
    keep_state: bool = parameter(
        True, 'whether baseline and tables are kept on disk for a node that is started again'
    )
    refit_rate_hz: float = parameter(
        MOST_RATE_HZ, 'most refits a second, by the stamps', within=(2.0, 1000.0), live=True
    )
    witnesses: bool = parameter(
        False, 'whether contradictions among the coils of rigid tools show metal, too'
    )
    save_file: str = parameter(
        'field_model.yaml', 'where the service save writes the model', live=True
    )


LONGEST_WAIT_S = 0.004
"""Time, s, that a frame's poses may be late by what this node does besides, as it writes to disk;
a frame whose model would come later has none, and the one before ages."""


class FieldModelNode(AnserNode):
    """Publishes ``field_model``, and answers ``field_model/reset`` and its like.

    Where another node of the process has frames, it calls ``step`` and ``witnessed``.
    """

    NAME = 'field_model'
    EXAMPLE = '--ros-args -p model_file:=config/demo_model.yaml -p baseline_file:=bags/scan.mcap'
    PARAMETERS = FieldModelParameters
    HAS_KERNELS = True

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        table = self.parameters
        self._file_model = from_file('model_file', table.model_file, load_model)
        self._baseline_bag = from_file('baseline_file', table.baseline_file, load_session)
        if self._baseline_bag is not None and self._baseline_bag.lost:
            self.warn('baseline_damaged', f'{table.baseline_file}: {self._baseline_bag.lost}')
        self._setup_text = self._no_baseline = ''
        self._setup: Setup | None = None
        self._references: SensorTable | None = None
        self._window: ReadingWindow | None = None
        self._base: FieldModel | None = None
        self._model: FieldModel | None = None
        self._frozen = self._unfit = False
        self._announced: tuple[bool, ...] = ()
        self._place = field_model_io.PlaceWatch()
        self._frames: Intake | None = None
        self._stamp_ns, self._received_s = 0, 0.0
        self._output = field_model_io.ModelOutput(self)
        self._metal = field_model_io.MetalView(self)
        setups = setup_source(self, self._on_setup)
        self._fluxes = NewestSource(self, 'reference/flux', self._on_flux)
        name = self.get_fully_qualified_name()
        folder = kept_folder(table.keep_state)
        kept = field_model_io.KeptBaseline(folder, name, self._fluxes.sender)
        witnesses = field_model_io.ToolWitnesses(
            self, table.witnesses, lambda: self._frame_id, self.refuse
        )
        self._refit = field_model_refit.ActiveRefit(
            witnesses, Pace(table.refit_rate_hz), self.count, kept
        )
        self.step = self.given(self._take_frame, LONGEST_WAIT_S)
        self.witnessed = self.given(witnesses.note, LONGEST_WAIT_S)
        self._sources = [setups, self._fluxes, *witnesses.sources]
        self.create_service(Trigger, 'field_model/reset', self._on_reset)
        self.create_service(Trigger, 'field_model/save', self._on_save)
        self.create_service(SetBool, 'field_model/freeze', self._on_freeze)
        self.create_service(Trigger, 'field_model/set_baseline', self._on_set_baseline)
        self.create_timer(LOOK_S, self._look, clock=self.steady_clock)
        self.create_timer(field_model_io.CONFIRM_S, self._refit.confirm, clock=self.steady_clock)
        if self._file_model is not None:
            self._base = self._file_model
            self._output.name_origin(self._file_model)
            self._serve(self._file_model, self.get_clock().now().nanoseconds)

    # What is subscribed to ----------------------------------------------------------------

    def _on_setup(self, message: String) -> None:
        if message.data == self._setup_text:
            return
        try:
            setup = parse_setup(message.data)
            if self._setup is not None and setup.follows_as(self._setup) and not self._unfit:
                self._setup_text, self._setup = message.data, setup
                return  # another rate or noise: model and baseline hold
            base = starting_model(setup, self._file_model)
        except AnserError as error:
            self.refuse('setups_refused', error)
            if isinstance(error, ModelFileError) and self._model is not None:
                self._unfit = True
                self._announce_changes()
            return
        self._setup_text, self._setup, table = message.data, setup, self.parameters
        self._trouble.forget()
        self._references = sensor_table(setup.reference_sensors)
        self._frames = Intake(self._references.channel, self.count)
        self._window = ReadingWindow(self._references, len(base.emitters), table.baseline_s)
        self._output.name_origin(base)
        self._unfit, self._base = False, base
        self._prepare(setup, base, self._references)
        if base is not self._model:
            self._serve(base, self.get_clock().now().nanoseconds)
        self._announce_changes()
        if self._baseline_bag is not None and len(self._references):
            try:
                baseline = clean_flux(self._baseline_bag, self._references, base)
                self._follow(baseline)
            except AnserError as error:
                self._refuse_baseline(error)
        elif len(self._references) and table.refit:
            self._look()
            if not (table.baseline_at_start or self._refit.is_making):
                self.get_logger().warning(field_model_refit.no_baseline(self.get_namespace()))

    def _on_flux(self, message: PointCloud) -> None:
        if self._setup is None:
            self.count('fluxes_before_setup')
            return
        try:
            stamp_ns, points = read_frame(message, self._frame_id, self.count)
            self._take_readings(stamp_ns, readings_of(points))
        except AnserError as error:
            self.refuse('fluxes_refused', error)

    def _take_frame(self, frame: ChainFrame) -> GivenModel | None:
        """Take a frame of another node of the process, and return the model that now holds."""
        try:
            if frame.reference is not None and not self._fluxes.complaint:
                self._take_readings(frame.stamp_ns, frame.reference)
        except AnserError as error:
            self.refuse('fluxes_refused', error)
        return self._output.newest

    def _take_readings(self, stamp_ns: int, readings: FrameReadings) -> None:
        """Judge a frame, check the model's place by it, and let the model follow it."""
        setup, window, frames = self._setup, self._window, self._frames
        if setup is None or window is None or frames is None:
            self.count('fluxes_before_setup')
            return
        frame = frames.admit(
            stamp_ns, readings.channels, readings.flux, readings.flags, setup.emitter_names
        )
        if frame is None:
            return
        for kind, many in frame.kinds.items():
            self.count(f'readings_{kind}', many)
        window.add(frame)
        self._received_s = time.monotonic()
        start = self._refit.start if self._refit.is_awaited else None
        if start is not None and not is_live(stamp_ns, time.time_ns()):
            start.wait()  # a recording that is played is worked off whole
        self._take_refit()
        if self._place.look(frame, window) and not self._follows and self._model is not None:
            self._serve(self._model, stamp_ns)
        has_none = self._refit.current is None and not self._refit.is_making
        if has_none and self.parameters.baseline_at_start and window.full:
            try:
                self._follow(clean_mean(window, self._base, self._references, setup))
            except FitError as error:
                self._refuse_baseline(error)
                window.clear()
        if self._refit.current is not None and self._follows:
            self._update(frame)

    def _update(self, frame: Frame) -> None:
        """Let the model follow the references, not more often than wanted.

        Every frame is answered with its active model, even if that is unchanged: so the
        tracker knows the model for each frame, and gives the same poses as offline.
        """
        result = self._refit.follow(frame)
        model = self._refit.answered or self._model
        if model is not None:
            self._serve(model, frame.stamp_ns, self._refit.withheld)
        if result is None:
            self.count('frames_between_refits')
        else:
            self._metal.show(result, self._shown_frame, frame.stamp_ns)

    @property
    def _frame_id(self) -> str:
        return self._setup.frame_id if self._setup is not None else 'fg'

    @property
    def _shown_frame(self) -> str:
        return f'{self.parameters.frame_prefix}{self._frame_id}'

    @property
    def _follows(self) -> bool:
        """Whether every frame of the references is answered by a model of its own, or will be."""
        is_there = self._refit.current is not None or self._refit.is_awaited
        return is_there and self.parameters.refit and not self._frozen

    @property
    def _state(self) -> tuple[bool, ...]:
        """What receivers are given besides the model; of it the first two are in the message."""
        is_waiting = self._setup is None or self._place.is_waiting
        return self._follows, is_waiting, self._unfit, self._is_uncalibrated

    # The model and its baseline -----------------------------------------------------------

    def _serve(self, model: FieldModel, stamp_ns: int, withheld: str = '') -> None:
        """Activate a model under a stamp that the last one did not have.

        The model of a frame of readings has their stamp, which may be of another day. ``withheld``
        is the state for which trackers should publish no poses, at once or soon.
        """
        self._announced = follows, is_waiting, *_ = self._state
        if self._unfit or self._place.misplaced:
            withheld = states.OTHER_MODEL
        elif is_waiting:
            withheld = states.REFERENCES_LOST
        elif not withheld and self._is_uncalibrated:
            withheld = states.UNCALIBRATED
        self._stamp_ns = stamp_ns if stamp_ns != self._stamp_ns else stamp_ns + 1
        # A model that is about to be judged lets trackers wait for the verdict on their frame.
        self._output.publish(
            model, self._shown_frame, self._stamp_ns, follows or is_waiting, withheld
        )
        if model is not self._model:
            self.count('models')
        self._model = model

    @property
    def _is_uncalibrated(self) -> bool:
        """Whether the base is the drawing of the board, and its use has not been allowed."""
        base, allowed = self._base, self.parameters.allow_uncalibrated
        return base is not None and is_nominal(base) and not allowed

    def _refuse_baseline(self, error: AnserError) -> None:
        self._no_baseline = str(error)
        self.refuse('baselines_refused', error)

    def _look(self) -> None:
        """Notice what changes without a frame."""
        self._refit.resume(self.parameters.refit)
        self._take_refit()
        self._announce_changes()

    def _announce_changes(self) -> None:
        """Let receivers know of another state than the one that they received."""
        if self._model is not None and self._announced != self._state:
            withheld = self._refit.withheld if self._follows else ''
            self._serve(self._model, self.get_clock().now().nanoseconds, withheld)

    def _follow(self, baseline: ComplexArray) -> None:
        """Refit to what differs from a baseline, shape (S, K), T, as soon as that can be done."""
        self._refit.begin(baseline)
        if self._refit.current is None:
            self.get_logger().info(field_model_refit.PREPARING)
        self._no_baseline = ''
        self._announce_changes()
        self.count('baselines')

    def _take_refit(self) -> None:
        """Use a refit that has been made meanwhile, and report it."""
        try:
            if not self._refit.take():
                return
            self._received_s = time.monotonic()
            self.get_logger().info(field_model_refit.ACTIVE)
        except FitError as error:
            self._refuse_baseline(error)
        self._announce_changes()

    def _exchange(self, file_model: FieldModel | None) -> None:
        """Start from another model; the baseline holds, as no model is in the readings.

        Raises `ModelFileError` or `SetupError` when there is no such model for the setup.
        """
        setup, references = self._setup, self._references
        base = file_model if setup is None else starting_model(setup, file_model)
        self._file_model, self._base = file_model, base
        if base is None:
            return
        if setup is not None and references is not None:
            self._prepare(setup, base, references, again=True)
        self._unfit, self._received_s = False, time.monotonic()
        self._trouble.forget()
        self._output.name_origin(base)
        self._serve_start(base)

    def _prepare(
        self, setup: Setup, base: FieldModel, references: SensorTable, again: bool = False
    ) -> None:
        """Prepare for references, ``again`` for those that there is a baseline of."""
        place = board_place_of(base, references, setup)
        self._place = field_model_io.PlaceWatch(place, self._fluxes.publishers)
        self._refit.prepare(setup, base, references, self.parameters.refit, again)

    def _serve_start(self, base: FieldModel) -> None:
        """Serve a model that is no answer of the references: trackers wait for the next one."""
        state = states.REFERENCES_LOST if self._follows else ''
        self._serve(base, self.get_clock().now().nanoseconds, state)

    # Services -----------------------------------------------------------------------------

    def _on_reset(self, _request: Any, response: Any) -> Any:
        if self._base is None:
            raise FitError('no model yet')
        self._refit.reset()
        self._serve_start(self._base)
        response.success, response.message = True, 'the model is the one from the start'
        return response

    def _on_save(self, _request: Any, response: Any) -> Any:
        if self._model is None or self._base is None:
            raise FitError('no model yet')
        saved = as_saved(self._model, self._base, self._stamp_ns)
        save_model(path := Path(self.parameters.save_file).expanduser().resolve(), saved)
        what = f' ({SNAPSHOT})' if is_snapshot(saved) else ''
        response.success, response.message = True, f'{path}{what}'
        return response

    def _on_freeze(self, request: Any, response: Any) -> Any:
        self._frozen = bool(request.data)
        self._announce_changes()
        response.success = True
        response.message = 'the model stays as it is' if self._frozen else 'the model may change'
        return response

    def _on_set_baseline(self, _request: Any, response: Any) -> Any:
        if self._window is None or self._setup is None:
            raise FitError('no setup yet')
        try:
            baseline = clean_mean(self._window, self._base, self._references, self._setup)
            good = check_enough(baseline, self._setup.refit.min_references)
        except FitError as error:  # stays in the state until there is one: a reply is soon gone
            self._no_baseline = str(error)
            raise
        self._follow(baseline)
        response.success = True
        response.message = f'baseline of {good} references over {len(self._window)} frames'
        return response

    # What is reported -------------------------------------------------------------------------

    def on_parameters(self, old: FieldModelParameters, new: FieldModelParameters) -> None:
        """Go on with the new model, at the new rate, or no longer."""
        if old.model_file != new.model_file:
            self._exchange(from_file('model_file', new.model_file, load_model))
        self._refit.pace.rate_hz = new.refit_rate_hz
        self._announce_changes()

    def status(self) -> Status:
        """Return which model is active, where it comes from, and what the refit does."""
        model = self._model
        values: dict[str, object] = {'last_refusal': self._trouble.last}
        conflict = sender_words(self._sources)
        if conflict:
            return Status('', Level.ERROR, f'{states.TWO_SOURCES}: {conflict}', values)
        if self._unfit or self._place.misplaced:
            why = self._trouble.last if self._unfit else self._place.misplaced
            return Status('', Level.ERROR, f'{states.OTHER_MODEL}: {why}', values)
        if model is None:
            return Status('', Level.WARN, self._trouble.last or 'no setup yet', values)
        values['fingerprint'] = '' if self._base is None else self._base.fingerprint
        values |= field_model_refit.model_values(model, self.parameters.model_file)
        values |= {'stamp_ns': self._stamp_ns, 'freeze': self._frozen}
        values |= {'refit_time_s': self._refit.update_s, 'awaits_refit': self._refit.is_awaited}
        is_wanted, refused = self.parameters.refit, self._no_baseline
        words = field_model_refit.activity(self._refit, self._frozen, is_wanted, refused, values)
        if self._is_uncalibrated:
            words = f'{states.UNCALIBRATED}: calibrate, or set allow_uncalibrated; {words}'
        dead = '' if self._frames is None else ', '.join(self._frames.dead)
        values['dead_emitters'] = dead
        if dead:
            return Status('', Level.WARN, f'no flux of {dead}', values)
        trouble = self._trouble.recent(time.monotonic())
        if trouble:
            return Status('', Level.WARN, f'{words}; lately: {trouble}', values)
        lost = f'{states.REFERENCES_LOST}: no reference fluxes'
        if self._place.is_waiting:
            return Status('', Level.WARN, f'{lost} yet', values)
        silent_s, setup = time.monotonic() - self._received_s, self._setup
        if setup is not None and self._follows and silent_s > setup.refit.references_age_s:
            return Status('', Level.ERROR, f'{lost} for {silent_s:.1f} s', values)
        is_troubled = values.get('refit_state') in field_model_refit.TROUBLED or bool(
            refused and is_wanted
        )
        is_troubled |= self._is_uncalibrated or (self._refit.is_awaited and self._follows)
        return Status('', Level.WARN if is_troubled else Level.OK, words, values)

    def part_statuses(self) -> list[Status]:
        """Return a line for every reference sensor that the refit looks at."""
        return field_model_refit.reference_statuses(self._refit.result)

    def stop_working(self) -> bool:
        """End what is worked on aside, a refit that is being made among it."""
        return self._refit.end(LONGEST_END_S)


if __name__ == '__main__':
    sys.exit(main(FieldModelNode))
