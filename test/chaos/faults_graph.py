"""Faults behind the line: models, publishers, processes, resources."""

import os
import resource
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from fault import Fault, Off
from rig import BOARD_SEED, RATE_HZ, Rig

from anser_ros.field.model import EffectRecord, FieldModel
from anser_ros.field.nominal import nominal_model
from anser_ros.sessions.model_file import load_model, save_model
from anser_ros.sessions.starting_model import board_of
from anser_ros.simulation.manufacture import manufactured

PERIOD_S = 1.0 / RATE_HZ
"""Time between two messages of somebody who publishes beside the chain, s."""


def _nothing() -> None:
    """Take nothing away."""


# Models ---------------------------------------------------------------------------------------


def _served(change: Callable[[Rig, FieldModel], FieldModel], **more: object) -> Callable[..., Off]:
    """Start field_model anew with a file that it should not have been given."""

    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        path = rig.folder / f'wrong_{time.monotonic_ns()}.yaml'
        save_model(path, change(rig, load_model(rig.model)))
        return _restarted(rig, model_file=path, baseline_at_start=True, **more)

    return on


def _restarted(rig: Rig, node: str = 'field_model', **parameters: object) -> Off:
    restore = rig.restored(node)
    rig.restart(node, **parameters)
    return restore


def _other_board(rig: Rig, given: FieldModel) -> FieldModel:
    drawn = manufactured(rig.setup, np.random.default_rng(BOARD_SEED + 6))
    other = nominal_model(board_of(drawn))
    return replace(other, modes=None, flux_error_t=given.flux_error_t, provenance=given.provenance)


def _nominal(rig: Rig, _rng: np.random.Generator) -> Off:
    return _restarted(rig, model_file='nominal', baseline_at_start=True)


def _saved_near_metal(rig: Rig, _rng: np.random.Generator) -> Off:
    path = rig.folder / 'saved.yaml'
    rig.set_parameter('field_model', 'save_file', str(path))
    time.sleep(4.0)
    rig.call('field_model/save')
    if not path.is_file():
        return _nothing
    return _restarted(rig, model_file=path, refit=False)


def _baseline_near_metal(rig: Rig, _rng: np.random.Generator) -> Off:
    restore = rig.restored('field_model')
    rig.call('field_model/set_baseline')
    return restore


def _doubled_effect(rig: Rig, _rng: np.random.Generator) -> Off:
    path = rig.folder / 'effects.yaml'
    record = EffectRecord('coil_gain', {'coil': 3, 'gain': 1.05, 'phase_deg': 0.0})
    save_model(path, replace(load_model(rig.model), effects=(record,)))
    return _restarted(rig, 'tracker', model_file=path)


def _no_gate(rig: Rig, rng: np.random.Generator) -> Off:
    import tampers

    rig.set_parameter('tracker', 'gate', 1e6)
    rig.line.put('no_gate', tampers.gain(1.05, [4]))

    def off() -> None:
        rig.line.take_off('no_gate')
        rig.set_parameter('tracker', 'gate', 5.0)

    return off


MODELS = (
    Fault('other-board', 'the model of another board with the same names and tones',
          _served(_other_board), 5.0),
    Fault('moments-up', 'moments x 1.01', _served(
        lambda rig, m: replace(m, moments=1.01 * m.moments)), 5.0),
    Fault('moment-one', 'moments of one emitter x 1.02', _served(
        lambda rig, m: replace(m, moments=m.moments * np.where(
            np.arange(m.moments.shape[1]) == 3, 1.02, 1.0))), 5.0),
    Fault('model-shifted', 'all dipoles 2 mm to the side', _served(
        lambda rig, m: replace(m, positions=m.positions + [0.002, 0.0, 0.0])), 5.0),
    Fault('model-scaled', 'all dipoles in another unit', _served(
        lambda rig, m: replace(m, positions=1e3 * m.positions)), 5.0),
    Fault('nominal', 'nominal on a real board', _nominal, 5.0),
    Fault('saved-near-metal', 'the model saved near metal, loaded as a clean one',
          _saved_near_metal, 8.0, 'metal'),
    Fault('baseline-near-metal', 'set_baseline while metal is near', _baseline_near_metal, 8.0,
          'metal', spoils=True),
    Fault('doubled-effect', "the tracker's file has an effect that the model served has not",
          _doubled_effect, 4.0),
    Fault('no-gate', 'gate set to 1e6 live, and a gain of 5 %', _no_gate, 4.0),
)  # fmt: skip
"""Models that are wrong."""


