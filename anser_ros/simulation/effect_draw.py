"""Draws an effect and its parameters at random, for tests that do not know the answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from anser_ros.errors import ParameterError
from anser_ros.simulation.metal import MetalBody
from anser_ros.simulation.raw_effects import (
    ChannelGain,
    CoilWeakens,
    CompressingAmplifier,
    CrossoverAmplifier,
    GainRipple,
    LooseSensor,
    OpticalClock,
    RawChannelCrosstalk,
    RawEffect,
    TiltedSensor,
)
from anser_ros.wire.channel_calibration import ChannelCalibration
from anser_ros.wire.setup import Setup

NONE = 'none'
RANDOM = 'random'


@dataclass(frozen=True)
class Drawn:
    """Holds a drawn effect with its name and parameters."""

    name: str  # name of the effect
    # its parameters as plain data, named as in docs/interfaces.md where the effect is there
    parameters: dict[str, Any]
    effects: tuple[RawEffect, ...] = ()  # what puts the effect into the signals
    metal: tuple[MetalBody, ...] = field(default=())  # what puts it into the world
    # names under which a diagnosis may rightly report the effect; empty where it has no such
    # effect and only ``unexplained`` is right
    answers: tuple[str, ...] = ()

    def document(self) -> dict[str, Any]:
        """Return the effect as plain data for a file of the truth."""
        return {
            'name': self.name, 'parameters': self.parameters, 'answers': list(self.answers)
        }  # fmt: skip


@dataclass(frozen=True)
class Unit:
    """Holds the sensors that an effect is put into, with the response of their channels."""

    setup: Setup
    channels: ChannelCalibration


def _tool_columns(setup: Setup) -> list[int]:
    moving = {sensor.name for sensor in setup.tool_sensors}
    return [column for column, s in enumerate(setup.sensors) if s.name in moving]


def _clusters(setup: Setup) -> list[list[int]]:
    """Return the columns of tool sensors of which three or more are at the same place."""
    places: dict[tuple[str, tuple[float, ...]], list[int]] = {}
    for column in _tool_columns(setup):
        sensor = setup.sensors[column]
        places.setdefault((sensor.body, sensor.position_m), []).append(column)
    return [columns for columns in places.values() if len(columns) >= 3]


def _static_metal(unit: Unit, rng: np.random.Generator) -> Drawn:
    place = np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(-0.12, -0.07)])
    radius = float(rng.uniform(0.03, 0.045))
    body = MetalBody(np.zeros((1, 3)), radius, 5e6, 200.0, _resting(place))
    parameters = {'position_m': place.tolist(), 'radius_m': radius}
    return _known('static_metal', parameters, metal=(body,))


def _resting(place: NDArray[np.float64]) -> Callable[[float], Any]:
    return lambda time_s: (place, np.eye(3))


def _known(name: str, parameters: dict[str, Any], *effects: RawEffect, **rest: Any) -> Drawn:
    """Return an effect that the diagnosis reports under the same name."""
    return Drawn(name, parameters, effects, answers=(name,), **rest)


def _channel_crosstalk(unit: Unit, rng: np.random.Generator) -> Drawn:
    clusters = _clusters(unit.setup)
    columns = clusters[rng.integers(len(clusters))] if clusters else _tool_columns(unit.setup)[:2]
    count = len(columns)
    matrix = np.eye(count) + rng.uniform(0.01, 0.04, (count, count)) * (1 - np.eye(count))
    matrix[~np.eye(count, dtype=bool)] *= rng.choice([-1.0, 1.0], count * (count - 1))
    rows = tuple(tuple(float(v) for v in row) for row in matrix)
    channels = [unit.setup.sensors[c].channel for c in columns]
    parameters = {'channels': channels, 'matrix': [list(row) for row in rows]}
    return _known('channel_crosstalk', parameters, RawChannelCrosstalk(tuple(columns), rows))


def _time_offset(unit: Unit, rng: np.random.Generator) -> Drawn:
    early = float(rng.uniform(0.015, 0.04))
    return _known('time_offset', {'offset_s': early}, OpticalClock(early_s=early))


def _clock_rate(unit: Unit, rng: np.random.Generator) -> Drawn:
    fast_ppm = float(rng.uniform(2500.0, 6000.0))
    return _known('clock_rate', {'rate_ppm': -fast_ppm}, OpticalClock(fast_ppm=fast_ppm))


def _sensor_axis(unit: Unit, rng: np.random.Generator) -> Drawn:
    column = int(rng.choice(_tool_columns(unit.setup)))
    sensor = unit.setup.sensors[column]
    across = np.cross(sensor.axis, rng.standard_normal(3))
    tilt_deg = float(rng.uniform(3.0, 8.0))
    turn = Rotation.from_rotvec(np.radians(tilt_deg) * across / np.linalg.norm(across))
    x, y, z = (float(v) for v in turn.apply(sensor.axis))
    parameters = {'channel': sensor.channel, 'tilt_deg': tilt_deg, 'axis': [x, y, z]}
    return _known('sensor_axis', parameters, TiltedSensor(column, (x, y, z)))


def _sensor_gain(unit: Unit, rng: np.random.Generator) -> Drawn:
    column = int(rng.choice(_tool_columns(unit.setup)))
    gain = float(1 + rng.choice([-1, 1]) * rng.uniform(0.01, 0.04))
    parameters = {'channel': unit.setup.sensors[column].channel, 'gain': gain, 'phase_deg': 0.0}
    return _known('sensor_gain', parameters, ChannelGain(column, gain))


def _saturation(unit: Unit, rng: np.random.Generator) -> Drawn:
    column = int(rng.choice(_tool_columns(unit.setup)))
    limit_v = float(rng.uniform(2.0, 4.0))
    channel = unit.setup.sensors[column].channel
    # The amplifier's limit is a voltage, which grows with the frequency: the mean tone stands for
    # all of them.
    volts_per_tesla = unit.channels.areas_m2([channel])[0] * np.mean(unit.setup.frequencies_hz)
    full_scale_t = float(limit_v / (2 * np.pi * volts_per_tesla))
    parameters = {'channel': channel, 'full_scale_t': full_scale_t, 'limit_v': limit_v}
    return _known('saturation', parameters, CompressingAmplifier(column, limit_v))


def _coil_drift(unit: Unit, rng: np.random.Generator) -> Drawn:
    coil = int(rng.integers(len(unit.setup.emitter.coils)))
    amount = float(rng.choice([-1, 1]) * rng.uniform(0.01, 0.03))
    tau_s = float(rng.uniform(5.0, 20.0))
    parameters = {'coil': coil, 'amount': amount, 'tau_s': tau_s}
    return _known('coil_drift', parameters, CoilWeakens(coil, amount, tau_s))


def _loose_contact(unit: Unit, rng: np.random.Generator) -> Drawn:
    column = int(rng.choice(_tool_columns(unit.setup)))
    share, period_s = float(rng.uniform(0.04, 0.1)), float(rng.uniform(0.6, 1.2))
    parameters = {
        'channels': [unit.setup.sensors[column].channel], 'share': share, 'period_s': period_s
    }  # fmt: skip
    effect = LooseSensor(column, share, period_s=period_s)
    answers = ('loose_contact', 'outliers')
    return Drawn('loose_contact', parameters, (effect,), answers=answers)


def _gain_ripple(unit: Unit, rng: np.random.Generator) -> Drawn:
    depth, period_s = float(rng.uniform(0.005, 0.02)), float(rng.uniform(1.0, 4.0))
    parameters = {'depth': depth, 'period_s': period_s}
    # The diagnosis has no oscillating gain, but one that varies over time.
    return Drawn(
        'gain_ripple',
        parameters,
        (GainRipple(depth, period_s),),
        answers=('tool_gain_drift', 'sensor_gain_drift'),
    )


def _crossover(unit: Unit, rng: np.random.Generator) -> Drawn:
    column = int(rng.choice(_tool_columns(unit.setup)))
    dead_v = float(rng.uniform(0.01, 0.03))
    parameters = {'channel': unit.setup.sensors[column].channel, 'dead_v': dead_v}
    return Drawn('crossover', parameters, (CrossoverAmplifier(column, dead_v),))


CATALOGUE: dict[str, Callable[[Unit, np.random.Generator], Drawn]] = {
    'static_metal': _static_metal,
    'channel_crosstalk': _channel_crosstalk,
    'time_offset': _time_offset,
    'clock_rate': _clock_rate,
    'sensor_axis': _sensor_axis,
    'sensor_gain': _sensor_gain,
    'saturation': _saturation,
    'coil_drift': _coil_drift,
    'loose_contact': _loose_contact,
    'gain_ripple': _gain_ripple,
    'crossover': _crossover,
}


def draw(name: str, setup: Setup, channels: ChannelCalibration, rng: np.random.Generator) -> Drawn:
    """Draw the parameters of an effect, and the effect itself when `name` is ``random``.

    Raises `ParameterError` when there is no effect of that name.
    """
    if name == NONE:
        return Drawn(NONE, {})
    if name == RANDOM:
        name = str(rng.choice(sorted(CATALOGUE)))
    if name not in CATALOGUE:
        raise ParameterError(f'no effect {name!r}; there are: {", ".join(sorted(CATALOGUE))}')
    return CATALOGUE[name](Unit(setup, channels), rng)
