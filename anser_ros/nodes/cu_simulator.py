"""Simulates a control unit behind a pseudo-terminal, with the optical truth beside it."""

import functools
import json
import math
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped

from anser_ros.errors import ParameterError
from anser_ros.nodes.pose_output import PackedMessage
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import (
    from_text,
    optical_parameter,
    parameter,
    prefix_parameter,
)
from anser_ros.nodes.runtime.process import main
from anser_ros.physics.rotations import quaternion_of_rotation
from anser_ros.simulation import line, world
from anser_ros.simulation.control_unit import ControlUnit, FrontEnd, Piece
from anser_ros.simulation.effects import NONE as NO_EFFECT
from anser_ros.simulation.effects import Drawn, draw
from anser_ros.wire.channel_calibration import parse_channels
from anser_ros.wire.recorded import optical_topic
from anser_ros.wire.setup import parse_setup

STRETCH_S = 0.005
"""Stretch of samples that is made at a time, s: it bounds how unevenly they are sent."""
LONGEST_LAG_S = 0.25
"""Lag behind the clock, s, beyond which samples are left out instead of made up for."""
OPTICAL_RATE_HZ = 60.0
"""Poses a second of the optical truth, as usual for optical trackers."""


@dataclass(frozen=True)
class CuSimulatorParameters:
    link: str = parameter('/tmp/anser_cu', 'path under which the port can be opened')
    frame_prefix: str = prefix_parameter()
    setup_file: str = parameter('demo_setup.yaml', 'setup document: a path, or a file of config/')
    channels_file: str = parameter(
        'demo_channels.yaml', 'channel calibration: a path, or a file of config/'
    )
    board_seed: int = parameter(
        0,
        'of the board: 0 for the nominal one, which the nominal model fits; 1 for that of '
        'demo_model.yaml and bags/; any other number for one with random manufacturing '
        'tolerances',
        within=(0, math.inf),
    )
    sample_rate_hz: float = parameter(
        FrontEnd.sample_rate_hz, 'samples a second and channel', within=(16e3, 100e3)
    )
    metal: bool = parameter(True, 'whether a steel disc comes and goes')
    metal_radius_m: float = parameter(0.06, 'of the disc, m', within=(0.005, 0.3))
    metal_start_s: float = parameter(
        12.0,
        'when the disc starts to move, s after the first start of the stream',
        within=(0.0, math.inf),
    )
    metal_travel_s: float = parameter(
        4.0, 'time of its way in, and out, s', within=(0.1, math.inf)
    )
    metal_stay_s: float = parameter(6.0, 'time that it stays near, s', within=(0.0, math.inf))
    metal_period_s: float = parameter(
        30.0, 'period of its visits; 0 for a single one, s', within=(0.0, math.inf)
    )
    optical_noise_m: float = parameter(
        0.0, 'jitter of the optical position, m rms an axis', within=(0.0, 0.01)
    )
    path_phase_rad: float = parameter(
        0.0,
        "phase at which the tools' paths begin; another value gives another path",
        within=(0.0, math.inf),
    )
    fault: str = parameter(line.NONE, 'fault of the line', choices=line.FAULTS, live=True)
    fault_period_s: float = parameter(
        5.0, 'from one fault to the next, s', within=(0.1, 3600.0), live=True
    )
    seed: int = parameter(0, 'of noise and faults', within=(0, math.inf))
    effect: str = parameter(
        NO_EFFECT, 'effect in the raw signals: none, random, or one of its catalogue'
    )
    effect_seed: int = parameter(
        0, 'of the effect; 0 for another one every time', within=(0, math.inf)
    )
    optical: str = optical_parameter()
    effect_file: str = parameter('', 'file (.json) to write the chosen effect to; empty for none')