# The graph ------------------------------------------------------------------------------------


class _Publisher:
    """Somebody who publishes beside the chain, at its rate."""

    def __init__(self, rig: Rig, topic: str, make: Callable[[], Any], period_s: float) -> None:
        self._rig, self._make, self._period_s = rig, make, period_s
        from anser_ros.nodes import qos

        first = make()
        profile = {'setup': qos.LATCHED, 'field_model': qos.MODELS}.get(topic, qos.STREAM)
        self._publisher = rig.witness.node.create_publisher(type(first), topic, profile)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ending.wait(self._period_s):
            self._publisher.publish(self._make())

    def stop(self) -> None:
        self._ending.set()
        self._thread.join()
        self._rig.witness.node.destroy_publisher(self._publisher)


def _publishes(
    topic: str, change: Callable[[Rig, Any], Any], period_s: float = PERIOD_S
) -> Callable[..., Off]:
    """Publish changed copies of the first message that was seen on a flux topic."""

    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        which = topic.split('/')[0]
        kept = rig.witness.last_flux[which]
        publisher = _Publisher(rig, topic, lambda: change(rig, kept), period_s)
        return publisher.stop

    return on


def _stamped(message: Any, ahead_s: float = 0.0) -> Any:
    """A copy of a cloud with the present stamp."""
    from copy import copy

    from std_msgs.msg import Header

    out = copy(message)
    ns = time.time_ns() + round(1e9 * ahead_s)
    header = Header(frame_id=message.header.frame_id)
    header.stamp.sec, header.stamp.nanosec = divmod(ns, 10**9)
    out.header = header
    return out


def _other_frame(message: Any) -> Any:
    out = _stamped(message)
    out.header.frame_id = 'world'
    return out


def _without_stamp(message: Any) -> Any:
    out = _stamped(message)
    out.header.stamp.sec = out.header.stamp.nanosec = 0
    return out


def _huge(message: Any) -> Any:
    import array

    out = _stamped(message)
    out.width = 1_000_000
    out.data = array.array('B', bytes(out.width * out.point_step))
    return out


def _many_fields(message: Any) -> Any:
    out = _stamped(message)
    out.fields = [message.fields[0]] * 100_000
    return out


def _cut(message: Any) -> Any:
    out = _stamped(message)
    out.data = message.data[:-7]
    return out


