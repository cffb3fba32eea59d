"""Faults behind the line: who else publishes, and what."""

import array
import copy
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


def _publishes(
    topic: str, maker: Callable[[Rig], Callable[[], Any]], period_s: float
) -> Callable[..., Off]:
    """Let somebody publish beside the chain what is made anew for each message."""

    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        from anser_ros.nodes.runtime import qos

        make, ending, node = maker(rig), threading.Event(), rig.witness.node
        profile = {'setup': qos.LATCHED, 'field_model': qos.MODELS}.get(topic, qos.STREAM)
        publisher = node.create_publisher(type(make()), topic, profile)

        def publish() -> None:
            while not ending.wait(period_s):
                publisher.publish(make())

        thread = threading.Thread(target=publish, daemon=True)
        thread.start()

        def off() -> None:
            ending.set()
            thread.join()
            node.destroy_publisher(publisher)

        return off

    return on


def _fluxes(
    change: Callable[[Any], Any], topic: str = 'tool/flux', period_s: float = PERIOD_S
) -> Callable[..., Off]:
    """Publish changed copies of the last message that was seen on a flux topic."""

    def maker(rig: Rig) -> Callable[[], Any]:
        kept = rig.witness.last_flux[topic.split('/')[0]]
        return lambda: change(kept)

    return _publishes(topic, maker, period_s)


def _stamped(message: Any, ahead_s: float = 0.0, **changes: Any) -> Any:
    """A copy of a cloud with the present stamp and other changes."""
    out = copy.copy(message)
    out.header = copy.deepcopy(message.header)
    ns = time.time_ns() + round(1e9 * ahead_s)
    out.header.stamp.sec, out.header.stamp.nanosec = divmod(ns, 10**9)
    for name, value in changes.items():
        setattr(out, name, value)
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
    data = array.array('B', bytes(1_000_000 * message.point_step))
    return _stamped(message, width=1_000_000, data=data)


def _not_a_number(message: Any) -> Any:
    nan = np.full(len(message.data) // 4, np.nan, '<f4')
    return _stamped(message, data=array.array('B', nan.tobytes()))


def _setups(change: Callable[[Rig], str], period_s: float = 0.5) -> Callable[..., Off]:
    from std_msgs.msg import String

    return _publishes('setup', lambda rig: lambda: String(data=change(rig)), period_s)


def _moved_setup(rig: Rig) -> str:
    from anser_ros.wire.setup import dump_setup

    sensors = tuple(
        replace(s, position_m=(s.position_m[0] + 0.01, *s.position_m[1:]))
        for s in rig.setup.sensors
    )
    return dump_setup(replace(rig.setup, sensors=sensors))


def _second(node: str, **parameters: object) -> Callable[..., Off]:
    """Start a second node of a kind."""
    name = f'{node}_2'

    def on(rig: Rig, _rng: np.random.Generator) -> Off:
        rig.start(node, '-r', f'__node:={name}', called=name, **parameters)
        return lambda: rig.kill(name)

    return on


def _models(change: Callable[[FieldModel], FieldModel]) -> Callable[..., Off]:
    """Let somebody publish a field model of his own."""

    def maker(rig: Rig) -> Callable[[], Any]:
        model = change(load_model(rig.model))
        return lambda: _cloud_of(model)

    return _publishes('field_model', maker, 0.5)


def _cloud_of(model: FieldModel) -> Any:
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import PointCloud2

    from anser_ros.nodes.streams.clouds import ModelWriter

    writer = ModelWriter()
    cloud = writer.dipoles(writer.given(model, time.time_ns(), False), 'fg')
    return deserialize_message(cloud, PointCloud2)


def _models_of_nan(rig: Rig) -> Callable[[], Any]:
    message = _cloud_of(load_model(rig.model))
    return lambda: _not_a_number(message)


def _reset(rig: Rig, _rng: np.random.Generator) -> Off:
    for _ in range(20):
        rig.call('field_model/reset')
    return nothing


GRAPH = (
    Fault('second-flux', 'a second publisher of tool/flux, readings of another place',
          _fluxes(_stamped)),
    Fault('second-flux-fast', 'a second publisher of tool/flux at five times the rate',
          _fluxes(_stamped, period_s=PERIOD_S / 5)),
    Fault('second-references', 'a second publisher of reference/flux, old readings',
          _fluxes(_stamped, 'reference/flux'), 6.0, 'metal'),
    Fault('flux-same-stamp', 'an old message again and again',
          _fluxes(lambda m: m)),
    Fault('flux-no-stamp', 'messages without a stamp',
          _fluxes(_without_stamp)),
    Fault('flux-future', 'messages stamped an hour ahead',
          _fluxes(lambda m: _stamped(m, 3600.0))),
    Fault('flux-past', 'messages stamped an hour back',
          _fluxes(lambda m: _stamped(m, -3600.0))),
    Fault('flux-frame', 'messages in another frame',
          _fluxes(_other_frame)),
    Fault('flux-huge', '10^6 points in a flux message',
          _fluxes(_huge, period_s=1.0)),
    Fault('flux-fields', '10^5 fields in a flux message',
          _fluxes(lambda m: _stamped(m, fields=[m.fields[0]] * 100_000), period_s=1.0)),
    Fault('flux-cut', 'messages that are cut', _fluxes(lambda m: _stamped(m, data=m.data[:-7]))),
    Fault('flux-nan', 'messages of NaN', _fluxes(_not_a_number)),
    Fault('setup-other', 'a second setup: all sensors 1 cm to the side',
          _setups(_moved_setup), spoils=True),
    Fault('setup-garbage', 'a setup that is none', _setups(lambda r: ': [')),
    Fault('setup-huge', 'a setup of 20 MB', _setups(lambda r: 'a: ' + 'x' * 20_000_000, 1.0)),
    Fault('setup-bomb', 'a setup of aliases of aliases', _setups(lambda r: bomb())),
    Fault('second-field-model', 'a second field_model with the nominal model',
          _second('field_model', model_file='nominal', baseline_at_start=True), 8.0),
    Fault('second-acquisition', 'a second acquisition without a port',
          _second('acquisition', device='/nowhere'), 6.0),
    Fault('second-tracker', 'a second tracker with the nominal model',
          _second('tracker', model_file='nominal'), 8.0),
    Fault('cloud-nan', 'a published model of NaN',
          _publishes('field_model', _models_of_nan, 0.5)),
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