class CuSimulator(AnserNode):
    """Runs the control unit in a thread in real time, and publishes ``/optical/<body>/pose``."""

    NAME = 'cu_simulator'
    EXAMPLE = '--ros-args -p link:=/tmp/anser_cu -p metal:=false'
    PARAMETERS = CuSimulatorParameters
    HAS_KERNELS = True

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        table = self.parameters
        setup = from_text('setup_file', table.setup_file, parse_setup)
        channels = from_text('channels_file', table.channels_file, parse_channels)
        rng = np.random.default_rng(table.effect_seed or None)
        drawn = draw(table.effect, setup, channels, rng)
        if table.effect_file:
            _write_effect(Path(table.effect_file), drawn)
        self._effects = drawn.effects
        real = functools.reduce(lambda made, effect: effect.setup(made), drawn.effects, setup)
        board_rng = np.random.default_rng(table.board_seed)
        made = world.manufactured(real, board_rng) if table.board_seed else real
        self._begin_ns = time.monotonic_ns()
        self._stream_begin_s = math.inf
        self._metal = [*_metal(table, lambda: self._stream_begin_s), *drawn.metal]
        paths = world.tool_paths(setup.bodies, table.path_phase_rad)
        self._world = world.World(real, world.board_source(made), paths=paths, metal=self._metal)
        self._world.flux(0.0)  # loads the kernels now, not while samples are due
        front = FrontEnd(table.sample_rate_hz)
        self._unit = ControlUnit(
            self._world, channels, front, effects=drawn.effects, seed=table.seed
        )
        self._least_late_ns = math.inf
        self._rng = np.random.default_rng(table.seed + 1)
        self._injector = line.FaultInjector(table.fault, table.fault_period_s, table.seed)
        self._port = line.PseudoPort(Path(table.link))
        self._publishers_of = {
            body: self.create_publisher(
                PoseStamped, optical_topic(body, table.optical), qos.STREAM
            )
            for body in setup.bodies
        }
        self._message = PackedMessage(PoseStamped, f'{table.frame_prefix}{setup.frame_id}', 7)
        self._prepared: deque[Piece] = deque()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name='control_unit')
        self._thread.start()
        self.create_timer(1 / OPTICAL_RATE_HZ, self._publish_truth, clock=self.steady_clock)
        self.get_logger().info(f'control unit at {table.link}')

    # Device thread ------------------------------------------------------------------------

    def _run(self) -> None:
        step = self._guard(self._step)
        while not self._closing.is_set():
            step()
            # Until a block is to be sent, or the next ones are to be made.
            next_s = self._due_s(self._unit.samples) - STRETCH_S
            if self._prepared:
                next_s = self._due_s(self._prepared[0].end_sample)
            self._port.wait(max(next_s - self._elapsed_s(), 1e-4))

    def _elapsed_s(self) -> float:
        return (time.monotonic_ns() - self._begin_ns) / 1e9

    def _due_s(self, samples: int) -> float:
        """When so many samples have been taken since power-up, and can go out."""
        return samples / self._unit.sample_rate_hz

    def _step(self) -> None:
        """Send what is due. The next stretch is worked out before its time, so nothing is late.

        If it is late nevertheless, on a busy machine, answers follow the samples that were due
        before the commands had been read, because the host dates samples by the answers.
        """
        unit = self._unit
        # In this order, for this may wait for the processor in between.
        commands, now_s = self._port.read(), self._elapsed_s()
        self._plug(now_s)
        unit.overload(self._injector.lasts(now_s, line.SATURATION))
        while now_s >= self._due_s(unit.samples) - STRETCH_S:
            late_s = now_s - self._due_s(unit.samples) - LONGEST_LAG_S
            if late_s > 0:
                # The machine was too busy: samples are lost, as in a device, but time goes on.
                self.count('lags')
                unit.skip(int(late_s * unit.sample_rate_hz))
            self._prepared.extend(unit.advance(round(STRETCH_S * unit.sample_rate_hz)))
        answers = unit.receive(commands)
        if unit.streaming and self._stream_begin_s == math.inf:
            self._stream_begin_s = now_s
        due = []
        while self._prepared and self._due_s(self._prepared[0].end_sample) <= now_s:
            due.append(self._prepared.popleft())
        self._send([*due, *answers], now_s)
        if due and due[-1].is_block:
            due_ns = self._begin_ns + round(1e9 * self._due_s(due[-1].end_sample))
            self._least_late_ns = min(self._least_late_ns, time.monotonic_ns() - due_ns)

    def _send(self, pieces: list[Piece], now_s: float) -> None:
        arriving = self._injector.apply(pieces, now_s)
        if self._injector.lasts(now_s, line.OVERRUN):
            for _ in filter(lambda piece: piece.is_block, arriving):
                self._unit.drop()
            arriving = [piece for piece in arriving if not piece.is_block]
        for _ in range(self._port.write(arriving)):
            self._unit.drop()
            self.count('dropped_blocks')

    def _plug(self, now_s: float) -> None:
        out = self._injector.lasts(now_s, line.UNPLUG)
        if out and self._port.plugged:
            self.count('unplugged')
            self._port.unplug()
        elif not out and not self._port.plugged:
            self._port.plug()

    # Executor thread ----------------------------------------------------------------------

    def _publish_truth(self) -> None:
        time_s = self._elapsed_s()
        # The host dates samples by the earliest arrivals, which are a little late themselves.
        late_ns = 0 if math.isinf(self._least_late_ns) else round(self._least_late_ns)
        unit_ns = self._begin_ns + round(1e9 * time_s) + late_ns
        now_ns = unit_ns + time.time_ns() - time.monotonic_ns()
        for effect in self._effects:
            now_ns += round(1e9 * (effect.optical_time(time_s) - time_s))
        noise_m = self.parameters.optical_noise_m
        for body, publisher in self._publishers_of.items():
            if not publisher.get_subscription_count():
                continue
            position, rotation = self._world.pose(body, time_s)
            position = position + noise_m * self._rng.standard_normal(3)
            numbers = *position.tolist(), *quaternion_of_rotation(rotation)
            publisher.publish(self._message.packed(now_ns, *numbers))

    def on_parameters(self, old: Any, new: Any) -> None:
        self._injector = line.FaultInjector(new.fault, new.fault_period_s, new.seed)

    def status(self) -> Status:
        state = 'streaming' if self._unit.streaming else 'idle, waiting for a start'
        values: dict[str, object] = {'link': self.parameters.link, 'fault': self._injector.kind}
        if self.parameters.metal:
            position, _ = self._metal[0].path(self._elapsed_s())
            values['metal_distance_m'] = float(abs(position[2]))
        return Status('', Level.OK, state, values)

    def close(self) -> None:
        self._closing.set()
        self._thread.join(2.0)
        self._port.unplug()


def _write_effect(path: Path, drawn: Drawn) -> None:
    try:
        path.write_text(json.dumps(drawn.document()) + '\n')
    except OSError as error:
        raise ParameterError(f'cannot write {path}: {error.strerror}') from error


def _metal(table: CuSimulatorParameters, begin_s: Callable[[], float]) -> list[world.MetalBody]:
    """The disc, on a path that begins when `begin_s` says."""
    if not table.metal:
        return []
    path = world.Approach(
        start_s=table.metal_start_s,
        travel_s=table.metal_travel_s,
        stay_s=table.metal_stay_s,
        period_s=table.metal_period_s,
    )
    return [
        world.steel_disc(lambda time_s: path(time_s - begin_s()), radius_m=table.metal_radius_m)
    ]


if __name__ == '__main__':
    sys.exit(main(CuSimulator))
