"""Faults behind the line: who else publishes, and what."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from fault import Fault, Off, nothing
from rig import RATE_HZ, Rig

from anser_ros.field.model import FieldModel
from anser_ros.sessions.starting_model import load_model

PERIOD_S = 1.0 / RATE_HZ
"""Time between two messages of somebody who publishes beside the chain, s."""


class _Publisher:
    """Somebody who publishes beside the chain, at its rate."""

    def __init__(self, rig: Rig, topic: str, make: Callable[[], Any], period_s: float) -> None:
        self._rig, self._make, self._period_s = rig, make, period_s
        from anser_ros.nodes.runtime import qos

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
        from anser_ros.nodes.streams.clouds import ModelWriter

        model = change(load_model(rig.model))
        publisher = _Publisher(
            rig, 'field_model',
            lambda: ModelWriter().dipoles(model, 'fg', time.time_ns()), 0.5,
        )  # fmt: skip
        return publisher.stop

    return on


def _model_of_nan(rig: Rig, _rng: np.random.Generator) -> Off:
    from anser_ros.nodes.streams.clouds import ModelWriter

    message = ModelWriter().dipoles(load_model(rig.model), 'fg', time.time_ns())
    publisher = _Publisher(rig, 'field_model', lambda: _not_a_number(message), 0.5)
    return publisher.stop


def _reset(rig: Rig, _rng: np.random.Generator) -> Off:
    for _ in range(20):
        rig.call('field_model/reset')
    return nothing


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