def _not_a_number(message: Any) -> Any:
    import array

    out = _stamped(message)
    out.data = array.array('B', np.full(len(message.data) // 4, np.nan, '<f4').tobytes())
    return out


def _setups(change: Callable[[Rig], str], period_s: float = 0.5) -> Callable[..., Off]:
    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        from std_msgs.msg import String

        publisher = _Publisher(rig, 'setup', lambda: String(data=change(rig)), period_s)
        return publisher.stop

    return on


def _moved_setup(rig: Rig) -> str:
    from anser_ros.wire.setup import dump_setup

    sensors = tuple(
        replace(s, position_m=(s.position_m[0] + 0.01, *s.position_m[1:]))
        for s in rig.setup.sensors
    )
    return dump_setup(replace(rig.setup, sensors=sensors))


def _second_field_model(rig: Rig, _rng: np.random.Generator) -> Off:
    rig.start('field_model', '-r', '__node:=field_model_2', called='field_model_2',
              model_file='nominal', baseline_at_start=True)  # fmt: skip
    return lambda: rig.kill('field_model_2')


def _second_acquisition(rig: Rig, _rng: np.random.Generator) -> Off:
    rig.start('acquisition', '-r', '__node:=acquisition_2', called='acquisition_2',
              device='/nowhere')  # fmt: skip
    return lambda: rig.kill('acquisition_2')


def _second_tracker(rig: Rig, _rng: np.random.Generator) -> Off:
    rig.start('tracker', '-r', '__node:=tracker_2', called='tracker_2', model_file='nominal')
    return lambda: rig.kill('tracker_2')


def _models(change: Callable[[FieldModel], FieldModel]) -> Callable[..., Off]:
    """Somebody publishes a field model of his own."""

    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        from anser_ros.nodes.model_clouds import ModelWriter

        model = change(load_model(rig.model))
        publisher = _Publisher(
            rig, 'field_model',
            lambda: ModelWriter().dipoles(model, 'fg', time.time_ns()), 0.5,
        )  # fmt: skip
        return publisher.stop

    return on


def _model_of_nan(rig: Rig, _rng: np.random.Generator) -> Off:
    from anser_ros.nodes.model_clouds import ModelWriter

    message = ModelWriter().dipoles(load_model(rig.model), 'fg', time.time_ns())
    publisher = _Publisher(rig, 'field_model', lambda: _not_a_number(message), 0.5)
    return publisher.stop


def _reset(rig: Rig, _rng: np.random.Generator) -> Off:
    for _ in range(20):
        rig.call('field_model/reset')
    return _nothing


GRAPH = (
    Fault('second-flux', 'a second publisher of tool/flux, readings of another place',
          _publishes('tool/flux', lambda r, m: _stamped(m))),
    Fault('second-flux-fast', 'a second publisher of tool/flux at five times the rate',
          _publishes('tool/flux', lambda r, m: _stamped(m), PERIOD_S / 5)),
    Fault('second-references', 'a second publisher of reference/flux, old readings',
          _publishes('reference/flux', lambda r, m: _stamped(m)), 6.0, 'metal'),
    Fault('flux-same-stamp', 'an old message again and again',
          _publishes('tool/flux', lambda r, m: m)),
    Fault('flux-no-stamp', 'messages without a stamp',
          _publishes('tool/flux', lambda r, m: _without_stamp(m))),
    Fault('flux-future', 'messages stamped an hour ahead',
          _publishes('tool/flux', lambda r, m: _stamped(m, 3600.0))),
    Fault('flux-past', 'messages stamped an hour back',
          _publishes('tool/flux', lambda r, m: _stamped(m, -3600.0))),
    Fault('flux-frame', 'messages in another frame',
          _publishes('tool/flux', lambda r, m: _other_frame(m))),
    Fault('flux-huge', '10^6 points in a flux message',
          _publishes('tool/flux', lambda r, m: _huge(m), 1.0)),
    Fault('flux-fields', '10^5 fields in a flux message',
          _publishes('tool/flux', lambda r, m: _many_fields(m), 1.0)),
    Fault('flux-cut', 'messages that are cut', _publishes('tool/flux', lambda r, m: _cut(m))),
    Fault('flux-nan', 'messages of NaN', _publishes('tool/flux', lambda r, m: _not_a_number(m))),
    Fault('setup-other', 'a second setup: all sensors 1 cm to the side',
          _setups(_moved_setup), spoils=True),
    Fault('setup-garbage', 'a setup that is none', _setups(lambda r: ': [')),
    Fault('setup-huge', 'a setup of 20 MB', _setups(lambda r: 'a: ' + 'x' * 20_000_000, 1.0)),
    Fault('setup-bomb', 'a setup of aliases of aliases', _setups(lambda r: bomb())),
    Fault('second-field-model', 'a second field_model with the nominal model',
          _second_field_model, 8.0),
    Fault('second-acquisition', 'a second acquisition without a port', _second_acquisition, 6.0),
    Fault('second-tracker', 'a second tracker with the nominal model', _second_tracker, 8.0),
    Fault('cloud-nan', 'a published model of NaN', _model_of_nan),
    Fault('cloud-double', 'a published model with moments x 2', _models(
        lambda m: replace(m, moments=2.0 * m.moments)), spoils=True),
    Fault('cloud-off', 'a published model with moments x 1.02', _models(
        lambda m: replace(m, moments=1.02 * m.moments)), spoils=True),
    Fault('resets', 'twenty resets while metal is near', _reset, 3.0, 'metal'),
)  # fmt: skip
"""Whoever else is on the graph."""


def bomb(levels: int = 30) -> str:
    """Return YAML whose aliases stand for 2^levels items."""
    lines = ['a0: &a0 [x, x]']
    lines += [f'a{i}: &a{i} [*a{i - 1}, *a{i - 1}]' for i in range(1, levels)]
    return '\n'.join([*lines, 'schema: anser_setup/1', f'frame_id: *a{levels - 1}'])


# Processes ------------------------------------------------------------------------------------


def _killed(node: str) -> Callable[..., Off]:
    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        rig.kill(node)
        return lambda: rig.restart(node)

    return on


def _stopped(node: str) -> Callable[..., Off]:
    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        rig.signal(node, signal.SIGSTOP)
        return lambda: rig.signal(node, signal.SIGCONT)

    return on


def _flicker(node: str) -> Callable[..., Off]:
    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        for _ in range(8):
            rig.signal(node, signal.SIGSTOP)
            time.sleep(0.25)
            rig.signal(node, signal.SIGCONT)
            time.sleep(0.25)
        return _nothing

    return on


def _busy(rig: Rig, _rng: np.random.Generator) -> Off:
    import subprocess
    import sys

    loops = [
        subprocess.Popen([sys.executable, '-c', 'while True: pass'])
        for _ in range(2 * (os.cpu_count() or 1))
    ]

    def off() -> None:
        for loop in loops:
            loop.kill()
            loop.wait()

    return off


def _full_disk(rig: Rig, _rng: np.random.Generator) -> Off:
    """A recorder whose files may not grow beyond 200 kB."""
    rig.start('recorder', directory=rig.folder, name=f'full_{time.monotonic_ns()}')
    limit = 200_000
    resource.prlimit(rig.pid('recorder'), resource.RLIMIT_FSIZE, (limit, limit))
    return lambda: rig.kill('recorder')


def _little_memory(node: str) -> Callable[..., Off]:
    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        pages = int(Path(f'/proc/{rig.pid(node)}/statm').read_text().split()[0])
        now = pages * resource.getpagesize()
        infinite = resource.RLIM_INFINITY
        resource.prlimit(rig.pid(node), resource.RLIMIT_AS, (now + 4_000_000, infinite))
        return lambda: (
            resource.prlimit(rig.pid(node), resource.RLIMIT_AS, (infinite, infinite)) and None
        )

    return on


def _few_files(node: str) -> Callable[..., Off]:
    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        before = resource.prlimit(rig.pid(node), resource.RLIMIT_NOFILE)
        resource.prlimit(rig.pid(node), resource.RLIMIT_NOFILE, (8, before[1]))
        return lambda: resource.prlimit(rig.pid(node), resource.RLIMIT_NOFILE, before) and None

    return on


def _joins_late(rig: Rig, _rng: np.random.Generator) -> Off:
    rig.kill('tracker')
    rig.kill('field_model')
    rig.restart('tracker')
    rig.restart('field_model')
    return _nothing


NODES = ('acquisition', 'field_model', 'tracker', 'cu_simulator')
PROCESSES = (
    *(Fault(f'kill-{n}', f'{n} is killed and started again', _killed(n), 1.0) for n in NODES),
    *(Fault(f'stop-{n}', f'{n} is stopped for 2 s', _stopped(n), 2.0) for n in NODES),
    Fault('kill-field_model-metal', 'field_model is killed while metal moves',
          _killed('field_model'), 4.0, 'metal'),
    Fault('stop-field_model-metal', 'field_model is stopped for 6 s while metal moves',
          _stopped('field_model'), 6.0, 'metal'),
    Fault('flicker-acquisition', 'acquisition is stopped eight times for 0.25 s',
          _flicker('acquisition'), 0.5),
    Fault('flicker-tracker', 'tracker is stopped eight times for 0.25 s',
          _flicker('tracker'), 0.5),
    Fault('busy', 'two busy loops a processor', _busy, 4.0),
    Fault('late-model', 'the tracker is there before its model', _joins_late, 1.0),
    Fault('full-disk', 'the disk is full for the recorder', _full_disk, 5.0),
    Fault('memory-tracker', 'the tracker gets 4 MB more at most', _little_memory('tracker'), 4.0),
    Fault('memory-acquisition', 'acquisition gets 4 MB more at most',
          _little_memory('acquisition'), 4.0),
    Fault('files-tracker', 'the tracker may open no file more', _few_files('tracker'), 3.0),
)  # fmt: skip
"""The processes themselves, and what they have."""
