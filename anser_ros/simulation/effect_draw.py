"""Draws an effect at random, so that a test of the diagnosis can be blind to it."""

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
    ChannelCrosstalk,
    ChannelGain,
    CoilWeakens,
    CompressingAmplifier,
    GainRipple,
    LateDelivery,
    RawEffect,
    TiltedSensor,
)
from anser_ros.wire.setup import Setup

NONE = 'none'
RANDOM = 'random'


@dataclass(frozen=True)
class Drawn:
    """An effect with its name and parameters as the contract writes them.

    Attributes
    ----------
    name : effect name of the interfaces, or one that no catalogue has
    parameters : plain data
    effects, metal : what puts it into the simulation
    """

    name: str
    parameters: dict[str, Any]
    effects: tuple[RawEffect, ...] = ()
    metal: tuple[MetalBody, ...] = field(default=())


def _tool_columns(setup: Setup) -> list[int]:
    moving = {sensor.name for sensor in setup.tool_sensors}
    return [column for column, s in enumerate(setup.sensors) if s.name in moving]


def _clusters(setup: Setup) -> list[list[int]]:
    """Columns of tool sensors that sit at one place, three or more together."""
    places: dict[tuple[str, tuple[float, ...]], list[int]] = {}
    for column in _tool_columns(setup):
        sensor = setup.sensors[column]
        places.setdefault((sensor.body, sensor.position_m), []).append(column)
    return [columns for columns in places.values() if len(columns) >= 3]


def _static_metal(setup: Setup, rng: np.random.Generator) -> Drawn:
    place = np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(-0.12, -0.07)])
    radius = float(rng.uniform(0.03, 0.045))
    body = MetalBody(np.zeros((1, 3)), radius, 5e6, 200.0, _resting(place))
    return Drawn('static_metal', {'position_m': place.tolist(), 'radius_m': radius}, metal=(body,))


def _resting(place: NDArray[np.float64]) -> Callable[[float], Any]:
    return lambda time_s: (place, np.eye(3))


def _channel_crosstalk(setup: Setup, rng: np.random.Generator) -> Drawn:
    clusters = _clusters(setup)
    columns = clusters[rng.integers(len(clusters))] if clusters else _tool_columns(setup)[:2]
    count = len(columns)
    matrix = np.eye(count) + rng.uniform(0.01, 0.04, (count, count)) * (1 - np.eye(count))
    matrix[~np.eye(count, dtype=bool)] *= rng.choice([-1.0, 1.0], count * (count - 1))
    rows = tuple(tuple(float(v) for v in row) for row in matrix)
    channels = [setup.sensors[c].channel for c in columns]
    return Drawn(
        'channel_crosstalk',
        {'channels': channels, 'matrix': [list(row) for row in rows]},
        (ChannelCrosstalk(tuple(columns), rows),),
    )


def _time_offset(setup: Setup, rng: np.random.Generator) -> Drawn:
    delay = float(rng.uniform(0.015, 0.04))
    return Drawn('time_offset', {'offset_s': delay}, (LateDelivery(delay),))


def _sensor_axis(setup: Setup, rng: np.random.Generator) -> Drawn:
    column = int(rng.choice(_tool_columns(setup)))
    sensor = setup.sensors[column]
    across = np.cross(sensor.axis, rng.standard_normal(3))
    tilt_deg = float(rng.uniform(3.0, 8.0))
    turn = Rotation.from_rotvec(np.radians(tilt_deg) * across / np.linalg.norm(across))
    x, y, z = (float(v) for v in turn.apply(sensor.axis))
    return Drawn(
        'sensor_axis',
        {'channel': sensor.channel, 'tilt_deg': tilt_deg, 'axis': [x, y, z]},
        (TiltedSensor(column, (x, y, z)),),
    )


def _sensor_gain(setup: Setup, rng: np.random.Generator) -> Drawn:
    column = int(rng.choice(_tool_columns(setup)))
    gain = float(1 + rng.choice([-1, 1]) * rng.uniform(0.01, 0.04))
    parameters = {'channel': setup.sensors[column].channel, 'gain': gain, 'phase_deg': 0.0}
    return Drawn('sensor_gain', parameters, (ChannelGain(column, gain),))


def _saturation(setup: Setup, rng: np.random.Generator) -> Drawn:
    column = int(rng.choice(_tool_columns(setup)))
    limit_v = float(rng.uniform(0.8, 1.6))
    parameters = {'channel': setup.sensors[column].channel, 'limit_v': limit_v}
    return Drawn('saturation', parameters, (CompressingAmplifier(column, limit_v),))


def _coil_drift(setup: Setup, rng: np.random.Generator) -> Drawn:
    coil = int(rng.integers(len(setup.emitter.coils)))
    amount = float(rng.choice([-1, 1]) * rng.uniform(0.01, 0.03))
    tau_s = float(rng.uniform(5.0, 20.0))
    parameters = {'coil': coil, 'amount': amount, 'tau_s': tau_s}
    return Drawn('coil_drift', parameters, (CoilWeakens(coil, amount, tau_s),))


def _gain_ripple(setup: Setup, rng: np.random.Generator) -> Drawn:
    depth, period_s = float(rng.uniform(0.005, 0.02)), float(rng.uniform(1.0, 4.0))
    return Drawn(
        'gain_ripple', {'depth': depth, 'period_s': period_s}, (GainRipple(depth, period_s),)
    )


CATALOGUE: dict[str, Callable[[Setup, np.random.Generator], Drawn]] = {
    'static_metal': _static_metal,
    'channel_crosstalk': _channel_crosstalk,
    'time_offset': _time_offset,
    'sensor_axis': _sensor_axis,
    'sensor_gain': _sensor_gain,
    'saturation': _saturation,
    'coil_drift': _coil_drift,
    'gain_ripple': _gain_ripple,
}


def draw(name: str, setup: Setup, rng: np.random.Generator) -> Drawn:
    """Draw the parameters of an effect, and the effect itself when `name` is ``random``.

    Raises
    ------
    ParameterError
        When there is no effect of that name.
    """
    if name == NONE:
        return Drawn(NONE, {})
    if name == RANDOM:
        name = str(rng.choice(sorted(CATALOGUE)))
    if name not in CATALOGUE:
        raise ParameterError(f'no effect {name!r}; there are: {", ".join(sorted(CATALOGUE))}')
    return CATALOGUE[name](setup, rng)
